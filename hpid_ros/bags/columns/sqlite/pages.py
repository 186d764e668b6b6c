"""The rows of a table taken from the pages of an SQLite file, many at once.

Only what rosbag2 writes is understood: the table ``messages(id, topic_id, timestamp, data)`` with
``id`` the row's number, in a file without a log beside it. Anything else, a damaged page
included, raises :class:`UnusualPageError`; SQLite itself then reads on from the last row.

Source: "Database File Format", sqlite.org/fileformat2.html, sections 1.3, 1.6 and 2.1.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np

from hpid_ros.bags.columns.batches import SLACK, Bytes, Integers, gather_words

_INTERIOR, _LEAF = 5, 13
_LEAF_HEAD, _INTERIOR_HEAD = 8, 12
_FILE_HEAD = 100
_LOCAL = 35  # bytes of a page that a row without overflow leaves free
_PAGES_AT_ONCE = 1024
_LONGEST_VARINT = 5  # of nine: lengths and row numbers of real bags fit into 35 bits
_INTEGER_SIZES = np.array([0, 1, 2, 3, 4, 6, 8, 0, 0, 0], dtype=np.int64)
_ONE = 9  # the serial type that stands for the number 1
_FIRST_BLOB = 12


class UnusualPageError(Exception):
    """A page that is not as rosbag2's tables have them, or is damaged."""


class Rows(NamedTuple):
    """Rows of the table in a buffer of pages."""

    buffer: Bytes  # the pages
    ids: Integers  # row numbers, ascending, (n,)
    topic_ids: Integers  # their topics, (n,)
    times_ns: Integers  # [ns] their timestamps, (n,)
    starts: Integers  # where their data begins in the buffer, (n,)
    sizes: Integers  # how long it is, (n,); of a row that goes on elsewhere the negative of it
    local_ends: Integers  # where such a row leaves its page: there is the number of the next, (n,)


class PageReader:
    """Reads the table of messages of an SQLite file."""

    def __init__(self, stream: BinaryIO, root: int) -> None:
        stream.seek(0)
        head = stream.read(_FILE_HEAD)
        if len(head) < _FILE_HEAD or not head.startswith(b"SQLite format 3\x00"):
            raise UnusualPageError("no SQLite file")
        size = int.from_bytes(head[16:18], "big")
        self._page_size = 65536 if size == 1 else size
        self._usable = self._page_size - head[20]
        if self._page_size < 512 or self._page_size & (self._page_size - 1):
            raise UnusualPageError("no page size")
        self._stream, self._root = stream, root
        self._passed: set[int] = set()

    def rows(self) -> Iterator[Rows]:
        """Yield the rows in the order of their numbers."""
        pages: list[int] = []
        last = -(2**63)
        self._passed.clear()
        for page in self._leaves(self._root):
            pages.append(page)
            if len(pages) == _PAGES_AT_ONCE:
                rows = self._parsed(pages, last)
                pages, last = [], int(rows.ids[-1])
                yield rows
        if pages:
            yield self._parsed(pages, last)

    def loose_rows(self, following: int) -> Iterator[Rows]:
        """Yield the rows of all leaf pages in the order of the file, reached from a root or not.

        In a file that was cut off the pages that lead to its leaves may be what is missing.
        Leaves of other tables are told apart by their records.
        """
        for rows in self._loose_leaves():
            begin = int(np.searchsorted(rows.ids, following))
            if begin < len(rows.ids):
                following = int(rows.ids[-1]) + 1
                yield Rows(rows.buffer, *(part[begin:] for part in rows[1:]))

    def _loose_leaves(self) -> Iterator[Rows]:
        count = self._stream.seek(0, io.SEEK_END) // self._page_size
        pages: list[int] = []
        for page in range(2, count + 1):
            self._stream.seek((page - 1) * self._page_size)
            if self._stream.read(1)[0] == _LEAF:
                pages.append(page)
            if len(pages) == _PAGES_AT_ONCE:
                yield from self._parsed_as_far_as_possible(pages)
                pages = []
        yield from self._parsed_as_far_as_possible(pages)

    def _parsed_as_far_as_possible(self, pages: list[int]) -> Iterator[Rows]:
        if not pages:
            return
        try:
            rows = self._parsed(pages, -(2**63))
        except UnusualPageError:
            half = len(pages) // 2
            if half:
                yield from self._parsed_as_far_as_possible(pages[:half])
                yield from self._parsed_as_far_as_possible(pages[half:])
        else:
            yield rows

    def data(self, rows: Rows, index: int) -> bytes:
        """Return the data of one row, also if it goes on elsewhere."""
        start, size = int(rows.starts[index]), abs(int(rows.sizes[index]))
        if rows.sizes[index] >= 0:
            return rows.buffer[start : start + size].tobytes()
        here = int(rows.local_ends[index])
        parts = [rows.buffer[start:here].tobytes()]
        page = int.from_bytes(rows.buffer[here : here + 4].tobytes(), "big")
        missing = size - len(parts[0])
        while missing > 0:
            raw = self._page(page)
            parts.append(raw[4 : min(self._usable, 4 + missing)])
            missing -= len(parts[-1])
            page = int.from_bytes(raw[:4], "big")
        return b"".join(parts)

    def _leaves(self, page: int) -> Iterator[int]:
        """Yield the numbers of the leaf pages below a page, in order."""
        if page in self._passed:
            raise UnusualPageError(f"page {page} is below itself")
        self._passed.add(page)
        raw = self._page(page)
        kind, count = raw[0], int.from_bytes(raw[3:5], "big")
        if kind == _LEAF:
            yield page
            return
        if kind != _INTERIOR or _INTERIOR_HEAD + 2 * count > self._usable:
            raise UnusualPageError(f"page {page} is no page of a table")
        pointers = np.frombuffer(raw, ">u2", count, _INTERIOR_HEAD).tolist()
        children = [int.from_bytes(raw[at : at + 4], "big") for at in pointers]
        children.append(int.from_bytes(raw[8:12], "big"))
        if self._page(children[0])[0] == _LEAF:  # then all are, or their parsing fails
            yield from children
            return
        for child in children:
            yield from self._leaves(child)

    def _page(self, page: int) -> bytes:
        if page < 2:  # the first holds the schema
            raise UnusualPageError("the table is on page 1")
        self._stream.seek((page - 1) * self._page_size)
        raw = self._stream.read(self._page_size)
        if len(raw) < self._page_size:
            raise UnusualPageError(f"page {page} is cut off")
        return raw

    def _parsed(self, pages: list[int], last: int) -> Rows:
        """Read leaf pages and find their rows."""
        buffer, begins = self._loaded(pages)
        counts = _big(buffer, begins + 3, 2)
        if (buffer[begins] != _LEAF).any() or (_LEAF_HEAD + 2 * counts > self._usable).any():
            raise UnusualPageError("no leaf page")
        if not counts.sum():
            raise UnusualPageError("an empty page")
        owner = np.repeat(begins, counts)
        place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        cells = owner + _big(buffer, owner + _LEAF_HEAD + 2 * place, 2)
        ends = owner + self._usable
        payload, at = _varints(buffer, cells, ends)
        ids, body = _varints(buffer, at, ends)
        rows = self._records(buffer, ids, payload, body, ends)
        if ids[0] <= last or (ids[1:] <= ids[:-1]).any():
            raise UnusualPageError("rows out of order")
        return rows

    def _records(
        self, buffer: Bytes, ids: Integers, payload: Integers, record: Integers, ends: Integers
    ) -> Rows:
        """Read the columns of rows from their records."""
        head, at = _varints(buffer, record, ends)
        null, at = _varints(buffer, at, ends)
        topic, at = _varints(buffer, at, ends)
        time, at = _varints(buffer, at, ends)
        blob, at = _varints(buffer, at, ends)
        is_plain = (null == 0) & (topic <= _ONE) & (time <= _ONE) & (at == record + head)
        is_plain &= (blob >= _FIRST_BLOB) & (blob % 2 == 0)
        if not is_plain.all():
            raise UnusualPageError("no row of messages")
        topic_ids, at = _integers(buffer, at, topic)
        times, at = _integers(buffer, at, time)
        sizes = (blob - _FIRST_BLOB) // 2
        is_whole = payload <= self._usable - _LOCAL
        least = (self._usable - 12) * 32 // 255 - 23
        most = self._usable - _LOCAL
        local = least + (payload - least) % (self._usable - 4)
        local = np.where(is_whole, payload, np.where(local <= most, local, least))
        is_inside = (record + local + np.where(is_whole, 0, 4) <= ends) & (at <= record + local)
        if ((at + sizes != record + payload) | ~is_inside).any():
            raise UnusualPageError("a row of another length")
        sizes = np.where(is_whole, sizes, -sizes)
        return Rows(buffer, ids, topic_ids, times, at, sizes, record + local)

    def _loaded(self, pages: list[int]) -> tuple[Bytes, Integers]:
        """Read pages into one buffer; return it and where each begins."""
        size, first, last = self._page_size, min(pages), max(pages)
        numbers = np.array(pages, dtype=np.int64)
        is_dense = last - first < 2 * len(pages)
        count = last - first + 1 if is_dense else len(pages)
        buffer = np.zeros(count * size + 2 * SLACK, dtype=np.uint8)
        if is_dense:
            self._stream.seek((first - 1) * size)
            target = buffer.data[SLACK : SLACK + count * size]
            if first < 2 or self._stream.readinto(target) < count * size:  # type: ignore[attr-defined]
                raise UnusualPageError("the file is cut off")
            return buffer, SLACK + (numbers - first) * size
        for index, page in enumerate(pages):
            begin = SLACK + index * size
            buffer[begin : begin + size] = np.frombuffer(self._page(page), dtype=np.uint8)
        return buffer, SLACK + np.arange(len(pages)) * size


def _varints(buffer: Bytes, at: Integers, ends: Integers) -> tuple[Integers, Integers]:
    """Read a variable-length integer at each place; return them and the places behind."""
    if (at >= ends).any():  # the slack of the buffer has room for a number that leaves a page
        raise UnusualPageError("a row leaves its page")
    values = np.zeros(len(at), dtype=np.int64)
    lengths = np.zeros(len(at), dtype=np.int64)
    is_open = np.ones(len(at), dtype=np.bool_)
    for index in range(_LONGEST_VARINT):
        byte = buffer[at + index]
        values = np.where(is_open, (values << 7) | (byte & 0x7F), values)
        lengths += is_open
        is_open = is_open & (byte >= 0x80)
        if not is_open.any():
            return values, at + lengths
    raise UnusualPageError("a number of more than 35 bits")


def _integers(buffer: Bytes, at: Integers, kinds: Integers) -> tuple[Integers, Integers]:
    """Read integers of the serial types 0 to 9; return them and the places behind."""
    sizes = _INTEGER_SIZES[kinds]
    words = gather_words(buffer, at + sizes - 8, 1)[:, 0].byteswap().view(np.int64)
    shifts = 64 - 8 * sizes
    values = np.where(sizes > 0, (words << np.minimum(shifts, 63)) >> np.minimum(shifts, 63), 0)
    return np.where(kinds == _ONE, 1, values), at + sizes


def _big(buffer: Bytes, at: Integers, size: int) -> Integers:
    """Read big-endian unsigned integers of a few bytes."""
    values = np.zeros(len(at), dtype=np.int64)
    for index in range(size):
        values = (values << 8) | buffer[at + index]
    return values

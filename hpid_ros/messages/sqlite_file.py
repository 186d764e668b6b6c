"""One SQLite file of rosbag2: of any schema version, past pages that are damaged."""

from __future__ import annotations

import io
import itertools
import shutil
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import BagError
from hpid_ros.messages.columns import (
    SLACK,
    Advance,
    Bytes,
    Integers,
    Report,
    TopicBatch,
    TopicInfo,
    batch_of,
    gather_words,
)

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


_BATCH_ROWS = 1 << 14
_BATCH_BYTES = 4 << 20
_FIRST_STEP = 16
"""Rows that are passed over after a damaged page; doubled as long as that does not help."""

_ROWS = (
    "SELECT rowid, topic_id, timestamp, data FROM messages "
    "WHERE rowid >= ? AND topic_id IN ({}) ORDER BY rowid"
)
_COLUMNS = [
    ("id", "INTEGER", 1),
    ("topic_id", "INTEGER", 0),
    ("timestamp", "INTEGER", 0),
    ("data", "BLOB", 0),
]
"""Name, type and place in the primary key."""

_FAILURES = (sqlite3.Error, UnicodeDecodeError)
"""What damage raises; the second when SQLite quotes it."""

_LONGEST_REASON = 200
_LARGEST_ID = 2**63 - 1
_HEAD = struct.Struct(">16xH6xII60xI4x")
"""Page size, change counter, page count, and the change for which that count was written."""

_LARGEST_PAGE = 65536
_STEPS_AT_ONCE = 1 << 20
_STEPS_PER_BYTE = 4
"""Instructions of SQLite for each byte of a file: a row has 12 bytes or more and takes some 10."""

Row = tuple[int, int, int, bytes]


class SqliteFile:
    """An open ``.db3`` file."""

    def __init__(self, path: Path, report: Report) -> None:
        path = path.resolve()  # a log lies beside the file, not beside a link to it
        if not path.is_file():
            raise BagError("no such file")
        self._size, self._steps = path.stat().st_size, 0
        with ExitStack() as stack:
            path, self._is_cut_off = _whole_pages(path, stack, report)
            self._connection, is_alone = _connected(path, self._is_cut_off, report)
            stack.callback(self._connection.close)
            self._connection.set_progress_handler(self._is_too_long, _STEPS_AT_ONCE)
            try:
                self._topics = self._read_topics()
                root = self._root_page() if is_alone else None
                stream = stack.enter_context(path.open("rb"))
                self._pages = None if root is None else PageReader(stream, root)
            except (*_FAILURES, BagError, UnusualPageError, OSError) as error:
                raise BagError(_line(error)) from error
            self._stack = stack.pop_all()

    def _is_too_long(self) -> bool:
        """Stop a query that takes more steps than the file has rows for: pages in a circle."""
        self._steps += _STEPS_AT_ONCE
        return self._steps > _STEPS_AT_ONCE + _STEPS_PER_BYTE * self._size

    def _read_topics(self) -> dict[str, tuple[list[int], TopicInfo]]:
        """Return the numbers of each topic and what is known of it, in the order of the names."""
        columns = self._columns("topics")
        if not {"id", "name", "type", "serialization_format"} <= columns:
            raise BagError("no bag: it has no table of topics")
        if not {"topic_id", "timestamp", "data"} <= self._columns("messages"):
            raise BagError("no bag: it has no table of messages")
        query = "SELECT id, name, type, serialization_format FROM topics"
        topics = self._connection.execute(query).fetchall()
        definitions: dict[str, str] = {}
        if self._columns("message_definitions"):
            query = "SELECT topic_type, encoded_message_definition FROM message_definitions"
            definitions = dict(self._connection.execute(query).fetchall())
        found: dict[str, tuple[list[int], TopicInfo]] = {}
        for number, name, kind, encoding in topics:
            if tuple(map(type, (number, name, kind, encoding))) != (int, str, str, str):
                raise BagError("a topic has no proper number, name or type")
            info = TopicInfo(kind, encoding, None, str(definitions.get(kind, "")))
            found.setdefault(name, ([], info))[0].append(number)
        return dict(sorted(found.items()))

    def _columns(self, table: str) -> set[str]:
        """Return the columns of a table; none if there is no such table."""
        row = self._connection.execute(
            "SELECT type, rootpage FROM sqlite_master "
            "WHERE name = ? COLLATE NOCASE AND type IN ('table', 'view')",
            (table,),
        ).fetchone()
        if row is None:
            return set()
        columns = self._connection.execute(f"PRAGMA table_xinfo({table})").fetchall()
        if row[0] != "table" or not row[1] or any(column[6] for column in columns):
            raise BagError(f"no bag: {table} is no plain table, but computed when it is read")
        return {column[1] for column in columns}

    def _root_page(self) -> int | None:
        """Return the root page of the messages if their table is as rosbag2 makes it."""
        columns = self._connection.execute("PRAGMA table_info(messages)").fetchall()
        if [(row[1], row[2], row[5]) for row in columns] != _COLUMNS:
            return None
        row = self._connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE type = 'table' AND name = 'messages' "
            "AND sql NOT LIKE '%WITHOUT%'"
        ).fetchone()
        return row[0] if row and isinstance(row[0], int) else None

    def topics(self) -> dict[str, TopicInfo]:
        """Return the topics by full name; counting their messages would read the whole file."""
        return {name: info for name, (_, info) in self._topics.items()}

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""
        self._steps = 0
        wanted = {name: numbers for name, (numbers, _) in self._topics.items() if name in topics}
        place, (following, largest) = 0, self._ids(report)
        span, first = max(largest - following, 1), following

        def advance() -> None:
            done(min(self._size, self._size * (following - first) // span))

        try:
            for found in self.pages():
                yield from self._of_pages(found, wanted, place, report)
                following, place = int(found.ids[-1]) + 1, place + len(found.ids)
                advance()
            is_whole = self._pages is not None
        except UnusualPageError:
            is_whole = False
        if not is_whole and self._is_cut_off and self._pages is not None:
            for found in self._pages.loose_rows(following):
                yield from self._of_pages(found, wanted, place, report)
                place += len(found.ids)
        elif not is_whole:  # SQLite knows what it is, or what is wrong with it
            for rows in self._batches_of_rows(wanted, following, largest, report):
                yield from self._of_rows(rows, wanted, place, report)
                following, place = rows[-1][0] + 1, place + len(rows)
                advance()
        done(self._size)

    def pages(self) -> Iterator[Rows]:
        """Yield rows straight from the pages, as far as these are as rosbag2 writes them."""
        if self._pages is not None:
            yield from self._pages.rows()

    def _of_pages(
        self, rows: Rows, wanted: Mapping[str, Sequence[int]], place: int, report: Report
    ) -> Iterator[TopicBatch]:
        """Yield rows of pages; those that go on elsewhere are read whole, in their order."""
        bounds = np.flatnonzero(np.diff(np.cumsum(np.maximum(-rows.sizes, 0)) // _BATCH_BYTES))
        for begin, end in itertools.pairwise((0, *(bounds + 1).tolist(), len(rows.ids))):
            part = slice(begin, end)
            for name, numbers in wanted.items():
                which = begin + np.flatnonzero(_is_one_of(rows.topic_ids[part], numbers))
                if not len(which):
                    continue
                sizes, times, places = rows.sizes[which], rows.times_ns[which], place + which
                if (sizes >= 0).all():
                    yield TopicBatch(name, rows.buffer, rows.starts[which], sizes, times, places)
                    continue
                raws = [self._raw(rows, index, report) for index in which.tolist()]
                is_there = np.array([raw is not None for raw in raws])
                if is_there.any():
                    whole = [raw for raw in raws if raw is not None]
                    yield batch_of(name, whole, times[is_there], places[is_there])

    def _raw(self, rows: Rows, index: int, report: Report) -> bytes | None:
        """Return the data of one row, or None if it cannot be read."""
        assert self._pages is not None
        try:
            return self._pages.data(rows, index)
        except UnusualPageError as error:
            report(f"row {int(rows.ids[index])} is left out: {error}")
            return None

    def _ids(self, report: Report) -> tuple[int, int]:
        """Return bounds of the row numbers."""
        try:
            query = "SELECT min(rowid), max(rowid) FROM messages"
            smallest, largest = self._connection.execute(query).fetchone()
        except _FAILURES:
            pass
        else:
            return (smallest, largest) if isinstance(smallest, int) else (1, 0)
        try:  # max() fails wherever a file is cut off
            (smallest,) = self._connection.execute("SELECT min(rowid) FROM messages").fetchone()
        except _FAILURES as error:
            if not self._is_cut_off:
                report(f"the first rows are damaged: {_line(error)}")
            smallest = 1
        return (smallest if isinstance(smallest, int) else 1), _LARGEST_ID

    def _batches_of_rows(
        self,
        wanted: Mapping[str, Sequence[int]],
        following: int,
        largest: int,
        report: Report,
    ) -> Iterator[list[Row]]:
        """Yield rows in the order of their ids, passing over pages that cannot be read."""
        numbers = itertools.chain.from_iterable(wanted.values())
        query = _ROWS.format(",".join(map(str, numbers)))
        step, damaged_from, reason = _FIRST_STEP, following, ""
        rows: list[Row] = []
        while following <= largest:
            try:
                with closing(self._connection.execute(query, (following,))) as cursor:
                    size = 0
                    for row in cursor:
                        if row[0] < following:
                            raise sqlite3.DatabaseError("rows are not in order")
                        if reason:
                            report(f"rows {damaged_from} to {row[0] - 1} are damaged, left out")
                            step, reason = _FIRST_STEP, ""
                        rows.append(row)
                        following = row[0] + 1
                        size += len(row[3]) if type(row[3]) is bytes else 0
                        if len(rows) == _BATCH_ROWS or size >= _BATCH_BYTES:
                            yield rows
                            rows, size = [], 0
                break
            except _FAILURES as error:
                if not reason:
                    damaged_from, reason = following, _line(error)
                following, step = following + step, 2 * step
        if rows:
            yield rows
        if reason:
            report(f"rows from {damaged_from} on are left out: {reason}")

    def _of_rows(
        self,
        rows: Sequence[Row],
        wanted: Mapping[str, Sequence[int]],
        place: int,
        report: Report,
    ) -> Iterator[TopicBatch]:
        kept = [row for row in rows if tuple(map(type, row)) == (int, int, int, bytes)]
        if len(kept) < len(rows):  # a damaged row holds anything
            report(f"{len(rows) - len(kept)} rows are no messages, left out")
        if not kept:
            return
        _, owners, times, blobs = zip(*kept, strict=True)
        owner, time = (np.array(each, dtype=np.int64) for each in (owners, times))
        whole = batch_of("", blobs, time, place + np.arange(len(kept)))
        for name, numbers in wanted.items():
            is_own = _is_one_of(owner, numbers)
            if is_own.any():
                yield TopicBatch(name, whole.buffer, *(part[is_own] for part in whole[2:]))


def _is_one_of(owners: Integers, numbers: Sequence[int]) -> NDArray[np.bool_]:
    return owners == numbers[0] if len(numbers) == 1 else np.isin(owners, numbers)


def _line(error: Exception) -> str:
    """Return an error's text as one line; SQLite quotes what it found in the file."""
    return " ".join(str(error).split())[:_LONGEST_REASON]


def _whole_pages(path: Path, stack: ExitStack, report: Report) -> tuple[Path, bool]:
    """Return a file all of whose pages are whole, and whether pages are missing at its end.

    SQLite takes what is missing of the last page to be zeros, so that its rows would be wrong: a
    file that ends within a page is copied up to there.
    """
    if _is_filled(path, "-wal"):  # the log has the pages, and their count
        return path, False
    with path.open("rb") as stream:
        head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return path, False
    page, change, count, of_change = _HEAD.unpack(head)
    page = _LARGEST_PAGE if page == 1 else page
    size = path.stat().st_size
    whole = page * count if change == of_change else 0
    if size < whole:
        report(f"it is cut off: {size} of {whole} bytes are there")
    elif page and size % page:
        report(f"it ends within a page of {page} bytes")
    if not page or not size % page:
        return path, size < whole
    copy = Path(stack.enter_context(TemporaryDirectory(prefix="hpid_bag_"))) / path.name
    with path.open("rb") as source, copy.open("wb") as target:
        shutil.copyfileobj(source, target)
        target.truncate(size - size % page)
    return copy, size < whole


def _is_filled(path: Path, suffix: str) -> bool:
    beside = path.with_name(f"{path.name}{suffix}")
    return beside.is_file() and beside.stat().st_size > 0


def _connected(path: Path, is_cut_off: bool, report: Report) -> tuple[sqlite3.Connection, bool]:
    """Open a file for reading, with its log if there is one; tell whether it is all there is."""
    has_log, has_journal = _is_filled(path, "-wal"), _is_filled(path, "-journal")
    if has_journal:
        report("the recorder was stopped in a transaction; messages may be missing")
    for mode in ("mode=ro", "immutable=1") if has_log else ("immutable=1",):
        try:
            connection = sqlite3.connect(f"file:{quote(str(path))}?{mode}", uri=True)
            if is_cut_off:
                # Without it SQLite opens no file with fewer pages than the header counts.
                connection.execute("PRAGMA writable_schema=ON")
            connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except _FAILURES as error:
            failure = error
            continue
        if has_log and mode != "mode=ro":
            report("its write-ahead log cannot be read; messages are missing")
        return connection, not (has_log or has_journal)
    raise BagError(_line(failure))

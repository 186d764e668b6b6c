"""The messages of one SQLite file of a bag, as far as damage has left them."""

from __future__ import annotations

import itertools
import operator
import shutil
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

import numpy as np

from hpid_ros.base.errors import BagError
from hpid_ros.messages.columns import TopicBatch, TopicInfo, batch_of
from hpid_ros.messages.mcap_file import Advance, Report

_BATCH_ROWS = 1 << 14
_LOOKED_AT = 64
"""Rows of a batch whose sizes tell how many come next."""
_BATCH_BYTES = 4 << 20
_FIRST_STEP = 16
"""Rows that are passed over after a damaged page; doubled as long as that does not help."""

_EVERY_ROW = (
    "SELECT rowid, topic_id, timestamp, data FROM messages WHERE rowid >= ? ORDER BY rowid"
)
_ROWS = _EVERY_ROW.replace(" ORDER", " AND topic_id IN ({}) ORDER")
_FAILURES = (sqlite3.Error, UnicodeDecodeError)
"""What damage raises; the second when SQLite quotes it."""

_KINDS = (int, int, int, bytes)
"""Of a row's columns."""

_LONGEST_REASON = 200
_LARGEST_ID = 2**63 - 1
_HEAD = struct.Struct(">16xH6xII60xI4x")
"""Page size, change counter, page count, and the change for which that count was written."""

_LARGEST_PAGE = 65536
_STEPS_AT_ONCE = 1 << 20
_STEPS_PER_BYTE = 4
"""Instructions of SQLite for each byte of a file: a row has 12 bytes or more and takes some 10."""

Columns = list[tuple[Any, ...]]
"""Numbers of rows, of topics, times in [ns] and contents of some messages."""


class SqliteFile:
    def __init__(self, path: Path, report: Report) -> None:
        path = path.resolve()  # a log lies next to the file, not next to a link to it
        if not path.is_file():
            raise BagError("no such file")
        self._size, self._steps = path.stat().st_size, 0
        with ExitStack() as stack:
            path, is_cut_off = _whole_pages(path, stack, report)
            self._connection = _connected(path, is_cut_off, report)
            stack.callback(self._connection.close)
            self._connection.set_progress_handler(self._is_too_long, _STEPS_AT_ONCE)
            try:
                self._topics = self._read_topics()
            except (*_FAILURES, BagError) as error:
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
        qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        query = f"SELECT id, name, type, serialization_format, {qos} FROM topics"
        topics = self._connection.execute(query).fetchall()
        definitions: dict[str, str] = {}
        if self._columns("message_definitions"):
            query = "SELECT topic_type, encoded_message_definition FROM message_definitions"
            definitions = dict(self._connection.execute(query).fetchall())
        found: dict[str, tuple[list[int], TopicInfo]] = {}
        for number, name, kind, encoding, profiles in topics:
            if tuple(map(type, (number, name, kind, encoding))) != (int, str, str, str):
                raise BagError("a topic has no proper number, name or type")
            info = TopicInfo(kind, encoding, str(definitions.get(kind, "")), str(profiles or ""))
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

    def topics(self) -> dict[str, TopicInfo]:
        """Return the topics by full name; counting their messages would read the whole file."""
        return {name: info for name, (_, info) in self._topics.items()}

    def close(self) -> None:
        self._stack.close()

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""
        self._steps = 0
        wanted = {name: numbers for name, (numbers, _) in self._topics.items() if name in topics}
        place, (following, largest) = 0, self._ids(report)
        span, first = max(largest - following, 1), following

        for columns in self._batches_of_rows(wanted, following, largest, report):
            yield from self._of_rows(columns, wanted, place, report)
            place += len(columns[0])
            done(min(self._size, self._size * (columns[0][-1] + 1 - first) // span))
        done(self._size)

    def _ids(self, report: Report) -> tuple[int, int]:
        """Return bounds of the row numbers."""
        try:
            query = "SELECT min(rowid), max(rowid) FROM messages"
            smallest, largest = self._connection.execute(query).fetchone()
        except _FAILURES:
            pass
        else:
            return (smallest, largest) if isinstance(smallest, int) else (1, 0)
        try:
            (smallest,) = self._connection.execute("SELECT min(rowid) FROM messages").fetchone()
        except _FAILURES as error:
            report(f"the first rows are damaged: {_line(error)}")
            smallest = 1
        return (smallest if isinstance(smallest, int) else 1), _LARGEST_ID

    def _batches_of_rows(
        self, wanted: Mapping[str, Sequence[int]], following: int, largest: int, report: Report
    ) -> Iterator[Columns]:
        """Yield rows in the order of their ids, passing over pages that cannot be read."""
        numbers = set(itertools.chain.from_iterable(wanted.values()))
        every = set(itertools.chain.from_iterable(own for own, _ in self._topics.values()))
        query = _EVERY_ROW if numbers == every else _ROWS.format(",".join(map(str, numbers)))
        step, damaged_from, reason = _FIRST_STEP, following, ""
        count = 1
        while following <= largest:
            try:
                with closing(self._connection.execute(query, (following,))) as cursor:
                    while rows := cursor.fetchmany(count):
                        ids = [following - 1, *(row[0] for row in rows)]
                        falls = list(map(operator.ge, ids, ids[1:]))
                        whole = rows[: falls.index(True)] if any(falls) else rows
                        if whole:
                            if reason:
                                first = whole[0][0]
                                report(f"rows {damaged_from} to {first - 1} are damaged, left out")
                                step, reason = _FIRST_STEP, ""
                            following = whole[-1][0] + 1
                            yield list(zip(*whole, strict=True))
                        if len(whole) < len(rows):
                            count = 1
                            raise sqlite3.DatabaseError("rows are not in order")
                        some = rows[:: 1 + len(rows) // _LOOKED_AT]
                        size = sum(len(row[3]) for row in some if type(row[3]) is bytes)
                        few = len(some) * _BATCH_BYTES // max(size, 1)
                        count = max(1, min(2 * count, few, _BATCH_ROWS))
                break
            except _FAILURES as error:
                if count > 1:  # some of those that were asked for may be whole
                    count = 1
                    continue
                if not reason:
                    damaged_from, reason = following, _line(error)
                following, step = following + step, 2 * step
        if reason:
            report(f"rows from {damaged_from} on are left out: {reason}")

    def _of_rows(
        self,
        columns: Columns,
        wanted: Mapping[str, Sequence[int]],
        place: int,
        report: Report,
    ) -> Iterator[TopicBatch]:
        if any(set(map(type, each)) != {kind} for each, kind in zip(columns, _KINDS, strict=True)):
            rows = list(zip(*columns, strict=True))  # a damaged one holds anything
            kept = [row for row in rows if tuple(map(type, row)) == _KINDS]
            report(f"{len(rows) - len(kept)} rows are no messages, left out")
            if not kept:
                return
            columns = list(zip(*kept, strict=True))
        _, owners, times, blobs = columns
        count = len(blobs)
        owner, time = (np.array(each, dtype=np.int64) for each in (owners, times))
        whole = batch_of("", blobs, time, place + np.arange(count))
        for name, numbers in wanted.items():
            is_own = np.isin(owner, numbers)
            if is_own.any():
                yield whole.picked(is_own)._replace(topic=name)


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
    file = path.with_name(f"{path.name}{suffix}")
    return file.is_file() and file.stat().st_size > 0


def _connected(path: Path, is_cut_off: bool, report: Report) -> sqlite3.Connection:
    """Open a file for reading, with its log if there is one."""
    has_log = _is_filled(path, "-wal")
    if _is_filled(path, "-journal"):
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
        return connection
    raise BagError(_line(failure))

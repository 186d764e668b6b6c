"""One SQLite file of rosbag2: of any schema version, past pages that are damaged."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

import numpy as np

from hpid_ros.bags.batches import SLACK, Advance, Integers, Report, TopicBatch, TopicInfo
from hpid_ros.bags.sqlite_pages import PageReader, Rows, UnusualPageError
from hpid_ros.errors import BagError

_BATCH_ROWS = 1 << 14
_FIRST_STEP = 16
"""Rows that are passed over after a damaged page; doubled as long as that does not help."""

_ROWS = (
    "SELECT rowid, topic_id, timestamp, data FROM messages "
    "WHERE rowid > ? AND topic_id IN ({}) ORDER BY rowid"
)
_ROW = "SELECT rowid, topic_id, timestamp, data FROM messages WHERE rowid = ?"
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
_SLACK_BYTES = bytes(SLACK)


class SqliteFile:
    """An open ``.db3`` file.

    Args:
        path: The file; a write-ahead log beside it is read too.
        report: Takes a line about what cannot be read while opening.

    Raises:
        BagError: The file cannot be opened, or its topics cannot be read.
    """

    def __init__(self, path: Path, report: Report) -> None:
        if not path.is_file():
            raise BagError("no such file")
        self._path, self._size = path, path.stat().st_size
        self._connection, is_alone = _connected(path, report)
        try:
            self._topics = self._read_topics()
            self._root = self._root_page() if is_alone else None
        except (*_FAILURES, BagError) as error:
            self._connection.close()
            raise BagError(_line(error)) from error

    def _read_topics(self) -> dict[int, tuple[str, TopicInfo]]:
        with closing(self._connection.cursor()) as cursor:
            columns = [row[1] for row in cursor.execute("PRAGMA table_info(topics)")]
            if not {"id", "name", "type", "serialization_format"} <= set(columns):
                raise BagError("no bag: it has no table of topics")
            rows = cursor.execute("SELECT id, name, type, serialization_format FROM topics")
            topics = rows.fetchall()
            definitions: dict[str, str] = {}
            if cursor.execute("PRAGMA table_info(message_definitions)").fetchall():
                rows = cursor.execute(
                    "SELECT topic_type, encoded_message_definition FROM message_definitions"
                )
                definitions = dict(rows.fetchall())
        found = {}
        for number, name, kind, encoding in topics:
            if tuple(map(type, (number, name, kind, encoding))) != (int, str, str, str):
                raise BagError("a topic has no proper number, name or type")
            info = TopicInfo(kind, encoding, None, str(definitions.get(kind, "")))
            found[number] = (name, info)
        return found

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
        return dict(self._topics.values())

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised.

        Args:
            topics: Full names.
            report: Takes one line about each part that cannot be read.
            done: Takes the number of bytes that are done.
        """
        numbers = [n for n, (name, _) in self._topics.items() if name in topics]
        last, largest = 0, self._largest_id()
        try:
            for found in self.pages():
                last = int(found.ids[-1])
                yield from self._of_pages(found, numbers, report)
                done(min(self._size, self._size * last // max(largest, 1)))
        except UnusualPageError:
            pass  # SQLite knows what it is, or what is wrong with it
        for rows in self._batches_of_rows(numbers, last, largest, report):
            last = rows[-1][0]
            yield from self._by_topic(rows, report)
            done(min(self._size, self._size * last // max(largest, 1)))
        done(self._size)

    def pages(self) -> Iterator[Rows]:
        """Yield rows straight from the pages, as far as these are as rosbag2 writes them.

        Raises:
            UnusualPageError: They are not; what was yielded before is right.
        """
        if self._root is None:
            return
        with self._path.open("rb") as stream:
            yield from PageReader(stream, self._root).rows()

    def _of_pages(
        self, rows: Rows, numbers: Sequence[int], report: Report
    ) -> Iterator[TopicBatch]:
        for number in numbers:
            which = np.flatnonzero((rows.topic_ids == number) & (rows.sizes >= 0))
            if len(which):
                columns = (rows.starts, rows.sizes, rows.times_ns, rows.ids)
                parts = (column[which] for column in columns)
                yield TopicBatch(self._topics[number][0], rows.buffer, *parts)
        is_elsewhere = (rows.sizes < 0) & np.isin(rows.topic_ids, numbers)
        for identity in rows.ids[is_elsewhere].tolist():
            try:
                row = self._connection.execute(_ROW, (identity,)).fetchone()
            except _FAILURES as error:
                report(f"row {identity} is left out: {_line(error)}")
            else:
                yield from self._by_topic([row], report)

    def _largest_id(self) -> int:
        try:
            (largest,) = self._connection.execute("SELECT max(rowid) FROM messages").fetchone()
        except _FAILURES:
            return 0
        return largest or 0

    def _batches_of_rows(
        self, numbers: Sequence[int], last: int, largest: int, report: Report
    ) -> Iterator[list[tuple[int, int, int, bytes]]]:
        """Yield rows in the order of their ids, passing over pages that cannot be read."""
        query = _ROWS.format(",".join(map(str, numbers)))
        step, count, damaged_from = _FIRST_STEP, _BATCH_ROWS, 0
        while True:
            try:
                with closing(self._connection.execute(query, (last,))) as cursor:
                    while rows := cursor.fetchmany(count):
                        if damaged_from:
                            report(
                                f"rows {damaged_from} to {rows[0][0] - 1} are damaged, left out"
                            )
                            step, count, damaged_from = _FIRST_STEP, _BATCH_ROWS, 0
                        last = rows[-1][0]
                        yield rows
                break
            except _FAILURES as error:
                if count > 1:  # rows that came before the damage are lost with a large batch
                    count = 1
                    continue
                damaged_from = damaged_from or last + 1
                last, step = last + step, 2 * step
                if last >= largest:
                    report(f"rows from {damaged_from} on are left out: {_line(error)}")
                    return
        if damaged_from:
            report(f"rows from {damaged_from} on are damaged, left out")

    def _by_topic(
        self, rows: Sequence[tuple[int, int, int, bytes]], report: Report
    ) -> Iterator[TopicBatch]:
        ids, owners, times, blobs = zip(*rows, strict=True)
        try:
            buffer = np.frombuffer(b"".join((_SLACK_BYTES, *blobs, _SLACK_BYTES)), dtype=np.uint8)
            place, owner, time = (_integers(each, len(rows)) for each in (ids, owners, times))
        except (TypeError, ValueError, OverflowError):  # a damaged row holds anything
            kept = [row for row in rows if tuple(map(type, row)) == (int, int, int, bytes)]
            report(f"{len(rows) - len(kept)} rows are no messages, left out")
            if 0 < len(kept) < len(rows):
                yield from self._by_topic(kept, report)
            return
        sizes = _integers(map(len, blobs), len(rows))
        starts = SLACK + np.cumsum(sizes) - sizes
        for number, (name, _) in self._topics.items():
            is_own = owner == number
            if is_own.any():
                parts = (part[is_own] for part in (starts, sizes, time, place))
                yield TopicBatch(name, buffer, *parts)


def _line(error: Exception) -> str:
    """Return an error's text as one line; SQLite quotes what it found in the file."""
    return " ".join(str(error).split())[:_LONGEST_REASON]


def _integers(values: object, count: int) -> Integers:
    return np.fromiter(values, np.int64, count)  # type: ignore[call-overload, no-any-return]


def _connected(path: Path, report: Report) -> tuple[sqlite3.Connection, bool]:
    """Open a file for reading, with its log if there is one; tell whether it is all there is."""
    log = path.with_name(f"{path.name}-wal")
    has_log = log.exists() and log.stat().st_size > 0
    journal = path.with_name(f"{path.name}-journal")
    has_journal = journal.exists() and journal.stat().st_size > 0
    if has_journal:
        report("the recorder was stopped in a transaction; messages may be missing")
    for mode in ("mode=ro", "immutable=1") if has_log else ("immutable=1",):
        try:
            connection = sqlite3.connect(f"file:{quote(str(path))}?{mode}", uri=True)
            connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except _FAILURES as error:
            failure = error
            continue
        if has_log and mode != "mode=ro":
            report("its write-ahead log cannot be read; messages are missing")
        return connection, not (has_log or has_journal)
    raise BagError(_line(failure))

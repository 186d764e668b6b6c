"""An open bag: its files, MCAP or SQLite, its metadata, and its messages in batches.

A recorder that was slower than what it recorded, or frozen for a while, knows from the middleware
how many messages it never got. Where it stood still for longer than a publisher's lease (an hour
with the profile of an experiment, else 20 s) the two forget each other, and nobody counts: how
long it stood still is recorded, too. The stamps of a stream show all that as gaps, where they are
regular.
"""

from __future__ import annotations

import itertools
import json
import math
import operator
import os
import shutil
import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Protocol, TypeVar
from urllib.parse import quote

import numpy as np

from hpid_ros.base.errors import BagError, listed_names
from hpid_ros.base.files import other_kind
from hpid_ros.base.processes import optional_libraries
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.messages.columns import TopicBatch, TopicInfo, batch_of, count_difference
from hpid_ros.messages.mcap_file import (
    MAGIC,
    Advance,
    Allowance,
    McapFile,
    Report,
    decompressed_message,
    unpack_file,
)

if TYPE_CHECKING:
    from typing_extensions import Self

_Content = TypeVar("_Content", dict[str, Any], list[Any])

METADATA = "metadata.yaml"
ROS1 = "ros1"
"""What MCAP calls messages as ROS 1 serialises them."""
_KEY = "rosbag2_bagfile_information"


def read_metadata(folder: Path) -> Mapping[str, Any]:
    path = folder / METADATA
    if not path.is_file():
        raise BagError(f"{METADATA} is {'no file' if path.exists() else 'missing'}")
    found = path.stat()
    return _metadata_of(path, (found.st_ino, found.st_mtime_ns, found.st_size))


@lru_cache(maxsize=16)
def _metadata_of(path: Path, version: tuple[int, ...]) -> dict[str, Any]:
    """Return what a file says as it is now: a bag's label is looked up before it is opened."""
    document = load_yaml(path, BagError)
    metadata = document.get(_KEY) if isinstance(document, Mapping) else None
    if not isinstance(metadata, dict):
        raise BagError(f"cannot read {path}: it does not say {_KEY}")
    return metadata


def custom_data(bag: Path) -> dict[str, str]:
    """Return the texts that a recording was given; none for a damaged one.

    A single file has those of the folder in which it is, if that folder's metadata name it.
    """
    folder = bag if bag.is_dir() else bag.parent
    try:
        metadata = read_metadata(folder)
    except BagError:  # what is wrong with a bag is said when it is read
        return {}
    return {} if folder is not bag and bag.name not in _files(metadata) else _texts(metadata)


def _texts(metadata: Mapping[str, Any]) -> dict[str, str]:
    """Return the own entries that are texts, as all that rosbag2 writes are."""
    custom = metadata.get("custom_data")
    entries = custom.items() if isinstance(custom, Mapping) else ()
    return {k: v for k, v in entries if isinstance(k, str) and isinstance(v, str)}


def _files(metadata: Mapping[str, Any]) -> set[str]:
    named = metadata.get("relative_file_paths")
    return {Path(str(name)).name for name in named} if isinstance(named, list) else set()


def counts_of(metadata: Mapping[str, Any]) -> dict[str, int]:
    """Return how many messages of each topic the metadata counts."""
    counts: dict[str, int] = {}
    try:
        for each in metadata["topics_with_message_count"]:
            name, count = each["topic_metadata"]["name"], int(each["message_count"])
            counts[str(name)] = counts.get(str(name), 0) + count
    except (KeyError, TypeError, ValueError, OverflowError):
        return {}
    return counts


MISSED = "hpid_ros/missed_messages"
"""Name of the entry with the counts: JSON, by topic."""

STOOD_STILL = "hpid_ros/stood_still"
"""Name of the entry with the time that the recorder stood still, in [s]."""


def missed_entries(missed: Mapping[str, int], stood_still: float) -> dict[str, str]:
    counts = json.dumps(dict(missed), sort_keys=True)
    return {MISSED: counts, STOOD_STILL: f"{stood_still:.3f}"}


def missed_messages(metadata: Mapping[str, str]) -> dict[str, int]:
    """Return the messages that a bag's recorder missed, by topic; only those that missed some."""
    entry = _parsed(metadata, MISSED, dict)
    return {topic: count for topic, count in entry.items() if type(count) is int and count > 0}


def time_stood_still(metadata: Mapping[str, str]) -> float:
    """Return how long a bag's recorder stood still, in [s]; zero if it did not or did not say."""
    try:
        seconds = float(metadata.get(STOOD_STILL, "0"))
    except ValueError:
        return 0.0
    return seconds if math.isfinite(seconds) and seconds > 0.0 else 0.0


SLIDES = "hpid_ros/slides"
"""Name of the entry with the joints that slide, whose units are m and N: JSON, a list."""


def slides_entry(slides: Collection[str]) -> dict[str, str]:
    """Return the entry for the metadata; none where no joint slides."""
    return {SLIDES: json.dumps(sorted(slides))} if slides else {}


def recorded_slides(metadata: Mapping[str, str]) -> frozenset[str]:
    """Return the joints that a bag's recorder knew to slide."""
    return frozenset(each for each in _parsed(metadata, SLIDES, list) if isinstance(each, str))


def _parsed(metadata: Mapping[str, str], name: str, kind: type[_Content]) -> _Content:
    """Return the content of an entry of JSON; an empty one where there is none of that kind."""
    try:
        content = json.loads(str(metadata.get(name)))
    except (ValueError, RecursionError):
        return kind()
    return content if isinstance(content, kind) else kind()


PARAMETERS = "hpid_ros/controllers"
"""Name of the entry with the parameters of the controllers as they began: a ROS parameter file."""

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


_SUFFIXES = (".mcap", ".db3", ".bag")
_MAGICS = {MAGIC: ".mcap", b"SQLite format 3\0": ".db3", b"#ROSBAG V": ".bag"}
_LONGEST_MAGIC = max(map(len, _MAGICS))
_ZSTD = (".zstd", ".zst")  # rosbag2's, zstd's own
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # no message begins so: CDR begins with 0
_MOST_NAMES = 10
_MOST_LINES = 50
"""Lines about what cannot be read; a file can be made to have any number."""
_PLACES_PER_FILE = 1 << 48
"""Above every place in one file, so that places order the messages of all files."""


class BagFile(Protocol):
    """A file of a bag."""

    def topics(self) -> dict[str, TopicInfo]: ...

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]: ...

    def close(self) -> None: ...


Progress = Callable[[float], None]
"""Takes the share of a bag that has been read, in [0, 1]."""


def no_progress(share: float) -> None:
    pass


class Storage:
    """An open bag of any storage and compression that rosbag2 writes."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if self.path.name == METADATA:
            self.path = self.path.parent
        self.unreadable: list[str] = []
        self._further = 0
        self._stack = ExitStack()
        if not self.path.exists():
            raise BagError(f"no bag at {self.path}: no such file or folder")
        metadata = self._metadata() if self.path.is_dir() else {}
        self._is_by_message = str(metadata.get("compression_mode", "")).lower() == "message"
        self._counts = counts_of(metadata)
        self.custom_data = _texts(metadata) if metadata else custom_data(self.path)
        self._files: list[tuple[BagFile, Report, int]] = []
        try:
            paths = self._paths(metadata)
        except BagError:
            self.close()
            raise
        for file in paths:
            try:
                self._open(file)
            except BagError as error:
                self._report(f"{file.name}: {error}")
        if not self._files:
            self.close()
            raise BagError(f"cannot read bag {self.path}: {'; '.join(self.unreadable)}")

    def _report(self, line: str) -> None:
        if line in self.unreadable:
            return
        if len(self.unreadable) < _MOST_LINES:
            self.unreadable.append(line)
        else:
            self._further += 1
            self.unreadable[_MOST_LINES:] = [f"{self._further} further lines like these"]

    def _metadata(self) -> Mapping[str, Any]:
        """Return what ``metadata.yaml`` says; nothing if it is missing or damaged."""
        if not (self.path / METADATA).exists():
            if all(_suffix(file) == ".bag" for file in _bag_files(self.path)):
                return {}  # ROS 1 has none
            self._report("metadata.yaml is missing, as after a recorder that was stopped by force")
            return {}
        try:
            return read_metadata(self.path)
        except BagError as error:
            self._report(f"metadata.yaml is damaged; the files were read without it ({error})")
            return {}

    def _paths(self, metadata: Mapping[str, Any]) -> list[Path]:
        """Return the files of the bag in their order."""
        if not self.path.is_dir():
            return [self.path]
        named = metadata.get("relative_file_paths")
        if isinstance(named, list) and named and all(isinstance(name, str) for name in named):
            # Before version 4 the paths began at the bag's parent folder.
            return self._in_place_of([self.path / Path(name).name for name in named])
        bags = bags_in(self.path)
        if len(bags) > 1 or (bags and bags[0] != self.path):
            raise BagError(f"{self.path} is a folder of bags, name one: {_names(bags)}")
        found = _bag_files(self.path)
        if not found:
            raise BagError(f"no bag at {self.path}: the folder has no .mcap, .db3 or .bag file")
        return found

    def _in_place_of(self, named: list[Path]) -> list[Path]:
        """Return files that metadata name, and for those that are missing others of the folder.

        Files are renamed by hand, and their old metadata stays.
        """
        missing = [file for file in named if not os.path.lexists(file)]
        known = {_unpacked_name(file) for file in named if file not in missing}
        others = [file for file in _bag_files(self.path) if _unpacked_name(file) not in known]
        if not others:
            return named
        gone, there = _names(missing), _names(others)
        if not missing:
            self._report(f"metadata.yaml does not name {there}, not read: name a file to read it")
            return named
        if len(others) > len(missing):
            raise BagError(
                f"bag {self.path}: metadata.yaml names {gone}, missing here, and not {there}: "
                "name the file that is to be read"
            )
        self._report(
            f"metadata.yaml names {gone}, missing here: {there} was read instead, as if renamed"
        )
        if len(named) == len(missing):
            return others
        present = [file for file in named if file not in missing]
        return sorted([*present, *others], key=_natural_order)

    def _open(self, path: Path) -> None:
        try:
            found = path.stat()
        except FileNotFoundError:
            raise BagError("the file is missing") from None
        except OSError as error:
            raise BagError(str(error.strerror or error)) from None
        if kind := other_kind(path):  # some can be opened, and never end
            raise BagError(f"it is a {kind}, not a file")
        size = found.st_size
        name = path.name

        def report(line: str) -> None:
            self._report(f"{name}: {line}")

        if path.suffix in _ZSTD:
            path = self._decompressed(path, report)
        file = _opened(path, report)
        self._stack.callback(file.close)
        self._files.append((file, report, size))

    def _decompressed(self, path: Path, report: Report) -> Path:
        """Unpack a file into a temporary folder, as far as it goes."""
        folder = self._stack.enter_context(TemporaryDirectory(prefix="hpid_bag_"))
        unpacked = Path(folder) / path.stem
        try:
            if not unpack_file(path, unpacked, Allowance()):
                report("it is damaged or cut off; what could be unpacked was read")
        except OSError as error:
            raise BagError(f"it cannot be unpacked: {error.strerror or error}") from error
        return unpacked

    def topics(self) -> dict[str, TopicInfo]:
        """Return the topics of all files by full name; those of ROS 1 as they are in ROS 2."""
        topics: dict[str, TopicInfo] = {}
        for file, _, _ in self._files:
            for name, raw in file.topics().items():
                info = _as_ros2(raw) if raw.encoding == ROS1 else raw
                before = topics.get(name)
                if before is None:
                    topics[name] = info
                elif before.type != info.type:
                    raise BagError(
                        f"bag {self.path}: topic {name} is {before.type} in one file and "
                        f"{info.type} in another"
                    )
        return topics

    def batches(
        self, topics: frozenset[str], progress: Progress = no_progress
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics, file by file.

        What cannot be read is in :attr:`unreadable` afterwards.
        """
        whole = max(sum(size for _, _, size in self._files), 1)
        before, found = 0, dict.fromkeys(topics, 0)
        for number, (file, report, size) in enumerate(self._files):

            def done(position: int, before: int = before, size: int = size) -> None:
                progress(min((before + min(position, size)) / whole, 1.0))

            allowance = Allowance()
            ros1 = self._of_ros1(file)
            for batch in file.batches(topics, report, done):
                found[batch.topic] += len(batch.starts)
                batch = batch._replace(places=batch.places + number * _PLACES_PER_FILE)
                is_compressed = len(batch.starts) and batch.raw(0).startswith(_ZSTD_MAGIC)
                if self._is_by_message or is_compressed:  # the metadata may be missing
                    batch = self._without_compression(batch, allowance)
                if batch.topic in ros1:
                    from hpid_ros.messages.ros1 import converted

                    batch = converted(batch, ros1[batch.topic], report)
                if len(batch.starts):
                    yield batch
            before += size
        progress(1.0)
        known = self.topics()
        counts = {n: count for n, count in self._counts.items() if n in topics or n not in known}
        line = count_difference(counts, found)
        if line:
            self._report(f"metadata.yaml counts {line}")

    def _of_ros1(self, file: BagFile) -> dict[str, str]:
        """Return the types of a file's topics whose messages are converted."""
        found = {name: info for name, info in file.topics().items() if info.encoding == ROS1}
        known = {name: _as_ros2(info) for name, info in found.items()}
        return {name: info.type for name, info in known.items() if info.encoding != ROS1}

    @property
    def is_of_ros1(self) -> bool:
        """Whether a file holds messages of ROS 1."""
        every = (info for file, _, _ in self._files for info in file.topics().values())
        return any(info.encoding == ROS1 for info in every)

    def _without_compression(self, batch: TopicBatch, allowance: Allowance) -> TopicBatch:
        """Decompress each message of a batch."""
        raws: list[bytes] = []
        kept: list[int] = []
        reason = ""
        for index, raw in enumerate(batch.raws()):
            try:
                raws.append(decompressed_message(raw, allowance))
            except BagError as error:
                reason = reason or str(error)
                continue
            kept.append(index)
        if reason:
            self._report(
                f"messages on {batch.topic} cannot be decompressed and are left out, the first "
                f"recorded at {int(batch.log_times_ns[0])} ns or later: {reason}"
            )
        return batch_of(batch.topic, raws, batch.log_times_ns[kept], batch.places[kept])

    def close(self) -> None:
        """Close all files; does nothing the second time."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


@contextmanager
def opened(bag: Path | str | Storage) -> Iterator[Storage]:
    """Open a bag; one that is open is lent, and what cannot be read meanwhile is not kept."""
    if isinstance(bag, Storage):
        before = list(bag.unreadable)
        try:
            yield bag
        finally:
            bag.unreadable[:] = before
        return
    with Storage(bag) as storage:
        yield storage


def bags_in(folder: Path) -> list[Path]:
    """Return the bags that a folder holds, in natural order: itself if it is one.

    Files without metadata are one bag if they are numbered parts of one name, as a recorder
    splits them; else each is a bag, and so is each folder that holds files of bags.
    """
    if (folder / METADATA).exists():
        return [folder]
    files = _bag_files(folder)
    if files and len({_natural_order(file)[0] for file in files}) == 1:
        return [folder]
    below = (each for each in folder.iterdir() if each.is_dir())
    bags = [each for each in below if (each / METADATA).is_file() or _bag_files(each)]
    return sorted([*files, *bags], key=_natural_order)


def _bag_files(folder: Path) -> list[Path]:
    found = [file for file in folder.iterdir() if _suffix(file) in _SUFFIXES]
    return sorted(found, key=_natural_order)


def _unpacked_name(path: Path) -> str:
    return path.stem if path.suffix in _ZSTD else path.name


def _names(paths: Sequence[Path]) -> str:
    return listed_names([path.name for path in paths], _MOST_NAMES)


def _opened(path: Path, report: Report) -> BagFile:
    """Open a file by what it begins with; by its name where that is damaged."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_LONGEST_MAGIC)
    except OSError as error:
        raise BagError(str(error.strerror or error)) from None
    kinds = [suffix for magic, suffix in _MAGICS.items() if head.startswith(magic)]
    suffix = kinds[0] if kinds else path.suffix
    if suffix == ".mcap":
        return McapFile(path, report)
    if suffix == ".db3":
        return SqliteFile(path, report)
    if suffix != ".bag":
        raise BagError("neither MCAP (.mcap) nor SQLite (.db3) nor a bag of ROS 1 (.bag)")
    with optional_libraries():
        from hpid_ros.messages.ros1 import RosbagFile

        return RosbagFile(path, report)


def _as_ros2(info: TopicInfo) -> TopicInfo:
    with optional_libraries():
        from hpid_ros.messages.ros1 import as_ros2

        return as_ros2(info)


def _suffix(path: Path) -> str:
    """Return ``.mcap``, ``.db3`` or ``.bag`` also for a compressed file."""
    return Path(path.stem).suffix if path.suffix in _ZSTD else path.suffix


def _natural_order(path: Path) -> tuple[str, int, str]:
    """Order ``bag_2`` before ``bag_10``."""
    stem = path.name.partition(".")[0]
    base, _, number = stem.rpartition("_")
    return (base, int(number), path.name) if number.isdecimal() else (stem, -1, path.name)

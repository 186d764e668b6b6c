"""An open bag of any storage, and streams of numbers out of its messages."""

from __future__ import annotations

import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from hpid_ros.base.errors import BagError, MessageError
from hpid_ros.messages.columns import (
    ENCAPSULATION,
    LAYOUTS,
    WORD,
    DeltaColumn,
    Integers,
    JointSamples,
    Layout,
    LayoutFamily,
    Mask,
    NumberColumn,
    Report,
    StorageFile,
    TopicBatch,
    TopicInfo,
    Words,
    batch_of,
    count_difference,
    gather_words,
    merged,
)
from hpid_ros.messages.mcap_chunks import Allowance, decompressed_message, unpack_file
from hpid_ros.messages.mcap_file import McapFile
from hpid_ros.messages.selection import METADATA, counts_of, custom_data, read_metadata
from hpid_ros.messages.sqlite_file import SqliteFile

if TYPE_CHECKING:
    from typing_extensions import Self


_SUFFIXES = (".mcap", ".db3")
_ZSTD = ".zstd"
_NO_FILES = {
    stat.S_IFDIR: "folder",
    stat.S_IFIFO: "FIFO",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}
_MOST_LINES = 50
"""Lines about what cannot be read; a file can be made to have any number."""
_PLACES_PER_FILE = 1 << 48
"""Above every place in one file, so that places order the messages of all files."""

Progress = Callable[[float], None]
"""Takes the share of a bag that has been read, in [0, 1]."""


class Storage:
    """An open bag of any storage and compression that rosbag2 writes."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.unreadable: list[str] = []
        self._further = 0
        self._stack = ExitStack()
        if not self.path.exists():
            raise BagError(f"no bag at {self.path}: no such file or folder")
        metadata = self._metadata() if self.path.is_dir() else {}
        self._is_by_message = str(metadata.get("compression_mode", "")).lower() == "message"
        self._counts = counts_of(metadata)
        custom = metadata.get("custom_data") if metadata else custom_data(self.path)
        self.custom_data = _texts(custom) if isinstance(custom, dict) else {}
        self._files: list[tuple[StorageFile, Report, int]] = []
        for file in self._paths(metadata):
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

    def _metadata(self) -> dict[str, Any]:
        """Return what ``metadata.yaml`` says; nothing if it is missing or damaged."""
        if not (self.path / METADATA).exists():
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
            return [self.path / Path(name).name for name in named]
        found = [file for file in self.path.iterdir() if _suffix(file) in _SUFFIXES]
        if not found:
            self.close()
            raise BagError(f"no bag at {self.path}: the folder has no .mcap and no .db3 file")
        return sorted(found, key=_natural_order)

    def _open(self, path: Path) -> None:
        try:
            found = path.stat()
        except FileNotFoundError:
            raise BagError("the file is missing") from None
        except OSError as error:
            raise BagError(str(error.strerror or error)) from None
        kind = _NO_FILES.get(stat.S_IFMT(found.st_mode))
        if kind is not None:  # of which some can be opened, and never end
            raise BagError(f"it is a {kind}, not a file")
        size = found.st_size
        suffix = _suffix(path)
        if suffix not in _SUFFIXES:
            raise BagError("neither .mcap nor .db3")
        name = path.name

        def report(line: str) -> None:
            self._report(f"{name}: {line}")

        if path.suffix == _ZSTD:
            path = self._decompressed(path, report)
        make = McapFile if suffix == ".mcap" else SqliteFile
        file: StorageFile = make(path, report)
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
        """Return the topics of all files by full name."""
        topics: dict[str, TopicInfo] = {}
        for file, _, _ in self._files:
            for name, info in file.topics().items():
                before = topics.get(name)
                if before is None:
                    topics[name] = info
                elif before.type != info.type:
                    raise BagError(
                        f"bag {self.path}: topic {name} is {before.type} in one file and "
                        f"{info.type} in another"
                    )
                elif None not in (before.message_count, info.message_count):
                    both = (before.message_count or 0) + (info.message_count or 0)
                    topics[name] = info._replace(message_count=both)
        return topics

    def batches(self, topics: frozenset[str], progress: Progress) -> Iterator[TopicBatch]:
        """Yield the messages of some topics, file by file.

        What cannot be read is in :attr:`unreadable` afterwards.
        """
        whole = max(sum(size for _, _, size in self._files), 1)
        before, found = 0, dict.fromkeys(topics, 0)
        for number, (file, report, size) in enumerate(self._files):

            def done(position: int, before: int = before, size: int = size) -> None:
                progress(min((before + min(position, size)) / whole, 1.0))

            allowance = Allowance()
            for batch in file.batches(topics, report, done):
                found[batch.topic] += len(batch.starts)
                batch = batch._replace(places=batch.places + number * _PLACES_PER_FILE)
                if self._is_by_message:
                    batch = self._without_compression(batch, allowance)
                if len(batch.starts):
                    yield batch
            before += size
        progress(1.0)
        known = self.topics()
        told = {n: count for n, count in self._counts.items() if n in topics or n not in known}
        line = count_difference(told, found)
        if line:
            self._report(f"metadata.yaml counts {line}")

    def _without_compression(self, batch: TopicBatch, allowance: Allowance) -> TopicBatch:
        """Decompress each message of a batch."""
        raws: list[bytes] = []
        kept: list[int] = []
        reason = ""
        for index in range(len(batch.starts)):
            try:
                raws.append(decompressed_message(batch.raw(index), allowance))
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _suffix(path: Path) -> str:
    """Return ``.mcap`` or ``.db3`` also for a compressed file."""
    return Path(path.stem).suffix if path.suffix == _ZSTD else path.suffix


def _texts(custom: Mapping[Any, Any]) -> dict[str, str]:
    """Return the entries that are texts, as all that rosbag2 writes are."""
    return {k: v for k, v in custom.items() if isinstance(k, str) and isinstance(v, str)}


def _natural_order(path: Path) -> tuple[str, int, str]:
    """Order ``bag_2`` before ``bag_10``."""
    stem = path.name.partition(".")[0]
    base, _, number = stem.rpartition("_")
    return (base, int(number), path.name) if number.isdecimal() else (stem, -1, path.name)


class OrderNeededError(Exception):
    """The order of messages matters, but was not kept: read again, and keep it."""


class _Group:
    """Messages that carry numbers of the same joints."""

    def __init__(self, joints: tuple[str, ...], has_stamps: bool, has_order: bool) -> None:
        self._stamps = DeltaColumn(np.uint32) if has_stamps else None
        self._log_times = DeltaColumn(np.uint32) if has_order else None
        self._places = DeltaColumn(np.uint16) if has_order else None
        self._last_place = -1
        self.is_in_order = True
        self.values = {joint: NumberColumn() for joint in joints}

    def append(
        self, layout: Layout, rows: Words, which: Integers | slice, batch: TopicBatch
    ) -> None:
        places = batch.places[which]
        if places[0] < self._last_place:
            self.is_in_order = False  # two layouts by turns
        self._last_place = max(self._last_place, int(places[-1]))
        if self._stamps is not None:
            self._stamps.append(layout.stamps_ns(rows, which))
        if self._log_times is not None and self._places is not None:
            self._log_times.append(batch.log_times_ns[which])
            self._places.append(places)

    @cached_property
    def clock(self) -> tuple[Integers | None, Integers | None, Integers | None]:
        """Stamps, log times and places, shared by all joints of the group."""
        stamps, log_times, places = (
            None if column is None else column.numbers()
            for column in (self._stamps, self._log_times, self._places)
        )
        return stamps, log_times, places


class JointStream:
    """Collects one field of a topic's messages by joint."""

    def __init__(
        self,
        type: str,
        field: str,
        joints: frozenset[str] | None = None,
        elements: Mapping[int, str] | None = None,
        keeps_order: bool = True,
    ) -> None:
        self._learn: Callable[[bytes], Layout] = LAYOUTS[type]
        self._field = field
        self._joints = joints
        self._elements = elements
        self._keeps_order = keeps_order
        self._families: dict[int, list[LayoutFamily]] = {}
        self._groups: dict[tuple[str, ...], _Group] = {}
        self._groups_of: dict[str, list[tuple[str, ...]]] = {}
        self._last_log_time_ns = -(2**63)
        self._is_log_ordered = True
        self._columns_of: WeakKeyDictionary[Layout, Mapping[str, int]] = WeakKeyDictionary()
        self.names: dict[str, None] = {}
        self.message_count = 0
        self.undecodable = 0
        self.first_failure = ""

    def add(self, batch: TopicBatch) -> None:
        """Take the next messages of the topic."""
        self.message_count += len(batch.starts)
        times = batch.log_times_ns
        if times[0] < self._last_log_time_ns or (times[1:] < times[:-1]).any():
            self._is_log_ordered = False
            if not self._keeps_order:
                raise OrderNeededError
        self._last_log_time_ns = max(self._last_log_time_ns, int(times[-1]))
        sizes = batch.sizes
        left = sizes
        while len(left):
            size = int(left[0])
            is_size = sizes == size
            if is_size.all():
                self._add_size(batch, size)
                return
            self._add_size(TopicBatch(batch.topic, batch.buffer, *_picked(batch, is_size)), size)
            left = left[left != size]

    def joints(self) -> frozenset[str]:
        """Return the joints that have numbers."""
        return frozenset(self._groups_of)

    def take(self, joint: str) -> JointSamples | None:
        """Return one joint's samples and forget them; None if there are none."""
        parts, is_in_order = [], self._is_log_ordered
        for joints in self._groups_of.pop(joint, ()):
            group = self._groups[joints]
            parts.append(JointSamples(*group.clock, group.values.pop(joint).finished()))
            is_in_order &= group.is_in_order
            if not group.values:
                del self._groups[joints]
        if not parts:
            return None
        if len(parts) == 1 and is_in_order:
            return parts[0]
        samples = merged(parts)
        if samples.places is None or samples.log_times_ns is None:
            raise OrderNeededError
        return samples.picked(np.lexsort((samples.places, samples.log_times_ns)))

    def _add_size(self, batch: TopicBatch, size: int) -> None:
        """Take messages of one length."""
        words = -(-(size + ENCAPSULATION) // WORD)
        rows = gather_words(batch.buffer, batch.starts - ENCAPSULATION, words)
        families = self._families.setdefault(size, [])
        is_left = np.ones(len(rows), dtype=np.bool_)
        for family in families:
            for layout, claims in family.split(rows):
                self._keep(layout, rows, np.flatnonzero(claims), batch)
                is_left &= ~claims
        while is_left.any():
            left = np.flatnonzero(is_left)
            first = self._learned(batch, int(left[0]))
            if first is None:
                is_left[left[0]] = False
                continue
            for which in _equal_rows(rows[left] & first.mask):
                here = left[which]
                own = first if here[0] == left[0] else self._learned(batch, int(here[0]))
                if own is None or not np.array_equal(own.mask, first.mask):
                    here = here[:1]  # the others may differ from it where the first's mask is zero
                is_left[here] = False
                if own is not None:
                    _remember(own, families)
                    self._keep(own, rows, here, batch)

    def _learned(self, batch: TopicBatch, index: int) -> Layout | None:
        """Return the layout of one message; None if it is not of the type."""
        try:
            return self._learn(batch.raw(index))
        except MessageError as error:
            self.undecodable += 1
            self.first_failure = self.first_failure or str(error)
            return None

    def _keep(self, layout: Layout, rows: Words, which: Integers, batch: TopicBatch) -> None:
        """Append the numbers of messages of one layout to their group."""
        columns = self._columns(layout)
        if not columns:
            return
        joints = tuple(columns)
        group = self._groups.get(joints)
        if group is None:
            if not self._keeps_order and any(joint in self._groups_of for joint in joints):
                raise OrderNeededError
            group = _Group(joints, layout.stamp is not None, self._keeps_order)
            self._groups[joints] = group
            for joint in joints:
                self._groups_of.setdefault(joint, []).append(joints)
        picked: Integers | slice = slice(None) if len(which) == len(rows) else which
        group.append(layout, rows, picked, batch)
        if not (group.is_in_order or self._keeps_order):
            raise OrderNeededError
        for joint, index in columns.items():
            group.values[joint].append(layout.column(rows, self._field, index)[picked])

    def _columns(self, layout: Layout) -> Mapping[str, int]:
        """Return which wanted joint is at which place of the field."""
        columns = self._columns_of.get(layout)
        if columns is None:
            columns = self._columns_of[layout] = self._find_columns(layout)
        return columns

    def _find_columns(self, layout: Layout) -> Mapping[str, int]:
        length = layout.fields[self._field].length if self._field in layout.fields else 0
        if self._elements is not None:
            return {j: element for element, j in self._elements.items() if element < length}
        self.names.update(dict.fromkeys(layout.names))
        if length != len(layout.names):
            return {}  # the wire allows arrays of another length than the names
        wanted = self._joints
        columns: dict[str, int] = {}
        for index, name in enumerate(layout.names):
            if wanted is None or name in wanted:
                columns.setdefault(name, index)
        return columns


def _remember(layout: Layout, families: list[LayoutFamily]) -> None:
    for family in families:
        if family.accepts(layout):
            family.add(layout)
            return
    families.append(LayoutFamily(layout))


def _equal_rows(rows: Words) -> list[Integers]:
    """Return which rows are equal to each other, the first one's first."""
    is_first = (rows == rows[0]).all(axis=1)
    if is_first.all():
        return [np.flatnonzero(is_first)]
    order = np.lexsort(rows.T)
    is_new = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    groups = np.split(order, np.flatnonzero(is_new) + 1)
    return sorted(groups, key=lambda group: int(group[0]))


def _picked(batch: TopicBatch, which: Mask) -> Iterator[Integers]:
    return (part[which] for part in (batch[2], batch[3], batch[4], batch[5]))

"""A bag as a whole: a folder with metadata or without, or one file; compressed or not."""

from __future__ import annotations

import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import TYPE_CHECKING, Any

from hpid_ros.bags.columns.batches import (
    Report,
    StorageFile,
    TopicBatch,
    TopicInfo,
    batch_of,
    count_difference,
)
from hpid_ros.bags.columns.compression import Allowance, decompressed_message, unpack_file
from hpid_ros.bags.columns.mcap.file import McapFile
from hpid_ros.bags.columns.sqlite.file import SqliteFile
from hpid_ros.bags.metadata import METADATA, counts_of, custom_data, read_metadata
from hpid_ros.base.errors import BagError

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

"""An open bag: its files, MCAP or SQLite, and their messages in batches."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Protocol

from hpid_ros.base.errors import BagError, listed_names
from hpid_ros.base.libraries import optional_libraries
from hpid_ros.base.resources import other_kind
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
from hpid_ros.messages.metadata import METADATA, counts_of, custom_data, read_metadata, texts_of
from hpid_ros.messages.sqlite_file import SqliteFile

if TYPE_CHECKING:
    from typing_extensions import Self

ROS1 = "ros1"
"""What MCAP calls messages as ROS 1 serialises them."""


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


ReadingProgress = Callable[[float], None]
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
        self.custom_data = texts_of(metadata) if metadata else custom_data(self.path)
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
        self, topics: frozenset[str], progress: ReadingProgress = no_progress
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

"""A bag as a whole: a folder with metadata or without, or one file; compressed or not."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from hpid_ros.bags.batches import SLACK, Report, StorageFile, TopicBatch, TopicInfo
from hpid_ros.bags.compression import zstd
from hpid_ros.bags.mcap_file import McapFile
from hpid_ros.bags.sqlite_file import SqliteFile
from hpid_ros.errors import BagError

if TYPE_CHECKING:
    from typing_extensions import Self

_SUFFIXES = (".mcap", ".db3")
_ZSTD = ".zstd"
_PLACES_PER_FILE = 1 << 48
"""Above every place in one file, so that places order the messages of all files."""

Progress = Callable[[float], None]
"""Takes the share of a bag that has been read, in [0, 1]."""


class Storage:
    """An open bag of any storage and compression that rosbag2 writes.

    Args:
        path: A folder, or one ``.mcap`` or ``.db3`` file, also with ``.zstd`` after it.

    Attributes:
        unreadable: A line for each thing that could not be read so far.
        custom_data: The texts that the recording was given, by name.

    Raises:
        BagError: There is no bag, or no file of it can be opened.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.unreadable: list[str] = []
        self._stack = ExitStack()
        if not self.path.exists():
            raise BagError(f"no bag at {self.path}: no such file or folder")
        metadata = self._metadata() if self.path.is_dir() else {}
        self._is_by_message = str(metadata.get("compression_mode", "")).lower() == "message"
        self._counts = _counts(metadata)
        custom = metadata.get("custom_data")
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
        if line not in self.unreadable:
            self.unreadable.append(line)

    def _metadata(self) -> dict[str, Any]:
        """Return what ``metadata.yaml`` says; nothing if it is missing or damaged."""
        file = self.path / "metadata.yaml"
        if not file.exists():
            self._report("metadata.yaml is missing, as after a recorder that was stopped by force")
            return {}
        try:
            document = yaml.load(file.read_bytes(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
            metadata = document["rosbag2_bagfile_information"]
            if isinstance(metadata, dict):
                return metadata
        except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
            pass
        self._report("metadata.yaml is damaged; the files were read without it")
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
        if not path.exists():
            raise BagError("the file is missing")
        size = path.stat().st_size
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
            with zstd.open(path, "rb") as packed, unpacked.open("wb") as target:
                shutil.copyfileobj(packed, target)
        except OSError as error:
            raise BagError(f"it cannot be unpacked: {error.strerror or error}") from error
        except (EOFError, zstd.ZstdError):
            report("it is damaged or cut off; what could be unpacked was read")
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

        Args:
            topics: Full names.
            progress: Takes the share that has been read.
        """
        whole = max(sum(size for _, _, size in self._files), 1)
        before, found = 0, dict.fromkeys(topics, 0)
        for number, (file, report, size) in enumerate(self._files):

            def done(position: int, before: int = before, size: int = size) -> None:
                progress(min((before + min(position, size)) / whole, 1.0))

            for batch in file.batches(topics, report, done):
                found[batch.topic] += len(batch.starts)
                batch = batch._replace(places=batch.places + number * _PLACES_PER_FILE)
                yield self._without_compression(batch) if self._is_by_message else batch
            before += size
        progress(1.0)
        for topic in sorted(topics):
            told = self._counts.get(topic, found[topic])
            if told != found[topic]:
                self._report(
                    f"metadata.yaml counts {told} messages on {topic}, not {found[topic]}"
                )

    def _without_compression(self, batch: TopicBatch) -> TopicBatch:
        """Decompress each message of a batch."""
        raws: list[bytes] = []
        kept: list[int] = []
        for index in range(len(batch.starts)):
            try:
                raws.append(zstd.decompress(batch.raw(index)))
            except zstd.ZstdError:
                continue
            kept.append(index)
        if len(kept) < len(batch.starts):
            self._report(
                f"messages on {batch.topic} cannot be decompressed and are left out, the first "
                f"recorded at {int(batch.log_times_ns[0])} ns or later"
            )
        slack = bytes(SLACK)
        sizes = np.fromiter(map(len, raws), np.int64, len(raws))
        return TopicBatch(
            batch.topic,
            np.frombuffer(b"".join((slack, *raws, slack)), dtype=np.uint8),
            SLACK + np.cumsum(sizes) - sizes,
            sizes,
            batch.log_times_ns[kept],
            batch.places[kept],
        )

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


def _counts(metadata: Mapping[str, Any]) -> dict[str, int]:
    """Return how many messages of each topic the metadata counts."""
    counts: dict[str, int] = {}
    try:
        for each in metadata["topics_with_message_count"]:
            name, count = each["topic_metadata"]["name"], int(each["message_count"])
            counts[str(name)] = counts.get(str(name), 0) + count
    except (KeyError, TypeError, ValueError):
        return {}
    return counts

"""The undocumented parts of rosbags, and an MCAP writer whose chunks reach the disk in time.

rosbags documents how a bag is opened, written and closed. It closes a chunk after 1 MiB, leaves
flushing to the file's buffer and writes no checksums, and its public interface can change none of
that. ``rosbags.rosbag2.Writer`` does let a subclass name its storage classes
(``STORAGE_PLUGINS``), so the difference is two small subclasses. Whatever they use
without a promise was read in rosbags 0.11.0 and 0.11.9, where it is the
same; no other module of this package touches it (``test_architecture.py``). Where another version
lacks it, :class:`.BagError` says in one line what is missing and which versions are known.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.rosbag2.storage_mcap import McapWriter, PendingChunk

from hpid_ros.base.errors import BagError
from hpid_ros.base.processes import uninterrupted

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos
    from rosbags.rosbag2 import CompressionMode


KNOWN_VERSIONS = "0.11"

CHUNK_SPAN_NS = 500_000_000
"""Longest log time that one chunk may cover, in [ns]: what a crash can cost."""

_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time and publish time of a message record."""
_CHECKSUM = struct.Struct("<I")
_LARGE = 2**20  # [bytes]
_CHECKSUM_OFFSET = 9 + 3 * 8
"""After opcode, length, first and last log time and size of a chunk record (MCAP, version 0)."""

_OF_STORAGE = (
    *("bio", "chunk", "chunks", "channel_stats"),
    *("message_start_time", "message_end_time", "path"),
)
_OF_CHUNK = ("bio", "message_start_time", "message_end_time", "msgs")
_OF_WRITER = ("storage", "counts", "min_timestamp", "max_timestamp")


class FlushingMcapWriter(McapWriter):
    """MCAP storage that closes a chunk after half a second of log time and flushes each.

    Every chunk has a checksum.

    A chunk that cannot be written (full disk) is taken back, so that the file can still be
    finished with all chunks before it.

    Uses ``bio`` (the open file), ``chunk`` (the one being filled, a ``PendingChunk``), ``chunks``
    (the index of those in the file), ``close_chunk``, ``channel_stats`` (messages by channel) and
    the first and last log time.
    """

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        _require(self, _OF_STORAGE)
        _require(self.chunk, _OF_CHUNK)
        self._times_on_disk = (self.message_start_time, self.message_end_time)

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        """Append one message; its chunk goes to disk when it is large or old enough.

        As ``McapWriter.write``, which takes three times as long over it.
        """
        chunk, channel = self.chunk, connection.id
        self.message_start_time = min(timestamp, self.message_start_time)
        self.message_end_time = max(timestamp, self.message_end_time)
        chunk.message_start_time = min(timestamp, chunk.message_start_time)
        chunk.message_end_time = max(timestamp, chunk.message_end_time)
        self.channel_stats[channel] += 1
        chunk.msgs[channel].append((timestamp, chunk.bio.tell()))
        length = _MESSAGE.size - 9 + len(data)  # what follows opcode and length
        chunk.bio.write(_MESSAGE.pack(5, length, channel, 0, timestamp, timestamp))
        chunk.bio.write(data)
        if chunk.bio.tell() > _LARGE or timestamp - chunk.message_start_time >= CHUNK_SPAN_NS:
            self.close_chunk()

    def flush(self) -> None:
        """Write the pending chunk, if it holds a message."""
        if self.chunk.msgs:
            self.close_chunk()

    def is_in_place(self) -> bool:
        """Return whether the file that is written is still the one that its path leads to."""
        try:
            return os.path.samestat(self.path.stat(), os.fstat(self.bio.fileno()))
        except (FileNotFoundError, NotADirectoryError):
            return False

    def close_chunk(self) -> None:
        """Write the pending chunk and hand it to the operating system.

        An interrupt waits until it is there as a whole: nothing behind half a chunk can be read.
        """
        with uninterrupted():
            self._close_chunk()

    def _close_chunk(self) -> None:
        pending, chunk_count = self.chunk, len(self.chunks)
        self.bio.flush()
        start = self.bio.tell()
        try:
            super().close_chunk()
            self._add_checksum(pending, start)
            self.bio.flush()
        except OSError:
            del self.chunks[chunk_count:]
            self._take_back(pending, start)
            raise
        self._times_on_disk = (self.message_start_time, self.message_end_time)

    def _add_checksum(self, chunk: PendingChunk, start: int) -> None:
        """Write the checksum that rosbags leaves out, so that damage is noticed when reading."""
        end = self.bio.tell()
        self.bio.seek(start + _CHECKSUM_OFFSET)
        self.bio.write(_CHECKSUM.pack(zlib.crc32(chunk.bio.getbuffer())))
        self.bio.seek(end)

    def _take_back(self, pending: PendingChunk, start: int) -> None:
        """Cut the file at ``start`` and forget the messages of the pending chunk."""
        for channel, messages in pending.msgs.items():
            self.channel_stats[channel] -= len(messages)
        self.chunk = PendingChunk(2**63 - 1, 0, BytesIO(), defaultdict(list))
        self.message_start_time, self.message_end_time = self._times_on_disk
        # The buffer of the failed file still holds bytes, which closing tries to write once more.
        with suppress(OSError):
            self.bio.close()
        os.truncate(self.path, start)
        self.bio = self.path.open("r+b")  # type: ignore[assignment]  # it writes, too
        self.bio.seek(start)


class FlushingWriter(Writer):
    """The rosbag2 writer of rosbags with :class:`FlushingMcapWriter` as its only storage.

    Uses ``storage`` (the open storage, or None), ``counts`` (messages by connection), the first
    and last log time, which :meth:`close` writes into ``metadata.yaml``, and ``abort``, which
    closes the file without index.
    """

    STORAGE_PLUGINS = {StoragePlugin.MCAP: FlushingMcapWriter}  # noqa: RUF012 (as in the base)

    def __init__(self, path: Path) -> None:
        # Before anything is created.
        _require(Writer, ("STORAGE_PLUGINS", "abort"))
        _require(McapWriter, ("abort", "close_chunk"))
        super().__init__(path, version=9, storage_plugin=StoragePlugin.MCAP)
        _require(self, _OF_WRITER)

    @property
    def mcap(self) -> FlushingMcapWriter | None:
        """The open storage, or None before opening and after closing."""
        return self.storage if isinstance(self.storage, FlushingMcapWriter) else None

    def count_what_is_stored(self) -> None:
        """Take counts and times from the storage, after it had to drop messages."""
        if (mcap := self.mcap) is not None:
            self.counts.update(mcap.channel_stats)
            self.min_timestamp = mcap.message_start_time
            self.max_timestamp = mcap.message_end_time


def _require(owner: object, names: tuple[str, ...]) -> None:
    """Refuse a rosbags whose class, or an object of it, lacks something."""
    missing = [name for name in names if not hasattr(owner, name)]
    if missing:
        kinds = (owner if isinstance(owner, type) else type(owner)).__mro__
        kind = next(each for each in kinds if each.__module__.startswith("rosbags."))
        raise BagError(
            f"cannot write bags with rosbags {version('rosbags')}: its {kind.__name__} has no "
            f"{', '.join(missing)}; known to work is {KNOWN_VERSIONS}"
        )


def recorded_qos(text: str) -> list[Qos]:
    """Return offered profiles from their YAML; none if it cannot be read."""
    with suppress(ReaderError, KeyError, TypeError, AttributeError):
        return parse_qos(text)
    return []


def bound_chunks(reader: Any, unpack: Callable[[str, bytes], bytes]) -> None:
    """Have an open reader of ROS 1 unpack its chunks by a function of compression and bytes.

    Uses ``chunks``, whose ``decompressor`` unpacks whatever comes, to any size.
    """
    _require(reader, ("chunks",))
    kinds = {function: kind for kind, function in decompressors.items()}
    for place, chunk in reader.chunks.items():
        kind = kinds.get(chunk.decompressor, "none")
        if kind != "none":
            reader.chunks[place] = chunk._replace(decompressor=partial(unpack, kind))

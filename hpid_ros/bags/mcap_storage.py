"""MCAP storage whose messages reach the file soon, and which survives a full disk.

rosbags closes a chunk after 1 MiB and leaves flushing to Python's file buffer; its public API can
change neither. :class:`rosbags.rosbag2.Writer` does let a subclass name its storage classes
(``STORAGE_PLUGINS``), so the difference lives in the two small subclasses below. They rely on
``McapWriter.chunk``, ``chunks``, ``close_chunk`` and ``bio``, which are the same in rosbags 0.11.0
and 0.11.9.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import defaultdict
from contextlib import suppress
from io import BytesIO
from typing import TYPE_CHECKING

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter, PendingChunk

if TYPE_CHECKING:
    from pathlib import Path

    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import CompressionMode

CHUNK_SPAN_NS = 500_000_000
"""Longest log time that one chunk may cover, in [ns]: what a crash can cost."""

_CHECKSUM = struct.Struct("<I")
_CHECKSUM_OFFSET = 9 + 3 * 8
"""After opcode, length, first and last log time and size of a chunk record (MCAP, version 0)."""


class SoonOnDiskMcapWriter(McapWriter):
    """MCAP storage that closes a chunk after half a second of log time and flushes each.

    Every chunk has a checksum.

    A chunk that cannot be written (full disk) is taken back, so that the file can still be
    finished with all chunks before it.
    """

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        self._times_on_disk = (self.message_start_time, self.message_end_time)

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        """Append one message; its chunk goes to disk when it is large or old enough.

        Args:
            connection: The connection that the message belongs to.
            timestamp: Log time, in [ns].
            data: The serialised message.
        """
        super().write(connection, timestamp, data)
        # A fresh chunk's start lies in the far future, so this is false right after closing one.
        if timestamp - self.chunk.message_start_time >= CHUNK_SPAN_NS:
            self.close_chunk()

    def flush(self) -> None:
        """Write the pending chunk, if it holds a message."""
        if self.chunk.msgs:
            self.close_chunk()

    def is_in_place(self) -> bool:
        """Tell whether the file that is written is still the one that its path leads to."""
        try:
            return os.path.samestat(self.path.stat(), os.fstat(self.bio.fileno()))
        except (FileNotFoundError, NotADirectoryError):
            return False

    def close_chunk(self) -> None:
        """Write the pending chunk and hand it to the operating system.

        Raises:
            OSError: It could not be written; its messages are gone, the file is as before.
        """
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


class SoonOnDiskWriter(Writer):
    """The rosbag2 writer of rosbags with :class:`SoonOnDiskMcapWriter` as its only storage."""

    STORAGE_PLUGINS = {StoragePlugin.MCAP: SoonOnDiskMcapWriter}  # noqa: RUF012 (as in the base)

    def __init__(self, path: Path) -> None:
        super().__init__(path, version=9, storage_plugin=StoragePlugin.MCAP)

    @property
    def mcap(self) -> SoonOnDiskMcapWriter | None:
        """The open storage, or None before opening and after closing."""
        return self.storage if isinstance(self.storage, SoonOnDiskMcapWriter) else None

    def count_what_is_stored(self) -> None:
        """Take counts and times from the storage, after it had to drop messages."""
        if (mcap := self.mcap) is not None:
            self.counts.update(mcap.channel_stats)
            self.min_timestamp = mcap.message_start_time
            self.max_timestamp = mcap.message_end_time

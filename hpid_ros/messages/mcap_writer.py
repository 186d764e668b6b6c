"""One MCAP file that is being written: what has come reaches the disk in time, and stays whole.

Of the library ``mcap`` it takes the records. The library's own ``Writer`` takes 12 us for a
message of 300 bytes (mcap 1.6.0), this one 5; and a chunk that does not reach the disk is counted
and indexed there all the same, so that the file cannot be finished without it.

Source: the MCAP format specification, version 0.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from hpid_ros import __version__
from hpid_ros.base.processes import uninterrupted
from hpid_ros.messages.mcap_file import MAGIC

CHUNK_SPAN_NS = 500_000_000
"""Longest log time that one chunk may cover, in [ns]: what a crash can cost."""
CHUNK_SIZE = 2**20  # [bytes] from which on a chunk is closed

_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time and publish time of a message record."""
_MESSAGE_LENGTH = _MESSAGE.size - 9  # what follows opcode and length, without the data

_NO_START_NS, _NO_END_NS = 2**63 - 1, 0  # log times of no messages, as rosbag2 has them


@dataclass
class _PendingChunk:
    """Messages that are not in the file yet, with the schemas and channels that came with them."""

    records: BytesIO = field(default_factory=BytesIO)
    index: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    """By channel, the log time of each message, and where in the records it is."""
    start_ns: int = _NO_START_NS
    end_ns: int = _NO_END_NS


class McapWriter:
    """A new MCAP file without compression, whose chunks have checksums.

    A chunk is closed after half a second of log time or 1 MiB, and each is handed to the
    operating system at once. One that cannot be written (full disk) is taken back, so that the
    file can still be finished with all chunks before it.
    """

    def __init__(self, path: Path) -> None:
        self.counts: Counter[int] = Counter()  # messages by channel
        self.start_ns, self.end_ns = _NO_START_NS, _NO_END_NS  # first and last in the file
        self._path = path
        self._file = path.open("xb")
        self._schemas: dict[str, Schema] = {}
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._pending = _PendingChunk()
        self._file.write(MAGIC + _encoded(Header("ros2", f"hpid_ros-{__version__}")))

    def add_channel(self, topic: str, type: str, definition: str, qos: str) -> int:
        """Add a topic, and return the number of its channel; ``qos`` is YAML."""
        if type not in self._schemas:
            is_idl = definition.startswith(f"{'=' * 80}\nIDL: ")
            encoding = "ros2idl" if is_idl else "ros2msg"
            number = len(self._schemas) + 1
            self._schemas[type] = Schema(number, definition.encode(), encoding, type)
            self._pending.records.write(_encoded(self._schemas[type]))
        metadata = {"offered_qos_profiles": qos}
        number = len(self._channels) + 1
        self._channels.append(Channel(number, topic, "cdr", metadata, self._schemas[type].id))
        self._pending.records.write(_encoded(self._channels[-1]))
        return number

    def write(self, channel: int, time_ns: int, data: bytes) -> None:
        """Append one message; its chunk goes to disk when it is large or old enough."""
        chunk = self._pending
        records = chunk.records
        chunk.index.setdefault(channel, []).append((time_ns, records.tell()))
        chunk.start_ns = min(time_ns, chunk.start_ns)
        chunk.end_ns = max(time_ns, chunk.end_ns)
        length = _MESSAGE_LENGTH + len(data)
        records.write(_MESSAGE.pack(Opcode.MESSAGE, length, channel, 0, time_ns, time_ns))
        records.write(data)
        self.counts[channel] += 1
        if records.tell() > CHUNK_SIZE or time_ns - chunk.start_ns >= CHUNK_SPAN_NS:
            self._close_chunk()

    def flush(self) -> None:
        """Hand the pending messages to the operating system."""
        if self._pending.index:
            self._close_chunk()

    def is_in_place(self) -> bool:
        """Return whether the file that is written is still the one that its path leads to."""
        try:
            return os.path.samestat(self._path.stat(), os.fstat(self._file.fileno()))
        except (FileNotFoundError, NotADirectoryError):
            return False

    def finish(self, metadata: str) -> None:
        """Write all that is left, rosbag2's metadata and the index, and close the file."""
        if self._pending.records.tell():
            self._close_chunk()
        start = self._file.tell()
        entry = _encoded(Metadata("rosbag2", {"serialized_metadata": metadata}))
        data_end = _encoded(DataEnd(0))
        index = MetadataIndex(start, len(entry), "rosbag2")
        summary = self._summary(start + len(entry) + len(data_end), index)
        self._file.write(entry + data_end + summary + MAGIC)
        self._file.close()

    def _summary(self, start: int, metadata: MetadataIndex) -> bytes:
        """Return the summary, which begins at ``start``, and the footer."""
        groups: dict[Opcode, list[McapRecord]] = {
            Opcode.SCHEMA: [*self._schemas.values()],
            Opcode.CHANNEL: [*self._channels],
            Opcode.CHUNK_INDEX: [*self._chunks],
            Opcode.METADATA_INDEX: [metadata],
            Opcode.STATISTICS: [self._statistics()],
        }
        parts, offsets, place = [], [], start
        for opcode, records in groups.items():
            part = _encoded(*records)
            if part:
                offsets.append(SummaryOffset(opcode, place, len(part)))
            parts.append(part)
            place += len(part)
        return b"".join(parts) + _encoded(*offsets, Footer(start, place, 0))

    def _statistics(self) -> Statistics:
        numbers = [each.id for each in self._channels]
        return Statistics(
            attachment_count=0,
            channel_count=len(numbers),
            channel_message_counts={number: self.counts[number] for number in numbers},
            chunk_count=len(self._chunks),
            message_count=self.counts.total(),
            message_end_time=self.end_ns,
            message_start_time=self.start_ns,
            metadata_count=1,
            schema_count=len(self._schemas),
        )

    def abort(self) -> None:
        """Close the file without an index."""
        self._file.close()

    def _close_chunk(self) -> None:
        """Write the pending chunk and hand it to the operating system.

        An interrupt waits until it is there as a whole: nothing behind half a chunk can be read.
        """
        with uninterrupted():
            pending, self._pending = self._pending, _PendingChunk()
            self._file.flush()
            start = self._file.tell()
            raw, index = _chunk(pending, start)
            try:
                self._file.write(raw)
                self._file.flush()
            except OSError:
                self._take_back(pending, start)
                raise
            self._chunks.append(index)
            self.start_ns = min(pending.start_ns, self.start_ns)
            self.end_ns = max(pending.end_ns, self.end_ns)

    def _take_back(self, pending: _PendingChunk, start: int) -> None:
        """Cut the file at ``start`` and forget the messages of the pending chunk."""
        for channel, messages in pending.index.items():
            self.counts[channel] -= len(messages)
        # The buffer of the failed file still holds bytes, which closing tries to write once more.
        with suppress(OSError):
            self._file.close()
        os.truncate(self._path, start)
        self._file = self._path.open("r+b")  # type: ignore[assignment]  # it writes, too
        self._file.seek(start)


def _encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _chunk(pending: _PendingChunk, start: int) -> tuple[bytes, ChunkIndex]:
    """Return a chunk with the indexes of its messages, and what the summary says of it."""
    data = pending.records.getvalue()
    chunk = Chunk(
        compression="",
        data=data,
        message_end_time=pending.end_ns,
        message_start_time=pending.start_ns,
        uncompressed_crc=zlib.crc32(data),
        uncompressed_size=len(data),
    )
    parts = [_encoded(chunk)]
    length = end = len(parts[0])
    offsets = {}
    for channel, messages in pending.index.items():
        offsets[channel] = start + end
        parts.append(_encoded(MessageIndex(channel, messages)))
        end += len(parts[-1])
    index = ChunkIndex(
        chunk_length=length,
        chunk_start_offset=start,
        compression="",
        compressed_size=len(data),
        message_end_time=pending.end_ns,
        message_index_length=end - length,
        message_index_offsets=offsets,
        message_start_time=pending.start_ns,
        uncompressed_size=len(data),
    )
    return b"".join(parts), index

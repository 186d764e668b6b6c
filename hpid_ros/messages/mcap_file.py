"""One MCAP file: finished or cut off, with or without chunks, summary and index."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from hpid_ros.base.errors import BagError
from hpid_ros.messages.columns import (
    SLACK,
    Advance,
    Bytes,
    Report,
    TopicBatch,
    TopicInfo,
    count_difference,
)
from hpid_ros.messages.mcap_chunks import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FRAME,
    FRAME_SIZE,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    SCHEMA,
    STATISTICS,
    Allowance,
    Catalogue,
    Chunk,
    Fields,
    Messages,
    candidates,
    check_sum,
    decompressed,
    decompressed_part,
    is_plausible,
    is_sound,
    locate,
    walk,
)

_BATCH_BYTES = 4 << 20
"""Records that are looked at together: numpy's calls cost little, and the caches hold them."""

_HEAD = struct.Struct("<QQQII")  # times, length, checksum, length of the compression's name
_STORED = struct.Struct("<Q")
_INDEX = struct.Struct("<HI")  # channel, length of the entries
_LONGEST_NAME = 64
_WINDOW = 1 << 20


class Arena:
    """The records of several chunks one after the other in one buffer."""

    def __init__(self) -> None:
        self.buffer: Bytes = np.zeros(_BATCH_BYTES + 2 * SLACK, dtype=np.uint8)
        self.chunks: list[Chunk] = []
        self.fill = SLACK

    def has_room(self, size: int) -> bool:
        """Return whether that many bytes fit; an empty arena grows to hold them."""
        if self.fill + size + SLACK <= len(self.buffer):
            return True
        if self.fill == SLACK:
            self.buffer = np.zeros(size + 2 * SLACK, dtype=np.uint8)
            return True
        return False

    def next_bytes(self, size: int) -> memoryview:
        """Return the next bytes, to be filled."""
        return self.buffer.data[self.fill : self.fill + size]

    def add(self, chunk: Chunk) -> None:
        """Keep a chunk whose records were just placed."""
        self.chunks.append(chunk)
        self.fill = chunk.end

    def clear(self) -> None:
        """Forget all chunks."""
        self.chunks, self.fill = [], SLACK


class RecordStream:
    """The records of one file."""

    def __init__(
        self, stream: BinaryIO, size: int, catalogue: Catalogue, has_chunks: bool = False
    ) -> None:
        self._stream = stream
        self._size = size
        self._catalogue = catalogue
        self._has_chunks = has_chunks
        self._allowance = Allowance()
        self.is_finished = False

    def fill(
        self, arena: Arena, is_wanted: Callable[[int], bool], report: Report
    ) -> Iterator[int]:
        """Fill the arena over and over; yield the position each time it is to be emptied."""
        position = len(MAGIC)
        while position < self._size:
            opcode, length = self._peek(position) or (0, 0)
            following = position + FRAME_SIZE + length
            is_cut = following > self._size and opcode != CHUNK
            if not is_plausible(opcode, length) or is_cut:
                position = self._after_damage(position, report)
            elif opcode in (DATA_END, FOOTER):
                self.is_finished = True
                break
            elif opcode == CHUNK and not is_wanted(position):
                position = following
            elif opcode in (CHUNK, MESSAGE):
                self._has_chunks |= opcode == CHUNK
                room = self._room_for(opcode, position, length)
                if not arena.has_room(room):
                    yield position
                    arena.has_room(room)
                take = self._take_chunk if opcode == CHUNK else self._take_loose
                position = take(arena, position, length, report)
            else:
                self._take_small(arena, opcode, length, report)
                position = following
        else:
            report("the end is missing, as after a recorder that was stopped by force")
        yield position

    def _peek(self, position: int) -> tuple[int, int] | None:
        """Return the frame of a record, leaving the stream at its content."""
        self._stream.seek(position)
        head = self._stream.read(FRAME_SIZE)
        if len(head) < FRAME_SIZE:
            return None
        opcode, length = FRAME.unpack(head)
        return int(opcode), int(length)

    def _room_for(self, opcode: int, position: int, length: int) -> int:
        """Return the bytes that the next chunk needs, leaving the stream at its content."""
        if opcode == MESSAGE:
            return max(FRAME_SIZE + length, min(_BATCH_BYTES, self._size - position))
        head = self._stream.read(_HEAD.size)
        self._stream.seek(position + FRAME_SIZE)
        size: int = _HEAD.unpack(head)[2] if len(head) == _HEAD.size else 0
        stored = min(length, self._size - position)
        return size if size <= self._allowance.room(stored) else 0

    def _take_chunk(self, arena: Arena, position: int, length: int, report: Report) -> int:
        """Place one chunk's records; return where to go on."""
        head = self._stream.read(_HEAD.size + _LONGEST_NAME + 8)
        try:
            _, _, size, crc, name_size = _HEAD.unpack_from(head)
            name = head[_HEAD.size : _HEAD.size + name_size].decode()
            (stored,) = _STORED.unpack_from(head, _HEAD.size + name_size)
        except (struct.error, UnicodeDecodeError):
            return self._after_damage(position, report)
        if _HEAD.size + name_size + 8 + stored != length:
            return self._after_damage(position, report)
        self._stream.seek(position + FRAME_SIZE + length - stored)
        following = position + FRAME_SIZE + length
        try:
            if following > self._size:
                report(f"it is cut off in the chunk at byte {position}")
                size = self._place_part(arena, name)
            else:
                self._place(arena, name, stored, size, crc)
        except BagError as error:
            report(f"the chunk at byte {position} is left out: {error}")
            return min(following, self._size)
        arena.add(Chunk(arena.fill, arena.fill + size, position))
        return min(following, self._size)

    def _place(self, arena: Arena, name: str, stored: int, size: int, crc: int) -> None:
        place = arena.next_bytes(size)
        if name:
            raw = self._stream.read(stored)
            place[:] = decompressed(name, raw, size, crc, self._allowance)
            return
        if stored != size:
            raise BagError(f"{stored} bytes instead of {size}")
        # BufferedReader fills the whole buffer unless the file ends.
        self._stream.readinto(place)  # type: ignore[attr-defined]
        check_sum(place, crc)

    def _place_part(self, arena: Arena, name: str) -> int:
        room = max(len(arena.buffer) - SLACK - arena.fill, 0)
        raw = self._stream.read()
        part = decompressed_part(name, raw, room, self._allowance) if name else raw[:room]
        arena.next_bytes(len(part))[:] = part
        return len(part)

    def _take_loose(self, arena: Arena, position: int, length: int, report: Report) -> int:
        """Place messages that are in no chunk; return where to go on."""
        size = self._room_for(MESSAGE, position, length)
        self._stream.seek(position)
        begin = arena.fill
        self._stream.readinto(arena.next_bytes(size))  # type: ignore[attr-defined]
        starts: list[int] = []
        stop = walk(arena.buffer, begin, begin + size, self._catalogue, starts)
        if stop == begin:
            return self._after_damage(position, report)
        arena.add(Chunk(begin, stop, position, starts=starts))
        return position + stop - begin

    def _take_small(self, arena: Arena, opcode: int, length: int, report: Report) -> None:
        """Take a schema, a channel or a message index; pass over anything else."""
        if opcode not in (SCHEMA, CHANNEL, MESSAGE_INDEX):
            return
        content = self._stream.read(length)
        try:
            if opcode != MESSAGE_INDEX:
                self._catalogue.add(opcode, content)
            elif arena.chunks and arena.chunks[-1].starts is None:
                channel, size = _INDEX.unpack_from(content)
                arena.chunks[-1].index.append((channel, content[_INDEX.size :][:size]))
        except BagError as error:
            report(str(error))

    def _after_damage(self, position: int, report: Report) -> int:
        """Return where records are sound again after a damage, or the end."""
        following = self._next_sound(position + 1, CHUNK)
        if following is None and not self._has_chunks:
            # In a file with chunks these would be the records of a damaged one, unchecked.
            following = self._next_sound(position + 1, MESSAGE)
        if following is None:
            report(f"bytes {position} to {self._size} are damaged or cut off, left out")
            return self._size
        report(f"bytes {position} to {following} are damaged, left out")
        return following

    def _next_sound(self, at: int, opcode: int) -> int | None:
        """Return where the next record of a kind begins that others follow; None if nowhere."""
        end = self._size - len(MAGIC)
        while at < end:
            self._stream.seek(at)
            window = np.frombuffer(self._stream.read(_WINDOW + FRAME_SIZE), dtype=np.uint8)
            for offset in candidates(window, opcode, self._size - at):
                if is_sound(self._peek, at + offset, end):
                    return at + offset
            at += _WINDOW
        return None


_FOOTER_FIELDS = 20
_CRC_SIZE = 4


class McapSummary(NamedTuple):
    """What the end of a file says about it."""

    catalogue: Catalogue  # its channels
    counts: Mapping[int, int] | None  # number of messages by channel
    # channels of each chunk, by its position in the file
    chunk_channels: Mapping[int, frozenset[int]]
    is_complete: bool  # whether all channels are in the catalogue, with their schemas


def read_summary(stream: BinaryIO, size: int) -> McapSummary:
    """Read the summary of a file."""
    tail_size = FRAME_SIZE + _FOOTER_FIELDS + len(MAGIC)
    if size < tail_size + len(MAGIC):
        raise BagError("no footer")
    stream.seek(size - tail_size)
    tail = stream.read(tail_size)
    if tail[-len(MAGIC) :] != MAGIC or FRAME.unpack_from(tail) != (FOOTER, _FOOTER_FIELDS):
        raise BagError("no footer")
    footer = Fields(tail[FRAME_SIZE:])
    begin, _, crc = footer.number(8), footer.number(8), footer.number(_CRC_SIZE)
    if not len(MAGIC) <= begin < size - tail_size:
        raise BagError("no summary")
    stream.seek(begin)
    records = stream.read(size - tail_size - begin)
    checked = records + tail[: FRAME_SIZE + _FOOTER_FIELDS - _CRC_SIZE]
    if crc and zlib.crc32(checked) != crc:
        raise BagError("the summary has a wrong checksum")
    return _parsed(records)


def _parsed(records: bytes) -> McapSummary:
    catalogue = Catalogue()
    counts: dict[int, int] | None = None
    chunk_channels: dict[int, frozenset[int]] = {}
    at = 0
    while at + FRAME_SIZE <= len(records):
        opcode, length = FRAME.unpack_from(records, at)
        at += FRAME_SIZE
        if at + length > len(records):
            raise BagError("the summary is damaged")
        content = records[at : at + length]
        at += length
        if opcode == STATISTICS:
            counts = _counts(content)
        elif opcode == CHUNK_INDEX:
            position, channels = _chunk_channels(content)
            chunk_channels[position] = channels
        else:
            catalogue.add(opcode, content)
    named = {channel for channels in chunk_channels.values() for channel in channels}
    is_complete = (
        counts is not None
        and named | set(counts) <= set(catalogue.channels)
        and not catalogue.lacks_schemas
    )
    return McapSummary(catalogue, counts, chunk_channels, is_complete)


def _counts(content: bytes) -> dict[int, int]:
    fields = Fields(content)
    fields.take(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)  # totals and times
    return {fields.number(2): fields.number(8) for _ in range(fields.number(4) // 10)}


def _chunk_channels(content: bytes) -> tuple[int, frozenset[int]]:
    fields = Fields(content)
    fields.take(16)
    position = fields.number(8)
    fields.take(8)
    pairs = {fields.number(2): fields.number(8) for _ in range(fields.number(4) // 10)}
    return position, frozenset(pairs)


class McapFile:
    """An open MCAP file."""

    def __init__(self, path: Path, report: Report) -> None:
        try:
            self._stream = path.open("rb")
        except OSError as error:
            raise BagError(str(error.strerror or error)) from error
        self._size = os.fstat(self._stream.fileno()).st_size
        if self._stream.read(len(MAGIC)) != MAGIC:
            self._stream.close()
            raise BagError("it does not begin as an MCAP file")
        self._catalogue = Catalogue()
        self._counts: Mapping[int, int] | None = None
        self._chunk_channels: Mapping[int, frozenset[int]] = {}
        try:
            summary = read_summary(self._stream, self._size)
        except BagError:
            self._find_channels(report)
            return
        self._counts = summary.counts
        if summary.is_complete:
            self._catalogue, self._chunk_channels = summary.catalogue, summary.chunk_channels
        else:
            self._find_channels(report)

    def _find_channels(self, report: Report) -> None:
        """Walk every record once for the channels alone."""
        records, arena = RecordStream(self._stream, self._size, self._catalogue), Arena()
        for _ in records.fill(arena, lambda position: True, report):
            for _ in locate(arena.buffer, arena.chunks, self._catalogue, lambda line: None):
                pass
            arena.clear()
        if records.is_finished:
            report("the index is missing or damaged; it was read without")

    def topics(self) -> dict[str, TopicInfo]:
        """Return the topics by full name."""
        topics: dict[str, TopicInfo] = {}
        for number, channel in self._catalogue.channels.items():
            before = topics.get(channel.topic)
            count = None
            if self._counts is not None:
                count = self._counts.get(number, 0) + (
                    (before.message_count or 0) if before else 0
                )
            topics[channel.topic] = TopicInfo(
                channel.type, channel.encoding, count, channel.definition
            )
        return topics

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""
        numbers = frozenset(n for n, c in self._catalogue.channels.items() if c.topic in topics)
        chunks = self._chunk_channels
        found: Counter[int] = Counter()

        def is_wanted(position: int) -> bool:
            channels = chunks.get(position)  # without an index there are none: unknown
            return not channels or not numbers.isdisjoint(channels)

        records = RecordStream(self._stream, self._size, self._catalogue, bool(chunks))
        arena, place = Arena(), 0
        for position in records.fill(arena, is_wanted, report):
            for messages in locate(arena.buffer, arena.chunks, self._catalogue, report):
                yield from self._by_topic(arena.buffer, messages, topics, place, found)
            place += arena.fill
            arena.clear()
            done(position)
        self._compare_counts(numbers, found, report)

    def _compare_counts(
        self, numbers: Iterable[int], found: Mapping[int, int], report: Report
    ) -> None:
        """Report where the file holds another number of messages than its statistics count."""
        if self._counts is None:
            return
        told: Counter[str] = Counter()
        seen: Counter[str] = Counter()
        for number in numbers:
            topic = self._catalogue.channels[number].topic
            told[topic] += self._counts.get(number, 0)
            seen[topic] += found.get(number, 0)
        line = count_difference(told, seen)
        if line:
            report(f"its statistics count {line}")

    def _by_topic(
        self,
        buffer: Bytes,
        messages: Messages,
        topics: frozenset[str],
        place: int,
        found: Counter[int],
    ) -> Iterator[TopicBatch]:
        """Yield the messages of each wanted topic in the order of the file, and count them."""
        channels = self._catalogue.channels
        head = FRAME_SIZE + MESSAGE_HEAD
        for topic in sorted({channel.topic for channel in channels.values()} & topics):
            numbers = [n for n, channel in channels.items() if channel.topic == topic]
            spans = [
                slice(*np.searchsorted(messages.channels, [number, number + 1]).tolist())
                for number in numbers
            ]
            for number, span in zip(numbers, spans, strict=True):
                found[number] += span.stop - span.start
            starts, lengths, _, times = (
                part[spans[0]] if len(spans) == 1 else np.concatenate([part[s] for s in spans])
                for part in messages
            )
            if not len(starts):
                continue
            if (starts[1:] < starts[:-1]).any():
                order = np.argsort(starts, kind="stable")
                starts, lengths, times = starts[order], lengths[order], times[order]
            yield TopicBatch(
                topic, buffer, starts + head, lengths - MESSAGE_HEAD, times, starts + place
            )

"""One MCAP file: finished or cut off, with or without chunks, summary and index.

The message index of a chunk says where its messages are; each entry is compared with the record
it points at, and the records must fill the chunk without a hole. Where they do not, the records
are walked one after the other.

Source: the MCAP format specification, version 0; all integers are little-endian.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from hpid_ros.base.errors import BagError
from hpid_ros.messages.batches import (
    SLACK,
    Advance,
    Allowance,
    Bytes,
    Integers,
    Report,
    TopicBatch,
    TopicInfo,
    check_sum,
    count_difference,
    decompressed,
    decompressed_part,
)
from hpid_ros.messages.columns import gather_words

MAGIC = b"\x89MCAP0\r\n"
FRAME = struct.Struct("<BQ")  # opcode, length of the content
FRAME_SIZE = FRAME.size

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, DATA_END = 0x0B, 0x0F
MESSAGE_HEAD = 22  # channel, sequence, log time, publish time
_LEAST = {SCHEMA: 14, CHANNEL: 16, MESSAGE: MESSAGE_HEAD, CHUNK: 40, MESSAGE_INDEX: 6}
_LARGEST_OPCODE = 0x0F
_FIRST_PRIVATE = 0x80
_SUCCESSORS = 3
"""Records in a row that must be sound before bytes after a damage are trusted again."""

Peek = Callable[[int], "tuple[int, int] | None"]
"""Gives opcode and length of the record at a position, or None at the end."""


class Channel(NamedTuple):
    """A channel record with its schema resolved."""

    topic: str  # full name of the topic
    type: str  # message type
    definition: str  # text of the schema
    encoding: str  # "cdr" for all of ROS 2


class Fields:
    """Reads the fields of one record's content."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def number(self, size: int) -> int:
        """Return the next unsigned integer of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def take(self, size: int) -> bytes:
        """Return the next bytes."""
        end = self._at + size
        if end > len(self._content):
            raise BagError("an MCAP record ends too soon")
        taken, self._at = self._content[self._at : end], end
        return taken

    def text(self) -> str:
        try:
            return self.take(self.number(4)).decode()
        except UnicodeDecodeError:
            raise BagError("a text of an MCAP record is not UTF-8") from None

    def pairs(self) -> dict[int, int]:
        """Return the next map of channels to numbers."""
        return {self.number(2): self.number(8) for _ in range(self.number(4) // 10)}


class Catalogue:
    """Schemas and channels, as their records come by; in a summary, what is in the chunks, too."""

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] | None = None  # number of messages by channel
        # channels of each chunk, by its position in the file
        self.chunk_channels: dict[int, frozenset[int]] = {}
        self._lacks_schemas = False
        self._schemas: dict[int, tuple[str, str]] = {}

    def add(self, opcode: int, content: bytes) -> None:
        """Take a record; those of other opcodes are passed over."""
        fields = Fields(content)
        if opcode == SCHEMA:
            number, name = fields.number(2), fields.text()
            fields.text()
            definition = fields.take(fields.number(4))
            self._schemas[number] = (name, definition.decode(errors="replace"))
        elif opcode == CHANNEL:
            number, schema = fields.number(2), fields.number(2)
            topic, encoding = fields.text(), fields.text()
            self._lacks_schemas |= schema != 0 and schema not in self._schemas
            self.channels[number] = Channel(topic, *self._schemas.get(schema, ("", "")), encoding)
        elif opcode == STATISTICS:
            fields.take(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)  # totals and times
            self.counts = fields.pairs()
        elif opcode == CHUNK_INDEX:
            fields.take(16)
            position = fields.number(8)
            fields.take(8)
            self.chunk_channels[position] = frozenset(fields.pairs())

    @property
    def is_complete(self) -> bool:
        """Whether all channels of the file are there, with their schemas."""
        named = frozenset().union(*self.chunk_channels.values(), self.counts or ())
        return self.counts is not None and named <= set(self.channels) and not self._lacks_schemas


def is_sound(peek: Peek, position: int, end: int) -> bool:
    """Return whether records follow each other from a position on, as far as can be seen."""
    for _ in range(_SUCCESSORS):
        if position == end:
            return True
        frame = peek(position)
        if frame is None or not is_plausible(*frame):
            return False
        position += FRAME_SIZE + frame[1]
        if position > end:
            return False
    return True


def is_plausible(opcode: int, length: int) -> bool:
    """Return whether a record of this opcode can be that long."""
    if opcode >= _FIRST_PRIVATE:
        return True
    return 0 < opcode <= _LARGEST_OPCODE and length >= _LEAST.get(opcode, 0)


def candidates(window: Bytes, opcode: int, room: int) -> list[int]:
    """Return where records of one kind may begin in a window of bytes."""
    inner = len(window) - FRAME_SIZE
    if inner < 0:
        return []
    places = np.flatnonzero(window[: inner + 1] == opcode)
    lengths = np.zeros(len(places), dtype=np.uint64)
    for byte in range(8):
        lengths |= window[places + 1 + byte].astype(np.uint64) << np.uint64(8 * byte)
    found: list[int] = places[lengths < room].tolist()
    return found


_BEFORE = 7  # bytes gathered before a record, so that its length becomes one aligned word
_WORDS = 4


class Messages(NamedTuple):
    """Message records in a buffer, by channel and then by place."""

    starts: Integers  # where the records begin, (n,)
    lengths: Integers  # lengths of their contents, (n,)
    channels: Integers  # their channels, (n,)
    log_times_ns: Integers  # [ns] their log times, (n,)


@dataclass
class Chunk:
    """One chunk's records in a buffer."""

    begin: int  # where they begin in the buffer
    end: int  # where they end
    position: int  # where the chunk begins in the file, for messages to people
    index: list[tuple[int, bytes]] = field(default_factory=list)
    starts: list[int] | None = None  # where its messages are, if that is known already


def locate(
    buffer: Bytes, chunks: Sequence[Chunk], catalogue: Catalogue, report: Report
) -> Iterator[Messages]:
    """Yield the messages of chunks; of intact ones all at once, of others one by one."""
    indexed = [chunk for chunk in chunks if chunk.index]
    is_intact, messages = _by_index(buffer, indexed)
    intact = {id(chunk) for chunk, fine in zip(indexed, is_intact, strict=True) if fine}
    if len(intact) == len(chunks):
        if len(messages.starts):
            yield messages
        return
    for chunk in chunks:
        if id(chunk) in intact:
            yield _by_index(buffer, [chunk])[1]
        else:
            yield _walked(buffer, chunk, catalogue, report)


def _by_index(buffer: Bytes, chunks: Sequence[Chunk]) -> tuple[list[bool], Messages]:
    """Return which chunks are filled by what their index points at, and all valid entries."""
    index = [(entry, number) for number, chunk in enumerate(chunks) for entry in chunk.index]
    index.sort(key=lambda entry: entry[0][0])
    counts = [len(raw) // 16 for (_, raw), _ in index]
    entries = (raw[: 16 * count] for ((_, raw), _), count in zip(index, counts, strict=True))
    offsets = np.frombuffer(b"".join(entries), dtype="<i8")[1::2]  # times lie between
    channels = np.repeat(np.array([channel for (channel, _), _ in index], np.int64), counts)
    owner = np.repeat(np.array([number for _, number in index], dtype=np.int64), counts)
    begins = np.array([chunk.begin for chunk in chunks], dtype=np.int64)
    ends = np.array([chunk.end for chunk in chunks], dtype=np.int64)
    starts = begins[owner] + offsets
    rooms = ends - begins - FRAME_SIZE - MESSAGE_HEAD
    is_inside = (offsets >= 0) & (offsets <= rooms[owner])
    if not is_inside.all():
        starts = np.where(is_inside, starts, begins[owner])
    found = _heads(buffer, starts, is_inside, ends[owner])
    is_valid, messages = found
    is_valid &= messages.channels == channels
    # A record that is named twice could stand for one that is not named.
    back = np.flatnonzero(starts[1:] <= starts[:-1])
    is_same = (owner[back] == owner[back + 1]) & (channels[back] == channels[back + 1])
    is_valid[back[is_same] + 1] = False
    sizes = np.where(is_valid, messages.lengths + FRAME_SIZE, 0)
    filled = np.bincount(owner, sizes, len(chunks))  # exact: far below 2^53
    is_intact = (filled == ends - begins).tolist()
    if is_valid.all() and all(is_intact):
        return is_intact, messages
    return is_intact, Messages(*(part[is_valid] for part in messages))


def _heads(
    buffer: Bytes, starts: Integers, is_inside: Any, ends: Integers
) -> tuple[Any, Messages]:
    """Read the heads of records; return which are messages that end in time, and what they say."""
    words = gather_words(buffer, starts - _BEFORE, _WORDS)
    lengths = words[:, 1].view(np.int64)
    channels = (words[:, 2] & np.uint64(0xFFFF)).view(np.int64)
    log_times = (words[:, 2] >> np.uint64(48)) | (words[:, 3] << np.uint64(16))
    is_valid = is_inside & ((words[:, 0] >> np.uint64(56)) == MESSAGE)
    is_valid &= (lengths >= MESSAGE_HEAD) & (lengths <= ends - starts - FRAME_SIZE)
    return is_valid, Messages(starts, lengths, channels, log_times.view(np.int64))


def _walked(buffer: Bytes, chunk: Chunk, catalogue: Catalogue, report: Report) -> Messages:
    """Walk the records of one chunk; after a damage go on where records are sound again."""
    if chunk.starts is not None:
        return _messages_at(buffer, chunk.starts, chunk.end)
    starts: list[int] = []
    at, lost = chunk.begin, 0
    while at < chunk.end:
        stop = walk(buffer, at, chunk.end, catalogue, starts)
        if stop == chunk.end:
            break
        at = _resume(buffer, stop, chunk.end)
        lost += at - stop
    if lost:
        report(f"{lost} bytes of the chunk at byte {chunk.position} are damaged, left out")
    return _messages_at(buffer, starts, chunk.end)


def _messages_at(buffer: Bytes, starts: list[int], end: int) -> Messages:
    places = np.array(starts, dtype=np.int64)
    is_inside = np.ones(len(places), dtype=np.bool_)
    is_valid, messages = _heads(buffer, places, is_inside, np.full(len(places), end))
    by_channel = np.flatnonzero(is_valid)
    by_channel = by_channel[np.argsort(messages.channels[by_channel], kind="stable")]
    return Messages(*(part[by_channel] for part in messages))


def walk(buffer: Bytes, begin: int, end: int, catalogue: Catalogue, starts: list[int]) -> int:
    """Walk records until the end, or until something is no record; return where that was."""
    view = buffer.data
    unpack = FRAME.unpack_from
    at, last = begin, end - FRAME_SIZE
    while at <= last:
        opcode, length = unpack(view, at)
        following = at + FRAME_SIZE + length
        if following > end or not is_plausible(opcode, length):
            return at
        if opcode == MESSAGE:
            starts.append(at)
        elif opcode in (SCHEMA, CHANNEL):
            try:
                catalogue.add(opcode, bytes(view[at + FRAME_SIZE : following]))
            except BagError:
                return at
        else:  # only these three may be in a chunk
            return at
        at = following
    return at


def _resume(buffer: Bytes, stop: int, end: int) -> int:
    """Return where records are sound again after a damage; the end if nowhere."""

    def peek(position: int) -> tuple[int, int] | None:
        if position + FRAME_SIZE > end:
            return None
        opcode, length = FRAME.unpack_from(buffer.data, position)
        return int(opcode), int(length)

    for offset in candidates(buffer[stop + 1 : end], MESSAGE, end - stop):
        if is_sound(peek, stop + 1 + offset, end):
            return stop + 1 + offset
    return end


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


def read_summary(stream: BinaryIO, size: int) -> Catalogue:
    """Return what the end of a file says about it."""
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
    catalogue, at = Catalogue(), 0
    while at + FRAME_SIZE <= len(records):
        opcode, length = FRAME.unpack_from(records, at)
        at += FRAME_SIZE + length
        if at > len(records):
            raise BagError("the summary is damaged")
        catalogue.add(opcode, records[at - length : at])
    return catalogue


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
        with suppress(BagError):
            summary = read_summary(self._stream, self._size)
            if summary.is_complete:
                self._catalogue = summary
                return
            self._catalogue.counts = summary.counts
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
        topics: dict[str, TopicInfo] = {}
        for number, channel in self._catalogue.channels.items():
            before = topics.get(channel.topic)
            count = None
            if self._catalogue.counts is not None:
                count = self._catalogue.counts.get(number, 0) + (
                    (before.message_count or 0) if before else 0
                )
            topics[channel.topic] = TopicInfo(
                channel.type, channel.encoding, count, channel.definition
            )
        return topics

    def close(self) -> None:
        self._stream.close()

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""
        numbers = frozenset(n for n, c in self._catalogue.channels.items() if c.topic in topics)
        chunks = self._catalogue.chunk_channels
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
        if self._catalogue.counts is None:
            return
        counted: Counter[str] = Counter()
        seen: Counter[str] = Counter()
        for number in numbers:
            topic = self._catalogue.channels[number].topic
            counted[topic] += self._catalogue.counts.get(number, 0)
            seen[topic] += found.get(number, 0)
        line = count_difference(counted, seen)
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

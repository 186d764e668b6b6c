"""One MCAP file: finished or cut off, with or without chunks, summary and index.

Records are walked one after the other; the index is asked for topics, and for chunks that hold
none that is wanted. A library reads no file that was cut off, and takes eight times as long
(rosbags 0.11.9; mcap 1.6.0: seventeen times).

A few kilobytes can unpack to any number of gigabytes. So everything, of SQLite files as well, is
unpacked up to a stated size only: what a chunk declares, and never more than the
:class:`Allowance` of its file.

Source: the MCAP format specification, version 0; all integers are little-endian.
"""

from __future__ import annotations

import bz2
import os
import struct
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hpid_ros.base.errors import BagError, SettingError
from hpid_ros.messages.columns import (
    SLACK,
    Bytes,
    TopicBatch,
    TopicInfo,
    count_difference,
    gather_words,
)

Report = Callable[[str], None]
"""Takes one line about something that could not be read."""

Advance = Callable[[int], None]
"""Takes the number of bytes of a file that are done."""


LIMIT_VARIABLE = "HPID_UNPACK_LIMIT"
"""Environment variable with the bytes that may be unpacked whatever they are packed in."""

DEFAULT_LIMIT = 256 << 20
"""Its default, in bytes: a hundred times what a recorder puts into a chunk."""

RATIO = 100
"""How often its own size anything may unpack to; recordings of joints reach some 10."""

_BLOCK = 1 << 20


class Allowance:
    """How much one reading of a file may unpack.

    :data:`LIMIT_VARIABLE` bytes, and :data:`RATIO` times what they are packed in: memory, disk and
    time stay in proportion to the file.
    """

    def __init__(self) -> None:
        text = os.environ.get(LIMIT_VARIABLE, str(DEFAULT_LIMIT))
        if not (text.isascii() and text.isdecimal()):
            raise SettingError(f"{LIMIT_VARIABLE} must be a number of bytes, not {text!r}")
        self._limit = self._spare = int(text)

    def room(self, packed: int) -> int:
        """Return how much may come out of so many packed bytes."""
        return self._spare + RATIO * packed

    def require(self, packed: int, size: int) -> None:
        """Raise BagError unless so many bytes may come out of the packed ones."""
        if size > self.room(packed):
            raise self.refusal(packed)

    def refusal(self, packed: int) -> BagError:
        """Return the error for packed bytes that hold more than may come out."""
        return BagError(
            f"{packed} bytes would unpack to more than {self.room(packed)}; "
            f"{LIMIT_VARIABLE} (now {self._limit} bytes) allows more"
        )

    def spend(self, packed: int, size: int) -> None:
        """Take into account what came out."""
        self._spare = min(self._limit, self.room(packed) - size)


def decompressed(compression: str, raw: bytes, size: int, crc: int, allowance: Allowance) -> bytes:
    allowance.require(len(raw), size)
    records, is_whole = _unpacked(compression, raw, size)
    allowance.spend(len(raw), len(records))
    if not is_whole or len(records) != size:
        raise BagError(f"{len(records)} bytes{'' if is_whole else ' and more'} instead of {size}")
    check_sum(records, crc)
    return records


def decompressed_part(compression: str, raw: bytes, most: int, allowance: Allowance) -> bytes:
    """Return what can be decompressed of a chunk that is cut off, up to a size."""
    part, _ = _unpacked(compression, raw, min(most, allowance.room(len(raw))))
    allowance.spend(len(raw), len(part))
    return part


def decompressed_message(raw: bytes, allowance: Allowance) -> bytes:
    """Return a message that was compressed by itself, with zstd."""
    return decompressed_chunk("zstd", raw, allowance)


def decompressed_chunk(compression: str, raw: bytes, allowance: Allowance) -> bytes:
    """Return bytes that do not declare what they unpack to."""
    records, is_whole = _unpacked(compression, raw, allowance.room(len(raw)))
    if not is_whole:
        raise allowance.refusal(len(raw))
    allowance.spend(len(raw), len(records))
    return records


def unpack_file(source: Path, target: Path, allowance: Allowance) -> bool:
    """Unpack a zstd file as far as it goes."""
    zstd = zstd_library()
    packed, size = source.stat().st_size, 0
    with zstd.open(source, "rb") as stream, target.open("wb") as unpacked:
        try:
            while block := stream.read(_BLOCK):
                size += len(block)
                allowance.require(packed, size)
                unpacked.write(block)
        except (EOFError, zstd.ZstdError):
            return False
    return True


def check_sum(records: Any, crc: int) -> None:
    """Raise BagError unless the checksum is right or not given."""
    if crc and zlib.crc32(records) != crc:
        raise BagError("wrong checksum")


def _unpacked(compression: str, raw: bytes, most: int) -> tuple[bytes, bool]:
    """Return what comes out of one or several frames up to a size, and whether that is all."""
    new: Callable[[], Any]
    if compression == "zstd":
        new = zstd_library().ZstdDecompressor
    elif compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        new = lz4.frame.LZ4FrameDecompressor
    elif compression == "bz2":  # of ROS 1
        new = bz2.BZ2Decompressor
    else:
        raise BagError(f"unknown compression {compression!r}")
    parts: list[bytes] = []
    try:
        while raw:
            frame = new()
            # One byte more than may come out tells whether there is more.
            parts.append(frame.decompress(raw, most + 1))
            most -= len(parts[-1])
            if most < 0:
                return b"".join(parts)[:most], False
            if not frame.eof:
                break
            raw = frame.unused_data or b""
    # The libraries raise whatever their C code finds: RuntimeError, ZstdError, EOFError.
    except Exception as error:
        raise BagError(f"{compression} data is damaged") from error
    return parts[0] if len(parts) == 1 else b"".join(parts), True


def zstd_library() -> Any:
    """Return zstd: of the standard library from CPython 3.14 on, else its backport."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


MAGIC = b"\x89MCAP0\r\n"
FRAME = struct.Struct("<BQ")  # opcode, length of the content
FRAME_SIZE = FRAME.size

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(2, 9)
STATISTICS, DATA_END = 0x0B, 0x0F
MESSAGE_HEAD = 22  # channel, sequence, log time, publish time
_LEAST = {SCHEMA: 14, CHANNEL: 16, MESSAGE: MESSAGE_HEAD, CHUNK: 40, MESSAGE_INDEX: 6}
_LARGEST_OPCODE = 0x0F
_FIRST_PRIVATE = 0x80
_SUCCESSORS = 3
"""Records in a row that must be sound before bytes after a damage are trusted again."""

Read = Callable[[int, int], bytes]
"""Gives the bytes at a position, up to so many."""


class Fields:
    """Reads the fields of one record's content."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def number(self, size: int) -> int:
        """Return the next unsigned integer of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def take(self, size: int) -> bytes:
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

    def texts(self) -> dict[str, str]:
        """Return the next map of texts to texts."""
        end = self.number(4) + self._at
        found: dict[str, str] = {}
        while self._at < end:
            name = self.text()
            found[name] = self.text()
        return found


class Catalogue:
    """Schemas and channels, as their records come by; in a summary, what is in the chunks, too."""

    def __init__(self) -> None:
        # topic of each channel by number, and what its record and its schema's say of it
        self.channels: dict[int, tuple[str, TopicInfo]] = {}
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
            self._schemas[number] = name, fields.take(fields.number(4)).decode(errors="replace")
        elif opcode == CHANNEL:
            number, schema = fields.number(2), fields.number(2)
            topic, encoding, metadata = fields.text(), fields.text(), fields.texts()
            self._lacks_schemas |= schema != 0 and schema not in self._schemas
            kind, definition = self._schemas.get(schema, ("", ""))
            qos = metadata.get("offered_qos_profiles", "")
            self.channels[number] = topic, TopicInfo(kind, encoding, definition, qos)
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


def is_sound(read: Read, position: int, end: int) -> bool:
    """Return whether records follow each other from a position on, as far as can be seen."""
    for _ in range(_SUCCESSORS):
        if position == end:
            return True
        frame = read(position, FRAME_SIZE)
        if len(frame) < FRAME_SIZE or not is_plausible(*FRAME.unpack(frame)):
            return False
        position += FRAME_SIZE + FRAME.unpack(frame)[1]
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


_WINDOW = 1 << 20


def next_sound(read: Read, at: int, end: int, opcode: int) -> int | None:
    """Return where the next record of a kind begins that others follow; None if nowhere."""
    while at < end:
        window = np.frombuffer(read(at, _WINDOW + FRAME_SIZE), dtype=np.uint8)
        for offset in candidates(window, opcode, end - at):
            if is_sound(read, at + offset, end):
                return at + offset
        at += _WINDOW
    return None


def walk(records: bytes, at: int, catalogue: Catalogue, starts: list[int]) -> int:
    """Walk records until the end, or until something is no record; return where that was."""
    unpack, end = FRAME.unpack_from, len(records)
    last = end - FRAME_SIZE
    while at <= last:
        opcode, length = unpack(records, at)
        following = at + FRAME_SIZE + length
        if following > end:
            return at
        if opcode == MESSAGE and length >= MESSAGE_HEAD:
            starts.append(at)
        elif opcode in (SCHEMA, CHANNEL):
            try:
                catalogue.add(opcode, records[at + FRAME_SIZE : following])
            except BagError:
                return at
        else:  # only these three may be in a chunk
            return at
        at = following
    return at


_BATCH_BYTES = 4 << 20
"""Bytes of messages in no chunk that are looked at together."""
_TOGETHER = 1 << 20
"""Bytes of chunks that are looked at together: a recorder that writes often makes small ones."""

_HEAD = struct.Struct("<QQQII")  # times, length, checksum, length of the compression's name
_STORED = struct.Struct("<Q")
_BEFORE = 7  # bytes gathered before a record, so that its length becomes one aligned word


class Records(NamedTuple):
    """Records of chunks, or of none."""

    content: bytes
    starts: list[int]  # where their messages begin
    end: int  # where they end in the file


def _together(each: Iterable[Records]) -> Iterator[Records]:
    """Yield the records of small chunks at once."""
    parts: list[bytes] = []
    starts: list[int] = []
    size = end = 0
    for records in each:
        if size and size + len(records.content) > _TOGETHER:
            yield Records(b"".join(parts), starts, end)
            parts, starts, size = [], [], 0
        parts.append(records.content)
        starts += [size + start for start in records.starts] if size else records.starts
        size, end = size + len(records.content), records.end
    if parts:
        yield Records(b"".join(parts), starts, end)


_FOOTER_FIELDS = 20
_CRC_SIZE = 4


def read_summary(read: Read, size: int) -> Catalogue:
    """Return what the end of a file says about it."""
    tail_size = FRAME_SIZE + _FOOTER_FIELDS + len(MAGIC)
    if size < tail_size + len(MAGIC):
        raise BagError("no footer")
    tail = read(size - tail_size, tail_size)
    if tail[-len(MAGIC) :] != MAGIC or FRAME.unpack_from(tail) != (FOOTER, _FOOTER_FIELDS):
        raise BagError("no footer")
    footer = Fields(tail[FRAME_SIZE:])
    begin, _, crc = footer.number(8), footer.number(8), footer.number(_CRC_SIZE)
    if not len(MAGIC) <= begin < size - tail_size:
        raise BagError("no summary")
    records = read(begin, size - tail_size - begin)
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
    def __init__(self, path: Path, report: Report) -> None:
        try:
            self._stream = path.open("rb")
        except OSError as error:
            raise BagError(str(error.strerror or error)) from error
        self._size = os.fstat(self._stream.fileno()).st_size
        if self._read(0, len(MAGIC)) != MAGIC:
            self._stream.close()
            raise BagError("it does not begin as an MCAP file")
        self._catalogue = Catalogue()
        self._is_finished = False
        with suppress(BagError):
            summary = read_summary(self._read, self._size)
            if summary.is_complete:
                self._catalogue = summary
                return
            self._catalogue.counts = summary.counts
        for _ in self._records(lambda position: True, report):  # for the channels alone
            pass
        if self._is_finished:
            report("the index is missing or damaged; it was read without")

    def topics(self) -> dict[str, TopicInfo]:
        return dict(self._catalogue.channels.values())

    def close(self) -> None:
        self._stream.close()

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""
        channels = self._catalogue.channels
        numbers = frozenset(n for n, (topic, _) in channels.items() if topic in topics)
        chunks = self._catalogue.chunk_channels

        def is_wanted(position: int) -> bool:
            held = chunks.get(position)  # without an index there are none: unknown
            return not held or not numbers.isdisjoint(held)

        place, found = 0, dict.fromkeys(sorted(topics), 0)
        for records in _together(self._records(is_wanted, report)):
            if records.starts:
                for batch in self._by_topic(records, found, place):
                    found[batch.topic] += len(batch.starts)
                    yield batch
            place += len(records.content)
            done(records.end)
        counts = self._counts() or Counter()
        counted = {topic: count for topic, count in counts.items() if topic in topics}
        if line := count_difference(counted, found):
            report(f"its statistics count {line}")

    def _counts(self) -> Counter[str] | None:
        """Return how many messages of each topic the statistics count; None without any."""
        if self._catalogue.counts is None:
            return None
        counts: Counter[str] = Counter()
        for number, (topic, _) in self._catalogue.channels.items():
            counts[topic] += self._catalogue.counts.get(number, 0)
        return counts

    def _by_topic(
        self, records: Records, topics: Iterable[str], place: int
    ) -> Iterator[TopicBatch]:
        """Yield the messages of each of some topics in the order of the file."""
        slack = bytes(SLACK)
        buffer = np.frombuffer(b"".join((slack, records.content, slack)), dtype=np.uint8)
        starts = np.array(records.starts, dtype=np.int64) + SLACK
        words = gather_words(buffer, starts - _BEFORE, 4)
        sizes = words[:, 1].view(np.int64) - MESSAGE_HEAD
        owners = words[:, 2] & np.uint64(0xFFFF)
        times = ((words[:, 2] >> np.uint64(48)) | (words[:, 3] << np.uint64(16))).view(np.int64)
        whole = TopicBatch(
            "", buffer, starts + FRAME_SIZE + MESSAGE_HEAD, sizes, times, starts + place
        )
        channels = self._catalogue.channels.items()
        for topic in topics:
            numbers = [n for n, (name, _) in channels if name == topic]
            is_own = owners == numbers[0] if len(numbers) == 1 else np.isin(owners, numbers)
            if is_own.all():
                yield whole._replace(topic=topic)
            elif is_own.any():
                yield whole.picked(is_own)._replace(topic=topic)

    def _read(self, position: int, size: int) -> bytes:
        self._stream.seek(position)
        return self._stream.read(size)

    def _records(self, is_wanted: Callable[[int], bool], report: Report) -> Iterator[Records]:
        """Yield all records with messages, and whatever is before the end of the file."""
        position, allowance = len(MAGIC), Allowance()
        has_chunks = bool(self._catalogue.chunk_channels)
        while position < self._size:
            frame = self._read(position, FRAME_SIZE)
            opcode, length = FRAME.unpack(frame) if len(frame) == FRAME_SIZE else (0, 0)
            following = position + FRAME_SIZE + length
            is_damaged = not is_plausible(opcode, length)
            is_damaged |= following > self._size and opcode != CHUNK
            if opcode in (DATA_END, FOOTER) and not is_damaged:
                self._is_finished = True
                return
            starts: list[int] = []
            if opcode == CHUNK and not is_damaged:
                has_chunks = True
                if is_wanted(position):
                    content = self._chunk(position, length, allowance, report)
                    is_damaged = content is None
                    if content:
                        where = f"the chunk at byte {position}"
                        starts = _starts(content, self._catalogue, where, report)
                        yield Records(content, starts, min(following, self._size))
            elif opcode == MESSAGE and not is_damaged:
                content = self._read(position, max(FRAME_SIZE + length, _BATCH_BYTES))
                stop = walk(content, 0, self._catalogue, starts)
                following = position + stop
                yield Records(content[:stop], starts, following)
            elif opcode in (SCHEMA, CHANNEL) and not is_damaged:
                try:
                    self._catalogue.add(opcode, self._stream.read(length))
                except BagError as error:
                    report(str(error))
            if not is_damaged:
                position = following
            else:
                position = self._after_damage(position, has_chunks, report)
        report("the end is missing, as after a recorder that was stopped by force")

    def _chunk(
        self, position: int, length: int, allowance: Allowance, report: Report
    ) -> bytes | None:
        """Return the records of a chunk, none if they cannot be unpacked; None if it is none."""
        content = self._stream.read(min(length, self._size))
        try:
            _, _, size, crc, name_size = _HEAD.unpack_from(content)
            begin = _HEAD.size + name_size + _STORED.size
            name = content[_HEAD.size : begin - _STORED.size].decode()
            (stored,) = _STORED.unpack_from(content, begin - _STORED.size)
        except (struct.error, UnicodeDecodeError):
            return None
        if begin + stored != length:
            return None
        raw = content[begin:]
        try:
            if len(raw) < stored:
                report(f"it is cut off in the chunk at byte {position}")
                return decompressed_part(name, raw, size, allowance) if name else raw
            if name:
                return decompressed(name, raw, size, crc, allowance)
            if stored != size:
                raise BagError(f"{stored} bytes instead of {size}")
            check_sum(raw, crc)
        except BagError as error:
            report(f"the chunk at byte {position} is left out: {error}")
            return b""
        return raw

    def _after_damage(self, position: int, has_chunks: bool, report: Report) -> int:
        """Return where records are sound again after a damage, or the end."""
        end = self._size - len(MAGIC)
        following = next_sound(self._read, position + 1, end, CHUNK)
        if following is None and not has_chunks:
            # In a file with chunks these would be the records of a damaged one, unchecked.
            following = next_sound(self._read, position + 1, end, MESSAGE)
        if following is None:
            report(f"bytes {position} to {self._size} are damaged or cut off, left out")
            return self._size
        report(f"bytes {position} to {following} are damaged, left out")
        return following


def _starts(content: bytes, catalogue: Catalogue, where: str, report: Report) -> list[int]:
    """Return where the messages of a chunk begin; after a damage go on where records are sound."""

    def read(position: int, size: int) -> bytes:
        return content[position : position + size]

    starts: list[int] = []
    at, lost, end = 0, 0, len(content)
    while (stop := walk(content, at, catalogue, starts)) < end:
        at = next_sound(read, stop + 1, end, MESSAGE) or end
        lost += at - stop
    if lost:
        report(f"{lost} bytes of {where} are damaged, left out")
    return starts

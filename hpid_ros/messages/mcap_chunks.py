"""MCAP records and chunks: decompressed, and their messages found many at once.

The message index of a chunk says where its messages are; each entry is compared with the record
it points at, and the records must fill the chunk without a hole. Where they do not, the records
are walked one after the other.

A few kilobytes can unpack to any number of gigabytes. So everything is unpacked up to a stated
size only: what a chunk declares, and never more than the :class:`Allowance` of its file.

Source: the MCAP format specification, version 0; all integers are little-endian.
"""

from __future__ import annotations

import os
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hpid_ros.base.errors import BagError, SettingError
from hpid_ros.messages.columns import Bytes, Integers, Report, gather_words

if TYPE_CHECKING:
    from collections.abc import Sequence


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
    """Return a chunk's records."""
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
    message, is_whole = _unpacked("zstd", raw, allowance.room(len(raw)))
    if not is_whole:
        raise allowance.refusal(len(raw))
    allowance.spend(len(raw), len(message))
    return message


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
    if compression not in ("zstd", "lz4"):
        raise BagError(f"unknown compression {compression!r}")
    new = zstd_library().ZstdDecompressor if compression == "zstd" else _lz4_decompressor()
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
    # Both libraries raise whatever their C code finds: RuntimeError, ZstdError, EOFError.
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


def _lz4_decompressor() -> Any:
    import lz4.frame  # type: ignore[import-untyped]

    return lz4.frame.LZ4FrameDecompressor


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
        """Return the next text."""
        try:
            return self.take(self.number(4)).decode()
        except UnicodeDecodeError:
            raise BagError("a text of an MCAP record is not UTF-8") from None


class Catalogue:
    """Schemas and channels, as their records come by."""

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.lacks_schemas = False
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
            self.lacks_schemas |= schema != 0 and schema not in self._schemas
            self.channels[number] = Channel(topic, *self._schemas.get(schema, ("", "")), encoding)


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
    """Read the heads of records and tell which are messages that end in time."""
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

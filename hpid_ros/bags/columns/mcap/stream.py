"""Walks an MCAP file from front to back, chunk by chunk, past whatever is damaged."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from typing import BinaryIO

import numpy as np

from hpid_ros.bags.columns.batches import SLACK, Bytes, Report
from hpid_ros.bags.columns.compression import Allowance, check_sum, decompressed, decompressed_part
from hpid_ros.bags.columns.mcap.chunks import Chunk, walk
from hpid_ros.bags.columns.mcap.records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    FRAME,
    FRAME_SIZE,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    SCHEMA,
    Catalogue,
    candidates,
    is_plausible,
    is_sound,
)
from hpid_ros.base.errors import BagError

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
        """Tell whether that many bytes fit; an empty arena grows to hold them."""
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

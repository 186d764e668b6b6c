"""MCAP records: their frame, the few whose content matters, and where reading can go on.

Source: the MCAP format specification, version 0; all integers are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hpid_ros.bags.columns.batches import Bytes
from hpid_ros.base.errors import BagError

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
    """Tell whether records follow each other from a position on, as far as can be seen."""
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
    """Tell whether a record of this opcode can be that long."""
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

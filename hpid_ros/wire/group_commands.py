"""Efforts of a group of joints as one serialised message, without a message object.

``std_msgs/msg/Float64MultiArray`` as the group controllers of ros2_control take it, numbers in
their order and nothing else; ``control_msgs/msg/DynamicJointState`` with an interface by name. All
but the stamp and the numbers is written once.

Source: the definitions of the two messages; for the wire format see :mod:`hpid_ros.wire.cdr`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.wire.cdr import ENCAPSULATION, Cursor, Writer

EFFORT = "effort"
"""Name of the interface of efforts, in ros2_control."""

_DOUBLE = 8


class MultiArrayTemplate:
    """A Float64MultiArray without a layout; the message has no place for names or stamps."""

    def __init__(self, count: int) -> None:
        writer = Writer()
        for value in (0, 0, count):  # no dimensions, no offset, so many numbers
            writer.scalar("I", value)
        writer.doubles([0.0] * count)
        self._head = writer.raw[: -_DOUBLE * count]
        self._numbers = struct.Struct(f"<{count}d")

    def encode(self, stamp_ns: int, *, effort: Sequence[float]) -> bytes:
        """Return the serialised message."""
        return self._head + self._numbers.pack(*effort)


_MOST_DIMENSIONS, _MOST_NUMBERS = 8, 64


def decode_numbers(raw: bytes) -> tuple[float, ...]:
    """Return the numbers of a serialised Float64MultiArray; its layout is passed over."""
    cursor = Cursor(raw, "Float64MultiArray")
    dimensions = cursor.scalar("I")
    if dimensions > _MOST_DIMENSIONS:
        raise MessageError(f"{dimensions} dimensions, {_MOST_DIMENSIONS} are allowed")
    for _ in range(dimensions):
        cursor.string()
        cursor.scalar("I")
        cursor.scalar("I")
    cursor.scalar("I")
    numbers = cursor.doubles()
    if len(numbers) > _MOST_NUMBERS:
        raise MessageError(f"{len(numbers)} numbers, {_MOST_NUMBERS} are allowed")
    return numbers


class DynamicJointStateTemplate:
    """A DynamicJointState with the interface ``effort`` for each joint."""

    def __init__(self, names: Sequence[str], frame_id: str = "") -> None:
        writer = Writer()
        writer.scalar("i", 0)
        writer.scalar("I", 0)
        writer.string(frame_id)
        writer.scalar("I", len(names))
        for name in names:
            writer.string(name)
        writer.scalar("I", len(names))
        self._offsets: list[int] = []
        for _ in names:
            writer.scalar("I", 1)
            writer.string(EFFORT)
            writer.scalar("I", 1)
            writer.doubles([0.0])
            self._offsets.append(len(writer.raw) - _DOUBLE)
        self._buffer = bytearray(writer.raw)
        self._stamp, self._number = struct.Struct("<iI"), struct.Struct("<d")

    def encode(self, stamp_ns: int, *, effort: Sequence[float]) -> bytes:
        """Return the serialised message."""
        self._stamp.pack_into(self._buffer, ENCAPSULATION, *divmod(stamp_ns, NANOSECONDS))
        for offset, number in zip(self._offsets, effort, strict=True):
            self._number.pack_into(self._buffer, offset, number)
        return bytes(self._buffer)

"""``sensor_msgs/msg/JointState`` between bytes and numbers, without a message object.

The wire format is plain CDR (XCDR version 1): a four-byte encapsulation header, then
``header.stamp`` (int32 s, uint32 ns), ``header.frame_id``, ``name``, ``position``, ``velocity``
and ``effort``; every value is aligned to its own size, counted from the end of the
encapsulation header. Stamps are integer nanoseconds and numbers stay IEEE doubles, so nothing
is rounded on the way.

Source: OMG DDS-RTPS 2.5 section 10 (encapsulation), OMG DDS-XTypes 1.3 section 7.4.1 (CDR), and
the definition of ``sensor_msgs/msg/JointState``.

A four-byte encapsulation header, then the fields; every value is aligned to its own size,
counted from the end of that header.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS

ENCAPSULATION = 4
_BYTE_ORDERS = {0: ">", 1: "<"}
_DOUBLE = 8


class Cursor:
    """Reads CDR values one after the other and refuses to leave the buffer."""

    def __init__(self, raw: bytes, kind: str) -> None:
        self._kind = kind
        if len(raw) < ENCAPSULATION or raw[0] != 0 or raw[1] not in _BYTE_ORDERS:
            raise MessageError(
                f"a {kind} must start with a plain CDR header (00 00 or 00 01), "
                f"not {bytes(raw[:2]).hex(' ') or 'nothing'}"
            )
        self._raw = raw
        self._order = _BYTE_ORDERS[raw[1]]
        self.offset = ENCAPSULATION

    def _align(self, size: int) -> None:
        self.offset += -(self.offset - ENCAPSULATION) % size

    def scalar(self, code: str) -> int:
        """Return an integer of a struct code."""
        size = struct.calcsize(code)
        self._align(size)
        self._require(size)
        (value,) = struct.unpack_from(self._order + code, self._raw, self.offset)
        self.offset += size
        return int(value)

    def string(self) -> str:
        """Return a text."""
        length = self.scalar("I")
        self._require(length)
        raw = bytes(self._raw[self.offset : self.offset + length])
        self.offset += length
        try:
            return raw.rstrip(b"\x00").decode()
        except UnicodeDecodeError:
            raise MessageError(f"a {self._kind} name must be UTF-8, not {raw!r}") from None

    def strings(self) -> tuple[str, ...]:
        """Return a sequence of texts."""
        count = self.scalar("I")
        if count > len(self._raw):
            raise MessageError(
                f"a {self._kind} of {len(self._raw)} bytes cannot hold {count} names"
            )
        return tuple(self.string() for _ in range(count))

    def double(self) -> float:
        """Return a double."""
        (value,) = self._values("d", 1)
        return float(value)

    def doubles(self) -> tuple[float, ...]:
        """Return a sequence of doubles."""
        return self._values("d", self.scalar("I"))

    def integers(self, code: str) -> tuple[int, ...]:
        """Return a sequence of integers of a struct code."""
        return self._values(code, self.scalar("I"))

    def _values(self, code: str, count: int) -> tuple[Any, ...]:
        if count == 0:
            return ()
        size = struct.calcsize(code)
        self._align(size)
        self._require(count * size)
        values = struct.unpack_from(f"{self._order}{count}{code}", self._raw, self.offset)
        self.offset += count * size
        return values

    def _require(self, size: int) -> None:
        if self.offset + size > len(self._raw):
            raise MessageError(
                f"a {self._kind} of {len(self._raw)} bytes ends before byte {self.offset + size}"
            )


class Writer:
    """Writes CDR values one after the other, little endian."""

    def __init__(self) -> None:
        self._raw = bytearray(b"\x00\x01\x00\x00")

    @property
    def raw(self) -> bytes:
        """The message so far, with its encapsulation header."""
        return bytes(self._raw)

    def _align(self, size: int) -> None:
        self._raw += bytes(-(len(self._raw) - ENCAPSULATION) % size)

    def scalar(self, code: str, value: int) -> None:
        """Append an integer of a struct code."""
        self._align(struct.calcsize(code))
        self._raw += struct.pack(f"<{code}", value)

    def string(self, text: str) -> None:
        """Append a text."""
        raw = text.encode() + b"\x00"
        self.scalar("I", len(raw))
        self._raw += raw

    def doubles(self, values: Sequence[float]) -> None:
        """Append doubles without their number, as of an array of fixed length."""
        self._align(_DOUBLE)
        self._raw += struct.pack(f"<{len(values)}d", *values)


def require_nanoseconds(nanoseconds: int) -> None:
    """Refuse a stamp whose nanoseconds are a second or more: it could not be sent back."""
    if nanoseconds >= NANOSECONDS:
        raise MessageError(f"a stamp's nanoseconds must be below 1e9, not {nanoseconds}")


_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_COUNT = struct.Struct("<I")

STAMP_OFFSET = ENCAPSULATION
NAMES_OFFSET = STAMP_OFFSET + 8


class JointStateFields(NamedTuple):
    """All fields of a JointState."""

    stamp_ns: int  # [ns] header.stamp
    frame_id: str  # header.frame_id
    names: tuple[str, ...]  # joint names
    position: tuple[float, ...]  # [rad] or [m]; empty when the message has none
    velocity: tuple[float, ...]  # [rad/s] or [m/s]; empty when the message has none
    effort: tuple[float, ...]  # [N m] or [N]; empty when the message has none


def decode_joint_state(raw: bytes) -> JointStateFields:
    """Decode any serialised JointState, whatever its layout or byte order."""
    cursor = Cursor(raw, "JointState")
    seconds = cursor.scalar("i")
    nanoseconds = cursor.scalar("I")
    require_nanoseconds(nanoseconds)
    frame_id = cursor.string()
    names = cursor.strings()
    return JointStateFields(
        seconds * NANOSECONDS + nanoseconds,
        frame_id,
        names,
        cursor.doubles(),
        cursor.doubles(),
        cursor.doubles(),
    )


@dataclass(frozen=True)
class JointStateLayout:
    """Where the numbers of a little-endian JointState lie.

    Two messages with the same frame, names and array lengths have the same layout; only the
    stamp and the doubles differ. Offsets are in bytes from the start of the raw message; an
    array that is empty has offset 0.
    """

    names: tuple[str, ...]  # joint names
    size: int  # length of the whole message in bytes
    position: int  # offset of the first position
    velocity: int  # offset of the first velocity
    effort: int  # offset of the first effort
    lengths: tuple[int, int, int]  # numbers of positions, velocities and efforts
    # (offset, bytes) of everything that is neither stamp nor double
    fixed: tuple[tuple[int, bytes], ...]

    @classmethod
    def of(cls, raw: bytes) -> JointStateLayout:
        """Learn the layout of one message."""
        fields = decode_joint_state(raw)
        if raw[1] != _LITTLE_ENDIAN[1]:
            raise MessageError("only little-endian JointStates have a fixed layout here")
        lengths = (len(fields.position), len(fields.velocity), len(fields.effort))
        layout = cls.for_fields(fields.names, fields.frame_id, lengths)
        if not layout.matches(raw):
            raise MessageError("a JointState with unusual padding has no fixed layout here")
        return layout

    @classmethod
    def for_fields(
        cls, names: Sequence[str], frame_id: str, lengths: tuple[int, int, int]
    ) -> JointStateLayout:
        """Lay out a message that has these names, this frame and arrays of these lengths."""
        prefix = bytearray()
        _append_string(prefix, frame_id)
        _pad(prefix, 4)
        prefix += _COUNT.pack(len(names))
        for name in names:
            _append_string(prefix, name)
        _pad(prefix, 4)
        fixed: list[tuple[int, bytes]] = []
        offsets: list[int] = []
        at, segment = NAMES_OFFSET, bytes(prefix)
        for length in lengths:
            segment += _COUNT.pack(length)
            if length == 0:
                offsets.append(0)
                continue
            end = at + len(segment)
            segment += b"\x00" * (-(end - ENCAPSULATION) % _DOUBLE)
            fixed.append((at, segment))
            offsets.append(at + len(segment))
            at, segment = at + len(segment) + length * _DOUBLE, b""
        if segment:
            fixed.append((at, segment))
        position, velocity, effort = offsets
        size = at + len(segment)
        return cls(tuple(names), size, position, velocity, effort, lengths, tuple(fixed))

    def matches(self, raw: bytes) -> bool:
        """Return whether a message has this layout, byte for byte."""
        return (
            len(raw) == self.size
            and raw.startswith(_LITTLE_ENDIAN)
            and all(raw.startswith(segment, offset) for offset, segment in self.fixed)
        )


class JointStateTemplate:
    """A JointState that is serialised but for its stamp and numbers.

    The bytes equal those that ``rclpy.serialization.serialize_message`` gives for the same
    fields.
    """

    def __init__(
        self,
        names: Sequence[str],
        frame_id: str = "",
        *,
        position: bool = False,
        velocity: bool = False,
        effort: bool = False,
    ) -> None:
        count = len(names)
        lengths = (count * position, count * velocity, count * effort)
        self.layout = JointStateLayout.for_fields(names, frame_id, lengths)
        self._buffer = bytearray(self.layout.size)
        self._buffer[:ENCAPSULATION] = _LITTLE_ENDIAN
        for offset, segment in self.layout.fixed:
            self._buffer[offset : offset + len(segment)] = segment
        self._stamp = struct.Struct("<iI")
        self._doubles = struct.Struct(f"<{count}d")

    def encode(
        self,
        stamp_ns: int,
        *,
        position: Sequence[float] = (),
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> bytes:
        """Return the serialised message."""
        layout, buffer = self.layout, self._buffer
        self._stamp.pack_into(buffer, STAMP_OFFSET, *divmod(stamp_ns, NANOSECONDS))
        if layout.position:
            self._doubles.pack_into(buffer, layout.position, *position)
        if layout.velocity:
            self._doubles.pack_into(buffer, layout.velocity, *velocity)
        if layout.effort:
            self._doubles.pack_into(buffer, layout.effort, *effort)
        return bytes(buffer)


def _append_string(buffer: bytearray, text: str) -> None:
    """Append a CDR string to bytes that start at an aligned offset."""
    encoded = text.encode() + b"\x00"
    _pad(buffer, 4)
    buffer += _COUNT.pack(len(encoded)) + encoded


def _pad(buffer: bytearray, size: int) -> None:
    buffer += b"\x00" * (-len(buffer) % size)

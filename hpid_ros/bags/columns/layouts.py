"""The places of the numbers in a message, for the types whose numbers are read.

Plain CDR (XCDR version 1): a four-byte encapsulation header, then values aligned to their own
size, counted from the header's end. Source: OMG DDS-XTypes 1.3 section 7.4.1.

A publisher repeats one layout: nearly all messages of a topic differ in their stamp and doubles
only. A layout is learned from one message; a mask over its bytes then tells the others that
have it, many at once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hpid_ros.bags.columns.batches import WORD, Integers, Words
from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS

ENCAPSULATION = 4
_DOUBLE = 8
_STAMP = 8
_BYTE_ORDERS = {0: ">", 1: "<"}


class Doubles(NamedTuple):
    """A sequence of doubles in a message."""

    offset: int  # byte of the first, from the start of the message
    length: int  # how many there are


class CdrWalker:
    """Reads values one after the other and refuses to leave the message."""

    def __init__(self, raw: bytes, what: str) -> None:
        if len(raw) < ENCAPSULATION or raw[0] != 0 or raw[1] not in _BYTE_ORDERS:
            raise MessageError(
                f"{what} must start with a plain CDR header (00 00 or 00 01), "
                f"not {raw[:2].hex(' ') or 'nothing'}"
            )
        self._raw, self._what = raw, what
        self.order = _BYTE_ORDERS[raw[1]]
        self.offset = ENCAPSULATION
        self.variable: list[tuple[int, int]] = []

    def count(self) -> int:
        """Return the next 32-bit length."""
        self._align(4)
        self._require(4)
        (value,) = struct.unpack_from(f"{self.order}I", self._raw, self.offset)
        self.offset += 4
        return int(value)

    def text(self) -> str:
        """Return the next string."""
        length = self.count()
        self._require(length)
        raw = self._raw[self.offset : self.offset + length]
        self.offset += length
        try:
            return raw.rstrip(b"\x00").decode()
        except UnicodeDecodeError:
            raise MessageError(f"{self._what} has a name that is not UTF-8: {raw!r}") from None

    def texts(self) -> tuple[str, ...]:
        """Return the next sequence of strings."""
        count = self.count()
        if count > len(self._raw):
            raise MessageError(f"{self._what} of {len(self._raw)} bytes cannot hold {count} names")
        return tuple(self.text() for _ in range(count))

    def time(self) -> int:
        """Pass a ``builtin_interfaces`` Time or Duration; return its offset."""
        self._align(4)
        return self._pass(_STAMP)

    def doubles(self) -> Doubles:
        """Pass the next sequence of doubles."""
        return self.array(self.count())

    def array(self, count: int) -> Doubles:
        """Pass that many doubles."""
        if count == 0:
            return Doubles(self.offset, 0)
        self._align(_DOUBLE)
        return Doubles(self._pass(count * _DOUBLE), count)

    def is_at_end(self) -> bool:
        """Tell whether only padding is left."""
        return len(self._raw) - self.offset < 4

    def _pass(self, size: int) -> int:
        self._require(size)
        begin = self.offset
        self.variable.append((begin, size))
        self.offset += size
        return begin

    def _align(self, size: int) -> None:
        self.offset += -(self.offset - ENCAPSULATION) % size

    def _require(self, size: int) -> None:
        if self.offset + size > len(self._raw):
            raise MessageError(
                f"{self._what} of {len(self._raw)} bytes ends before byte {self.offset + size}"
            )


JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64 = "std_msgs/msg/Float64"
FLOAT64_MULTI_ARRAY = "std_msgs/msg/Float64MultiArray"
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the numbers of a message lie. Rows begin :data:`ENCAPSULATION` bytes before it."""

    sample: bytes  # the message that it was learned from
    names: tuple[str, ...]  # joint names; empty if the type carries none
    order: str  # byte order, "<" or ">"
    stamp: int | None  # offset of the header's stamp; None if the type has none
    fields: Mapping[str, Doubles]  # doubles by field
    variable: tuple[tuple[int, int], ...]  # (offset, length) of the bytes that may differ

    @property
    def words(self) -> int:
        """64-bit words of a row."""
        return -(-(len(self.sample) + ENCAPSULATION) // WORD)

    @cached_property
    def mask(self) -> Words:
        """Bits of a row that all messages of the layout share, (words,)."""
        mask = np.zeros(self.words * WORD, dtype=np.uint8)
        mask[ENCAPSULATION : ENCAPSULATION + len(self.sample)] = 0xFF
        for offset, length in self.variable:
            mask[ENCAPSULATION + offset : ENCAPSULATION + offset + length] = 0
        return mask.view("<u8")

    @cached_property
    def values(self) -> Words:
        """What these bits are, (words,)."""
        row = np.zeros(self.words * WORD, dtype=np.uint8)
        message = np.frombuffer(self.sample, dtype=np.uint8)
        row[ENCAPSULATION : ENCAPSULATION + len(message)] = message
        return row.view("<u8") & self.mask

    def stamps_ns(self, rows: Words, which: Integers | slice) -> Integers:
        """Return the header stamps of some rows of this layout, (n,), in [ns]."""
        if self.stamp is None:
            raise MessageError("messages of this type have no stamp")
        # A header is the first field, so that its stamp is one whole word of the row.
        words = np.ascontiguousarray(rows[:, (self.stamp + ENCAPSULATION) // WORD][which])
        stamps = words.view(f"{self.order}i4")[::2].astype(np.int64)
        stamps *= NANOSECONDS
        stamps += words.view(f"{self.order}u4")[1::2]
        return stamps

    def column(self, rows: Words, field: str, index: int) -> Numbers:
        """Return one number of each row of this layout, (n,); a view."""
        # Doubles lie at multiples of 8 bytes from the end of the encapsulation header.
        at = (self.fields[field].offset + ENCAPSULATION) // WORD + index
        column: Numbers = rows.view(f"{self.order}f8")[:, at]
        return column


def joint_state_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``sensor_msgs/JointState``: position, velocity and effort."""
    walker = CdrWalker(raw, "a JointState")
    stamp = walker.time()
    walker.text()
    names = walker.texts()
    fields = {field: walker.doubles() for field in ("position", "velocity", "effort")}
    return _layout(raw, walker, stamp, names, fields)


def float64_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``std_msgs/Float64``: the field ``data``."""
    walker = CdrWalker(raw, "a Float64")
    return _layout(raw, walker, None, (), {"data": walker.array(1)})


def float64_multi_array_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``std_msgs/Float64MultiArray``: the field ``data``."""
    walker = CdrWalker(raw, "a Float64MultiArray")
    for _ in range(min(walker.count(), len(raw))):
        walker.text()
        walker.count()
        walker.count()
    walker.count()
    return _layout(raw, walker, None, (), {"data": walker.doubles()})


_POINTS = {4: ("reference", "effort"), 3: ("reference", "")}


def controller_state_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``control_msgs/JointTrajectoryControllerState``.

    Fields: ``reference``, the positions of reference (or desired, before control_msgs 5), and
    ``effort``, the efforts of output, which the older form has not. The two forms have nothing
    that tells them apart but their length.
    """
    failure: MessageError | None = None
    for points, has_speed in ((4, True), (4, False), (3, False)):
        try:
            return _controller_state(raw, points, has_speed)
        except MessageError as error:
            failure = failure or error
    raise MessageError(str(failure))


def _controller_state(raw: bytes, points: int, has_speed: bool) -> Layout:
    walker = CdrWalker(raw, "a JointTrajectoryControllerState")
    stamp = walker.time()
    walker.text()
    names = walker.texts()
    found = [_trajectory_point(walker) for _ in range(points)]
    fields = {"reference": found[0][0]}
    if points == 4:
        fields["effort"] = found[3][1]
    if not (points == 3 and walker.is_at_end()):  # Foxy ends here
        walker.texts()
        for _ in range(points):
            _multi_dof_point(walker)
        if has_speed:
            walker.array(1)
    if not walker.is_at_end():
        raise MessageError(f"a JointTrajectoryControllerState has {len(raw)} bytes, too many")
    return _layout(raw, walker, stamp, names, fields)


def _trajectory_point(walker: CdrWalker) -> tuple[Doubles, Doubles]:
    """Pass a ``trajectory_msgs/JointTrajectoryPoint``; return positions and efforts."""
    positions, _, _, efforts = (walker.doubles() for _ in range(4))
    walker.time()
    return positions, efforts


def _multi_dof_point(walker: CdrWalker) -> None:
    """Pass a ``trajectory_msgs/MultiDOFJointTrajectoryPoint``."""
    for doubles in (7, 6, 6):  # transforms, velocities, accelerations
        walker.array(walker.count() * doubles)
    walker.time()


def _layout(
    raw: bytes,
    walker: CdrWalker,
    stamp: int | None,
    names: tuple[str, ...],
    fields: Mapping[str, Doubles],
) -> Layout:
    rest = (walker.offset, len(raw) - walker.offset)  # padding after the last value
    return Layout(raw, names, walker.order, stamp, fields, (*walker.variable, rest))


LAYOUTS: Mapping[str, Callable[[bytes], Layout]] = {
    JOINT_STATE: joint_state_layout,
    FLOAT64: float64_layout,
    FLOAT64_MULTI_ARRAY: float64_multi_array_layout,
    CONTROLLER_STATE: controller_state_layout,
}
"""How the layout of a type is learned; each raises MessageError for other bytes."""

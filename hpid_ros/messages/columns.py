"""Columns of messages: batches of bytes, layouts, numbers of one joint as arrays.

Plain CDR (XCDR version 1): a four-byte encapsulation header, then values aligned to their own
size, counted from the header's end. Source: OMG DDS-XTypes 1.3 section 7.4.1.

A publisher repeats one layout: nearly all messages of a topic differ in their stamp and doubles
only. A layout is learned from one message; a mask over its bytes then tells the others that
have it, many at once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS, Numbers

Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]

SLACK = 64
"""Bytes of a buffer before its first and after its last message, so that rows may reach out."""


class TopicInfo(NamedTuple):
    """A topic of a bag."""

    type: str  # message type, for instance "sensor_msgs/msg/JointState"
    encoding: str  # of the messages; "cdr" in all of ROS 2
    message_count: int | None  # number of messages by the index; None if the bag has none
    definition: str  # the type's definition as recorded; empty if it was not


class TopicBatch(NamedTuple):
    """Messages of one topic, in the order in which the file holds them."""

    topic: str  # full name
    buffer: Bytes  # bytes; valid until the next batch is asked for
    starts: Integers  # first byte of each serialised message, (n,)
    sizes: Integers  # their lengths in bytes, (n,)
    log_times_ns: Integers  # [ns] when they were recorded, (n,)
    places: Integers  # ascending numbers that order all messages of the bag as its files do, (n,)

    def raw(self, index: int) -> bytes:
        """Return one serialised message."""
        start = int(self.starts[index])
        return self.buffer[start : start + int(self.sizes[index])].tobytes()


def batch_of(
    topic: str, raws: Sequence[bytes], log_times_ns: Integers, places: Integers
) -> TopicBatch:
    """Return messages that lie apart as a batch."""
    slack = bytes(SLACK)
    sizes = np.fromiter(map(len, raws), np.int64, len(raws))
    buffer = np.frombuffer(b"".join((slack, *raws, slack)), dtype=np.uint8)
    return TopicBatch(topic, buffer, SLACK + np.cumsum(sizes) - sizes, sizes, log_times_ns, places)


def count_difference(told: Mapping[str, int], found: Mapping[str, int]) -> str:
    """Return in words where two counts of messages differ; empty if nowhere."""
    unequal = [(name, told[name], found.get(name, 0)) for name in sorted(told)]
    return "; ".join(
        f"{count} messages on {name}, not {seen}" for name, count, seen in unequal if count != seen
    )


Report = Callable[[str], None]
"""Takes one line about something that could not be read."""

Advance = Callable[[int], None]
"""Takes the number of bytes of a file that are done."""


class StorageFile(Protocol):
    """One file of a bag."""

    def topics(self) -> Mapping[str, TopicInfo]:
        """Return its topics by full name."""

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""

    def close(self) -> None:
        """Close the file."""


Words = NDArray[np.uint64]
WORD = 8


def gather_words(buffer: Bytes, starts: Integers, words: int) -> Words:
    """Return ``words`` little-endian words from each start, (n, words)."""
    width = words * WORD
    # One opaque item a place, overlapping: indexing it is one copy of a row's bytes.
    every: NDArray[np.void] = np.ndarray(
        (max(len(buffer) - width + 1, 0),), f"V{width}", buffer, 0, (1,)
    )
    rows = np.ascontiguousarray(every[starts])
    return rows.view("<u8").reshape(len(starts), words)


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
        """Return whether only padding is left."""
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


_FIRST_CAPACITY = 1 << 12
_GROWTH = 1.2
"""Small, because numpy fills what it adds with zeros; large arrays are moved, not copied."""


class GrowingColumn:
    """Numbers of one type, appended many at once."""

    def __init__(self, kind: type[np.generic]) -> None:
        self._numbers: NDArray[np.generic] = np.empty(_FIRST_CAPACITY, kind)
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, numbers: NDArray[np.generic]) -> None:
        """Append numbers, (n,)."""
        end = self._length + len(numbers)
        if end > len(self._numbers):
            capacity = max(end, int(len(self._numbers) * _GROWTH))
            self._numbers.resize(capacity, refcheck=False)
        self._numbers[self._length : end] = numbers
        self._length = end

    def finished(self) -> NDArray[np.generic]:
        """Return all numbers as one array of exactly their size; nothing may follow."""
        self._numbers.resize(self._length, refcheck=False)
        return self._numbers


class NumberColumn:
    """Doubles, appended many at once."""

    def __init__(self) -> None:
        self._column = GrowingColumn(np.float64)

    def append(self, numbers: Numbers) -> None:
        """Append numbers, (n,)."""
        self._column.append(numbers)

    def finished(self) -> Numbers:
        """Return all of them; nothing may follow."""
        return self._column.finished().astype(np.float64, copy=False)


class DeltaColumn:
    """Integers whose steps are mostly small, kept as steps of 16 or 32 bits."""

    def __init__(self, kind: type[np.unsignedinteger]) -> None:
        self._steps = GrowingColumn(kind)
        self._limit = int(np.iinfo(kind).max)
        self._large_places = GrowingColumn(np.int64)
        self._large_steps = GrowingColumn(np.int64)
        self._last: Integers = np.zeros(1, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._steps)

    def append(self, numbers: Integers) -> None:
        """Append integers, (n,)."""
        if not len(numbers):
            return
        steps = np.empty(len(numbers), dtype=np.int64)
        np.subtract(numbers[:1], self._last, out=steps[:1])  # wraps, as the sum does
        np.subtract(numbers[1:], numbers[:-1], out=steps[1:])
        sizes = steps.view(np.uint64)  # of a negative step: beyond every limit
        if sizes.max() > self._limit:
            places = np.flatnonzero(sizes > self._limit)
            large = steps[places]
            self._large_places.append(places + len(self._steps))
            self._large_steps.append(large)
            steps[places] = 0
        self._steps.append(steps)
        self._last = numbers[-1:].copy()

    def numbers(self) -> Integers:
        """Return all integers, (n,)."""
        steps = self._steps.finished().astype(np.int64)
        steps[self._large_places.finished().astype(np.int64)] = self._large_steps.finished()
        return np.cumsum(steps, out=steps)


_ALL_BITS = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
_MOST_LAYOUTS = 64
"""Layouts that are remembered; a text that changes with every message makes one for each."""

Mask = NDArray[np.bool_]


class LayoutFamily:
    """Layouts whose numbers lie at the same places, and whose names or frames differ.

    The words that all of them share are compared once for all messages.
    """

    def __init__(self, first: Layout) -> None:
        self.layouts: list[Layout] = []
        self._mask = first.mask
        self._words: list[int] = np.flatnonzero(first.mask).tolist()
        self._shared: list[int] = []
        self._differing: list[int] = []
        self.add(first)

    def accepts(self, layout: Layout) -> bool:
        """Return whether a layout is of this family."""
        return np.array_equal(layout.mask, self._mask) and layout.order == self.layouts[0].order

    def add(self, layout: Layout) -> None:
        """Add a layout of this family."""
        if len(self.layouts) == _MOST_LAYOUTS:
            self.layouts.clear()
        self.layouts.append(layout)
        first = self.layouts[0].values
        is_shared = np.ones(len(first), dtype=np.bool_)
        for each in self.layouts:
            is_shared &= each.values == first
        self._shared = [word for word in self._words if is_shared[word]]
        self._differing = [word for word in self._words if not is_shared[word]]

    def split(self, rows: Words) -> Iterator[tuple[Layout, Mask]]:
        """Yield each layout that some rows have, and which these are."""
        is_kin = self._equal(rows, self._shared, self.layouts[0], None)
        for layout in self.layouts:
            claims = self._equal(rows, self._differing, layout, is_kin)
            if claims.any():
                yield layout, claims

    def _equal(self, rows: Words, words: list[int], layout: Layout, before: Mask | None) -> Mask:
        is_equal = np.ones(len(rows), dtype=np.bool_) if before is None else before.copy()
        for word in words:
            column, mask = rows[:, word], self._mask[word]
            is_equal &= (column if mask == _ALL_BITS else column & mask) == layout.values[word]
        return is_equal


class JointSamples(NamedTuple):
    """One joint's numbers in the order of the log."""

    stamps_ns: Integers | None  # [ns] header stamps, (n,); None if the messages carry none
    log_times_ns: Integers | None  # [ns] receive times, (n,); None if they were not kept
    places: Integers | None  # ascending with the order of the files, (n,); None if not kept
    values: Numbers  # the numbers, (n,)

    def picked(self, which: Integers | Mask) -> JointSamples:
        """Return some of the samples."""
        stamps, log_times, places = (
            None if part is None else part[which] for part in (self[0], self[1], self[2])
        )
        return JointSamples(stamps, log_times, places, self.values[which])


def merged(parts: Sequence[JointSamples]) -> JointSamples:
    """Join samples of several groups, in no order."""
    clocks: list[Integers | None] = []
    for clock in zip(*(part[:3] for part in parts), strict=True):
        known = [times for times in clock if times is not None]
        clocks.append(np.concatenate(known) if len(known) == len(parts) else None)
    stamps, log_times, places = clocks
    values = np.concatenate([part.values for part in parts])
    return JointSamples(stamps, log_times, places, values)

"""Columns of messages: layouts of their bytes, numbers of one joint as arrays.

A publisher repeats one layout: nearly all messages of a topic differ in their stamp and doubles
only. A layout is learned from one message; a mask over its bytes then tells the others that
have it, many at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.batches import Bytes, Integers, TopicBatch
from hpid_ros.messages.joint_state import ENCAPSULATION, Cursor

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


_STAMP = 8


class Doubles(NamedTuple):
    """A sequence of doubles in a message."""

    offset: int  # byte of the first, from the start of the message
    length: int  # how many there are


class Walker(Cursor):
    """Passes over stamps and doubles, whose bytes differ between messages of one layout."""

    def __init__(self, raw: bytes, kind: str) -> None:
        super().__init__(raw, kind)
        self.variable: list[tuple[int, int]] = []

    def time(self) -> int:
        """Pass a ``builtin_interfaces`` Time or Duration; return its offset."""
        return self._pass(4, _STAMP)

    def array(self) -> Doubles:
        return self.fixed_array(self.scalar("I"))

    def fixed_array(self, count: int) -> Doubles:
        return Doubles(self._pass(8, 8 * count) if count else self.offset, count)

    def is_at_end(self) -> bool:
        """Return whether only padding is left."""
        return len(self.raw) - self.offset < 4

    def _pass(self, alignment: int, size: int) -> int:
        self.align(alignment)
        self.require(size)
        begin = self.offset
        self.variable.append((begin, size))
        self.offset += size
        return begin


JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64 = "std_msgs/msg/Float64"
FLOAT64_MULTI_ARRAY = "std_msgs/msg/Float64MultiArray"
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


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
    walker = Walker(raw, "JointState")
    stamp, _, names = walker.time(), walker.string(), walker.strings()
    fields = {field: walker.array() for field in ("position", "velocity", "effort")}
    return _layout(walker, stamp, names, fields)


def float64_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``std_msgs/Float64``: the field ``data``."""
    walker = Walker(raw, "Float64")
    return _layout(walker, None, (), {"data": walker.fixed_array(1)})


def float64_multi_array_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``std_msgs/Float64MultiArray``: the field ``data``."""
    walker = Walker(raw, "Float64MultiArray")
    for _ in range(min(walker.scalar("I"), len(raw))):
        walker.string()
        walker.scalar("I")
        walker.scalar("I")
    walker.scalar("I")
    return _layout(walker, None, (), {"data": walker.array()})


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
    walker = Walker(raw, "JointTrajectoryControllerState")
    stamp, _, names = walker.time(), walker.string(), walker.strings()
    arrays = []
    for _ in range(points):  # trajectory_msgs/JointTrajectoryPoint
        arrays.append([walker.array() for _ in range(4)])
        walker.time()
    fields = {"reference": arrays[0][0]}
    if points == 4:
        fields["effort"] = arrays[3][3]
    if not (points == 3 and walker.is_at_end()):  # Foxy ends here
        walker.strings()
        for _ in range(points):  # trajectory_msgs/MultiDOFJointTrajectoryPoint
            for doubles in (7, 6, 6):  # transforms, velocities, accelerations
                walker.fixed_array(walker.scalar("I") * doubles)
            walker.time()
        if has_speed:
            walker.fixed_array(1)
    if not walker.is_at_end():
        raise MessageError(f"a JointTrajectoryControllerState has {len(raw)} bytes, too many")
    return _layout(walker, stamp, names, fields)


def _layout(
    walker: Walker, stamp: int | None, names: tuple[str, ...], fields: Mapping[str, Doubles]
) -> Layout:
    rest = (walker.offset, len(walker.raw) - walker.offset)  # padding after the last value
    variable = (*walker.variable, rest)
    return Layout(bytes(walker.raw), names, walker.order, stamp, fields, variable)


LAYOUTS: Mapping[str, Callable[[bytes], Layout]] = {
    JOINT_STATE: joint_state_layout,
    FLOAT64: float64_layout,
    FLOAT64_MULTI_ARRAY: float64_multi_array_layout,
    CONTROLLER_STATE: controller_state_layout,
}
"""How the layout of a type is learned; each raises MessageError for other bytes."""


_Number = TypeVar("_Number", bound=np.generic)
_FIRST_CAPACITY = 1 << 12
_GROWTH = 1.2
"""Small, because numpy fills what it adds with zeros; large arrays are moved, not copied."""


class GrowingColumn(Generic[_Number]):
    """Numbers of one type, appended many at once."""

    def __init__(self, kind: type[_Number]) -> None:
        self._numbers = np.empty(_FIRST_CAPACITY, kind)
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, numbers: NDArray[Any]) -> None:
        """Append numbers, (n,)."""
        end = self._length + len(numbers)
        if end > len(self._numbers):
            capacity = max(end, int(len(self._numbers) * _GROWTH))
            self._numbers.resize(capacity, refcheck=False)
        self._numbers[self._length : end] = numbers
        self._length = end

    def finished(self) -> NDArray[_Number]:
        """Return all numbers as one array of exactly their size; nothing may follow."""
        self._numbers.resize(self._length, refcheck=False)
        return self._numbers


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
        steps[self._large_places.finished()] = self._large_steps.finished()
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


class OrderNeededError(Exception):
    """The order of messages matters, but was not kept: read again, and keep it."""


class _Group:
    """Messages that carry numbers of the same joints."""

    def __init__(self, joints: tuple[str, ...], has_stamps: bool, has_order: bool) -> None:
        self._stamps = DeltaColumn(np.uint32) if has_stamps else None
        self._log_times = DeltaColumn(np.uint32) if has_order else None
        self._places = DeltaColumn(np.uint16) if has_order else None
        self._last_place = -1
        self.is_in_order = True
        self.values = {joint: GrowingColumn(np.float64) for joint in joints}

    def append(
        self, layout: Layout, rows: Words, which: Integers | slice, batch: TopicBatch
    ) -> None:
        places = batch.places[which]
        if places[0] < self._last_place:
            self.is_in_order = False  # two layouts by turns
        self._last_place = max(self._last_place, int(places[-1]))
        if self._stamps is not None:
            self._stamps.append(layout.stamps_ns(rows, which))
        if self._log_times is not None and self._places is not None:
            self._log_times.append(batch.log_times_ns[which])
            self._places.append(places)

    @cached_property
    def clock(self) -> tuple[Integers | None, Integers | None, Integers | None]:
        """Stamps, log times and places, shared by all joints of the group."""
        stamps, log_times, places = (
            None if column is None else column.numbers()
            for column in (self._stamps, self._log_times, self._places)
        )
        return stamps, log_times, places


class JointStream:
    """Collects one field of a topic's messages by joint."""

    def __init__(
        self,
        type: str,
        field: str,
        joints: frozenset[str] | None = None,
        elements: Mapping[int, str] | None = None,
        keeps_order: bool = True,
    ) -> None:
        self._learn: Callable[[bytes], Layout] = LAYOUTS[type]
        self._field = field
        self._joints = joints
        self._elements = elements
        self._keeps_order = keeps_order
        self._families: dict[int, list[LayoutFamily]] = {}
        self._groups: dict[tuple[str, ...], _Group] = {}
        self._groups_of: dict[str, list[tuple[str, ...]]] = {}
        self._last_log_time_ns = -(2**63)
        self._is_log_ordered = True
        self._columns_of: WeakKeyDictionary[Layout, Mapping[str, int]] = WeakKeyDictionary()
        self.names: dict[str, None] = {}
        self.message_count = 0
        self.undecodable = 0
        self.first_failure = ""

    def add(self, batch: TopicBatch) -> None:
        """Take the next messages of the topic."""
        self.message_count += len(batch.starts)
        times = batch.log_times_ns
        if times[0] < self._last_log_time_ns or (times[1:] < times[:-1]).any():
            self._is_log_ordered = False
            if not self._keeps_order:
                raise OrderNeededError
        self._last_log_time_ns = max(self._last_log_time_ns, int(times[-1]))
        sizes = batch.sizes
        left = sizes
        while len(left):
            size = int(left[0])
            is_size = sizes == size
            if is_size.all():
                self._add_size(batch, size)
                return
            self._add_size(batch.picked(is_size), size)
            left = left[left != size]

    def joints(self) -> frozenset[str]:
        return frozenset(self._groups_of)

    def take(self, joint: str) -> JointSamples | None:
        """Return one joint's samples and forget them; None if there are none."""
        parts, is_in_order = [], self._is_log_ordered
        for joints in self._groups_of.pop(joint, ()):
            group = self._groups[joints]
            parts.append(JointSamples(*group.clock, group.values.pop(joint).finished()))
            is_in_order &= group.is_in_order
            if not group.values:
                del self._groups[joints]
        if not parts:
            return None
        if len(parts) == 1 and is_in_order:
            return parts[0]
        samples = merged(parts)
        if samples.places is None or samples.log_times_ns is None:
            raise OrderNeededError
        return samples.picked(np.lexsort((samples.places, samples.log_times_ns)))

    def _add_size(self, batch: TopicBatch, size: int) -> None:
        words = -(-(size + ENCAPSULATION) // WORD)
        rows = gather_words(batch.buffer, batch.starts - ENCAPSULATION, words)
        families = self._families.setdefault(size, [])
        is_left = np.ones(len(rows), dtype=np.bool_)
        for family in families:
            for layout, claims in family.split(rows):
                self._keep(layout, rows, np.flatnonzero(claims), batch)
                is_left &= ~claims
        while is_left.any():
            left = np.flatnonzero(is_left)
            first = self._learned(batch, int(left[0]))
            if first is None:
                is_left[left[0]] = False
                continue
            for which in _equal_rows(rows[left] & first.mask):
                here = left[which]
                own = first if here[0] == left[0] else self._learned(batch, int(here[0]))
                if own is None or not np.array_equal(own.mask, first.mask):
                    here = here[:1]  # the others may differ from it where the first's mask is zero
                is_left[here] = False
                if own is not None:
                    _remember(own, families)
                    self._keep(own, rows, here, batch)

    def _learned(self, batch: TopicBatch, index: int) -> Layout | None:
        """Return the layout of one message; None if it is not of the type."""
        try:
            return self._learn(batch.raw(index))
        except MessageError as error:
            self.undecodable += 1
            self.first_failure = self.first_failure or str(error)
            return None

    def _keep(self, layout: Layout, rows: Words, which: Integers, batch: TopicBatch) -> None:
        """Append the numbers of messages of one layout to their group."""
        columns = self._columns(layout)
        if not columns:
            return
        joints = tuple(columns)
        group = self._groups.get(joints)
        if group is None:
            if not self._keeps_order and any(joint in self._groups_of for joint in joints):
                raise OrderNeededError
            group = _Group(joints, layout.stamp is not None, self._keeps_order)
            self._groups[joints] = group
            for joint in joints:
                self._groups_of.setdefault(joint, []).append(joints)
        picked: Integers | slice = slice(None) if len(which) == len(rows) else which
        group.append(layout, rows, picked, batch)
        if not (group.is_in_order or self._keeps_order):
            raise OrderNeededError
        for joint, index in columns.items():
            group.values[joint].append(layout.column(rows, self._field, index)[picked])

    def _columns(self, layout: Layout) -> Mapping[str, int]:
        """Return which wanted joint is at which place of the field."""
        columns = self._columns_of.get(layout)
        if columns is None:
            columns = self._columns_of[layout] = self._find_columns(layout)
        return columns

    def _find_columns(self, layout: Layout) -> Mapping[str, int]:
        length = layout.fields[self._field].length if self._field in layout.fields else 0
        if self._elements is not None:
            return {j: element for element, j in self._elements.items() if element < length}
        self.names.update(dict.fromkeys(layout.names))
        if length != len(layout.names):
            return {}  # the wire allows arrays of another length than the names
        wanted = self._joints
        columns: dict[str, int] = {}
        for index, name in enumerate(layout.names):
            if wanted is None or name in wanted:
                columns.setdefault(name, index)
        return columns


def _remember(layout: Layout, families: list[LayoutFamily]) -> None:
    for family in families:
        if family.accepts(layout):
            family.add(layout)
            return
    families.append(LayoutFamily(layout))


def _equal_rows(rows: Words) -> list[Integers]:
    """Return which rows are equal to each other, the first one's first."""
    is_first = (rows == rows[0]).all(axis=1)
    if is_first.all():
        return [np.flatnonzero(is_first)]
    order = np.lexsort(rows.T)
    is_new = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    groups = np.split(order, np.flatnonzero(is_new) + 1)
    return sorted(groups, key=lambda group: int(group[0]))

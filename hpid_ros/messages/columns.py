"""Batches of a bag's messages, and numbers of one joint in them as arrays.

A publisher repeats one layout: nearly all messages of a topic differ in their stamp and doubles
only. A layout is learned from one message; a mask over its bytes then tells the others that
have it, many at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import MessageError, listed_names
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.joint_state import (
    ENCAPSULATION,
    WORD,
    Doubles,
    Layout,
    Walker,
    Words,
    joint_state_layout,
)
from hpid_ros.messages.quality import StampQuality
from hpid_ros.messages.spill import Kept, Spill

Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]

SLACK = 64
"""Bytes of a buffer before its first and after its last message, so that rows may reach out."""


class TopicInfo(NamedTuple):
    type: str  # message type, for instance "sensor_msgs/msg/JointState"
    encoding: str  # of the messages; "cdr" in all of ROS 2
    definition: str  # the type's definition as recorded; empty if it was not
    qos: str  # offered_qos_profiles as recorded, in YAML; empty if they were not


class TopicBatch(NamedTuple):
    """Messages of one topic, in the order in which the file holds them."""

    topic: str  # full name
    buffer: Bytes  # bytes; valid until the next batch is asked for
    starts: Integers  # first byte of each serialised message, (n,)
    sizes: Integers  # their lengths in bytes, (n,)
    log_times_ns: Integers  # [ns] when they were recorded, (n,)
    places: Integers  # ascending numbers that order all messages of the bag as its files do, (n,)

    def raw(self, index: int) -> bytes:
        start = int(self.starts[index])
        return self.buffer[start : start + int(self.sizes[index])].tobytes()

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield log time [ns], place and bytes of each message."""
        times, places = self.log_times_ns.tolist(), self.places.tolist()
        return zip(times, places, self.raws(), strict=True)

    def raws(self) -> Iterator[bytes]:
        return map(self.raw, range(len(self.starts)))

    def picked(self, which: NDArray[np.bool_]) -> TopicBatch:
        return TopicBatch(self.topic, self.buffer, *(part[which] for part in self[2:]))


def batch_of(
    topic: str, raws: Sequence[bytes], log_times_ns: Integers, places: Integers
) -> TopicBatch:
    """Return messages that lie apart as a batch."""
    slack = bytes(SLACK)
    sizes = np.fromiter(map(len, raws), np.int64, len(raws))
    buffer = np.frombuffer(b"".join((slack, *raws, slack)), dtype=np.uint8)
    return TopicBatch(topic, buffer, SLACK + np.cumsum(sizes) - sizes, sizes, log_times_ns, places)


def count_difference(counted: Mapping[str, int], found: Mapping[str, int]) -> str:
    """Return a text of where two counts of messages differ; empty if nowhere."""
    unequal = [(name, counted[name], found.get(name, 0)) for name in sorted(counted)]
    return "; ".join(
        f"{count} messages on {name}, not {seen}" for name, count, seen in unequal if count != seen
    )


def gather_words(buffer: Bytes, starts: Integers, words: int) -> Words:
    """Return ``words`` little-endian words from each start, (n, words)."""
    width = words * WORD
    # One opaque item a place, overlapping: indexing it is one copy of a row's bytes.
    every: NDArray[np.void] = np.ndarray(
        (max(len(buffer) - width + 1, 0),), f"V{width}", buffer, 0, (1,)
    )
    rows = np.ascontiguousarray(every[starts])
    return rows.view("<u8").reshape(len(starts), words)


JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64 = "std_msgs/msg/Float64"
FLOAT64_MULTI_ARRAY = "std_msgs/msg/Float64MultiArray"
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
MULTI_DOF_STATE = "control_msgs/msg/MultiDOFStateStamped"


def float64_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``std_msgs/Float64``: the field ``data``."""
    walker = Walker(raw, "Float64")
    return walker.layout(None, (), {"data": walker.fixed_array(1)})


def float64_multi_array_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``std_msgs/Float64MultiArray``: the field ``data``."""
    walker = Walker(raw, "Float64MultiArray")
    for _ in range(min(walker.scalar("I"), len(raw))):
        walker.string()
        walker.scalar("I")
        walker.scalar("I")
    walker.scalar("I")
    return walker.layout(None, (), {"data": walker.array()})


def controller_state_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``control_msgs/JointTrajectoryControllerState``.

    Fields: ``reference``, the positions of reference (or desired, before control_msgs 4),
    ``feedback``, those of feedback (or actual), and ``effort``, the efforts of output, which the
    oldest form has not. That of Humble has desired and actual as well, and in its old topic those
    alone. Nothing tells the forms apart but their length.
    """
    failure: MessageError | None = None
    for points, has_speed in ((4, True), (4, False), (6, False), (3, False)):
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
    is_old_topic = points == 6 and arrays[0][0].length != len(names)
    first = 4 if is_old_topic else 0
    fields = {"reference": arrays[first][0], "feedback": arrays[first + 1][0]}
    if points >= 4:
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
    return walker.layout(stamp, names, fields)


_DOF_FIELDS = (
    "reference",
    "feedback",
    "feedback_dot",
    "error",
    "error_dot",
    "time_step",
    "output",
)
"""Numbers of a ``control_msgs/SingleDOFState``, behind its name."""


_LEAST_DOF = 4 + 7 * WORD
"""Bytes of a name's length and of its numbers."""


def multi_dof_state_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``control_msgs/MultiDOFStateStamped``, as pid_controller reports.

    Fields: ``reference``, ``feedback``, and ``effort``, the output.
    """
    walker = Walker(raw, "MultiDOFStateStamped")
    stamp, _ = walker.time(), walker.string()
    names, firsts = [], []
    for _ in range(walker.count("states", _LEAST_DOF)):
        names.append(walker.string())
        firsts.append(walker.fixed_array(len(_DOF_FIELDS)).offset)
    if not walker.is_at_end():
        raise MessageError(f"a MultiDOFStateStamped has {len(raw)} bytes, too many")
    named = {"reference": "reference", "feedback": "feedback", "effort": "output"}
    places = {
        field: tuple(first + WORD * _DOF_FIELDS.index(name) for first in firsts)
        for field, name in named.items()
    }
    fields = {field: Doubles(0, len(names), at) for field, at in places.items()}
    return walker.layout(stamp, tuple(names), fields)


LAYOUTS: Mapping[str, Callable[[bytes], Layout]] = {
    JOINT_STATE: joint_state_layout,
    FLOAT64: float64_layout,
    FLOAT64_MULTI_ARRAY: float64_multi_array_layout,
    CONTROLLER_STATE: controller_state_layout,
    MULTI_DOF_STATE: multi_dof_state_layout,
}
"""How the layout of a type is learned; each raises MessageError for other bytes."""


class JointSamples(NamedTuple):
    """One joint's numbers in the order of the log."""

    stamps_ns: Integers  # [ns] header stamps, (n,); zero if the messages carry none
    log_times_ns: Integers  # [ns] receive times, (n,)
    places: Integers  # ascending with the order of the files, (n,)
    values: Numbers  # the numbers, (n,)

    @classmethod
    def joined(cls, parts: Sequence[JointSamples]) -> JointSamples:
        return cls(*map(np.concatenate, zip(*parts, strict=True)))

    def picked(self, which: Integers | NDArray[np.bool_]) -> JointSamples:
        stamps_ns, log_times_ns, places, values = self
        return JointSamples(stamps_ns[which], log_times_ns[which], places[which], values[which])

    def first_after(self, log_time_ns: int, place: int) -> int:
        """Return the index of the first one that was logged after something else."""
        begin = int(np.searchsorted(self.log_times_ns, log_time_ns))
        end = int(np.searchsorted(self.log_times_ns, log_time_ns, "right"))
        return begin + int(np.searchsorted(self.places[begin:end], place))


_LATE = 1.5
"""Periods between two stamps from which on a sample is taken to be missing."""


class Ordered(NamedTuple):
    """Samples with strictly increasing stamps."""

    stamps_ns: Integers  # [ns] stamps, (n,)
    values: Numbers  # their numbers, (n,)
    repeated: int = 0  # samples whose stamp was there; of several the last stands
    out_of_order: int = 0  # samples with an earlier stamp than the one before in the log
    not_finite: int = 0  # samples whose number was NaN, infinite or beyond 1e50

    def within(self, first_ns: int, last_ns: int) -> Ordered:
        """Return the samples of a window, both ends included."""
        begin = int(np.searchsorted(self.stamps_ns, first_ns))
        end = int(np.searchsorted(self.stamps_ns, last_ns, "right"))
        if (begin, end) == (0, len(self.stamps_ns)):
            return self
        return self._replace(
            stamps_ns=self.stamps_ns[begin:end].copy(), values=self.values[begin:end].copy()
        )

    def quality(self, origin_ns: int) -> StampQuality:
        """Return what the stamps say."""
        stamps_ns, _, repeated, out_of_order, not_finite = self
        counts = {"repeated": repeated, "out_of_order": out_of_order, "not_finite": not_finite}
        if not len(stamps_ns):
            return StampQuality(**counts)
        begin, end = ((int(stamps_ns[k]) - origin_ns) / NANOSECONDS for k in (0, -1))
        if len(stamps_ns) < 2:
            return StampQuality(1, begin=begin, end=end, **counts)
        steps = np.diff(stamps_ns)
        period = float(np.median(steps))
        late = np.flatnonzero(steps > _LATE * period)
        missing = int(np.sum(np.rint(steps[late] / period) - 1.0))
        # Samples that came late and then in a bunch are not missing.
        room = round(int(stamps_ns[-1] - stamps_ns[0]) / period) + 1 - len(stamps_ns)
        longest, at = 0.0, 0.0
        if len(late):
            where = int(late[np.argmax(steps[late])])
            longest = float(steps[where]) / NANOSECONDS
            at = (int(stamps_ns[where]) - origin_ns) / NANOSECONDS
        return StampQuality(
            len(stamps_ns),
            period / NANOSECONDS,
            begin,
            end,
            gaps=len(late),
            lost=max(min(missing, room), 0),
            longest_gap=longest,
            longest_gap_at=at,
            **counts,
        )


LARGEST_NUMBER = 1e50
"""Beyond this a number is no joint's, and its powers soon are no numbers, either."""


def finite(samples: JointSamples) -> tuple[JointSamples, int]:
    """Return the samples whose numbers can be a joint's, and how many cannot."""
    is_finite = np.abs(samples.values) < LARGEST_NUMBER  # false of NaN, too
    if is_finite.all():
        return samples, 0
    return samples.picked(is_finite), int(np.count_nonzero(~is_finite))


def ordered(stamps_ns: Integers, values: Numbers, not_finite: int) -> Ordered:
    """Put samples in the order of their stamps."""
    is_late = stamps_ns[1:] > stamps_ns[:-1]
    if is_late.all():
        return Ordered(stamps_ns, values, not_finite=not_finite)
    out_of_order = int(np.count_nonzero(stamps_ns[1:] < stamps_ns[:-1]))
    by_stamp = np.argsort(stamps_ns, kind="stable")
    stamps = stamps_ns[by_stamp]
    is_last = np.ones(len(stamps), dtype=np.bool_)
    is_last[:-1] = stamps[1:] != stamps[:-1]
    kept = by_stamp[is_last]
    return Ordered(
        stamps[is_last], values[kept], len(stamps_ns) - len(kept), out_of_order, not_finite
    )


def carried(
    log_times_ns: Integers, state_log_times_ns: Integers, state_stamps_ns: Integers
) -> Integers:
    """Carry receive times to the clock of the states' headers.

    Between two states linearly, before the first and after the last by their distance.
    """
    is_last = np.ones(len(state_log_times_ns), dtype=np.bool_)
    is_last[:-1] = state_log_times_ns[1:] > state_log_times_ns[:-1]
    received, stamps = state_log_times_ns[is_last], state_stamps_ns[is_last]
    since = (log_times_ns - received[0]).astype(float)
    inner = np.interp(
        since, (received - received[0]).astype(float), (stamps - stamps[0]).astype(float)
    )
    result: Integers = stamps[0] + np.rint(inner).astype(np.int64)
    result += np.minimum(log_times_ns - received[0], 0) + np.maximum(
        log_times_ns - received[-1], 0
    )
    return result


_LAYOUTS_AT_MOST = 64
"""Layouts of the same joints that are told apart; who has more sends none twice."""

_SMALL = 1024
"""Messages of a group that are kept as one block; fewer wait for more."""

_LAYOUTS_KNOWN = 8  # of a topic, which need not be learned again

_PROBED = 1000  # numbers of a joint in a probe

_GroupKey = tuple[tuple[str, ...], tuple[tuple[int, bytes], ...]]
"""Joints, and the bytes that all messages of a layout share."""

_Times = tuple[Integers, Integers, Integers]
"""Stamps, log times and places of some messages."""


class Alike(NamedTuple):
    """Messages of a batch that share a layout."""

    layout: Layout
    rows: Words  # their bytes, see Layout, (n, words)
    times: _Times


class Layouts:
    """Tells the messages of a topic apart by their layouts, once for all of its streams."""

    def __init__(self, type: str, spill: Spill | None = None) -> None:
        self._learn = LAYOUTS[type]
        self._known: list[Layout] = []
        self._batch: TopicBatch | None = None
        self._found: list[Alike] = []
        self._joined: dict[tuple[int, ...], list[Integers]] = {}
        self.spill = Spill() if spill is None else spill
        self.message_count = 0
        self.undecodable = 0
        self.first_failure = ""

    def of(self, batch: TopicBatch) -> list[Alike]:
        """Return the messages of a batch by layout, without those that are not of the type."""
        if batch is not self._batch:
            self._batch = batch
            self.message_count += len(batch.starts)
            sizes = batch.sizes
            if len(sizes) and (sizes == sizes[0]).all():
                self._found = list(self._of_size(batch, int(sizes[0])))
            else:
                self._found = [
                    each
                    for size in np.unique(sizes).tolist()
                    for each in self._of_size(batch.picked(sizes == size), size)
                ]
        return self._found

    def joined(self, parts: Sequence[_Times]) -> list[Integers]:
        """Return times of messages one after the other: streams of the same ones share them."""
        key = tuple(id(each) for each in parts)
        if key not in self._joined:
            self._joined[key] = [np.concatenate(each) for each in zip(*parts, strict=True)]
        return self._joined[key]

    def _of_size(self, batch: TopicBatch, size: int) -> Iterator[Alike]:
        words = -(-(size + ENCAPSULATION) // WORD)
        rows = gather_words(batch.buffer, batch.starts - ENCAPSULATION, words)
        is_left = np.ones(len(rows), dtype=np.bool_)
        while is_left.any():
            left = np.flatnonzero(is_left)
            first = self._learned(batch, int(left[0]))
            if first is None:
                is_left[left[0]] = False
                continue
            masked = (rows if len(left) == len(rows) else rows[left]) & first.mask
            if (masked == masked[0]).all():  # nearly always
                yield self._alike(first, rows, left, batch)
                return
            for which in _equal_rows(masked):
                here = left[which]
                own = first if here[0] == left[0] else self._learned(batch, int(here[0]))
                if own is None:
                    is_left[here[0]] = False
                elif np.array_equal(own.mask, first.mask):  # else its numbers lie elsewhere
                    is_left[here] = False
                    yield self._alike(own, rows, here, batch)

    def _alike(self, layout: Layout, rows: Words, which: Integers, batch: TopicBatch) -> Alike:
        if len(which) < len(rows):
            rows = rows[which]
        stamps_ns = layout.stamps_ns(rows)
        return Alike(layout, rows, (stamps_ns, batch.log_times_ns[which], batch.places[which]))

    def _learned(self, batch: TopicBatch, index: int) -> Layout | None:
        """Return the layout of one message; None if it is not of the type."""
        raw = batch.raw(index)
        for known in self._known:
            if known.matches(raw):
                return known
        try:
            layout = self._learn(raw)
        except MessageError as error:
            self.undecodable += 1
            self.first_failure = self.first_failure or str(error)
            return None
        self._known = [layout, *self._known[: _LAYOUTS_KNOWN - 1]]
        return layout


class _Group:
    """Messages of one layout, which carry numbers of the same joints, whose times these share."""

    def __init__(self, key: _GroupKey, joints: Sequence[str], text: str, of: Layouts) -> None:
        self.key, self.text, self.joints = key, text, tuple(joints)
        self.rows = {joint: row for row, joint in enumerate(joints)}
        self._of, self._times = of, list[_Times]()
        self._kept: list[tuple[int, Kept]] = []  # numbers of messages and of their joints
        self._small: list[Numbers] = []  # those of blocks that wait to be kept as one
        self._waiting = 0  # how many messages these are

    def add(self, times: _Times, numbers: Numbers) -> None:
        """Add messages: their times, and the numbers of each joint, (joints, n)."""
        self._times.append(times)
        self._small.append(numbers)
        self._waiting += numbers.shape[1]
        if self._waiting >= _SMALL:
            self._keep()

    def _keep(self) -> None:
        """Keep the blocks that wait as one."""
        small, self._small, self._waiting = self._small, [], 0
        if small:
            numbers = small[0] if len(small) == 1 else np.concatenate(small, axis=1)
            self._kept.append((numbers.shape[1], self._of.spill.keep(numbers)))

    @property
    def _blocks(self) -> list[tuple[int, Kept]]:
        self._keep()
        return self._kept

    @cached_property
    def clock(self) -> list[Integers]:
        """Stamps, log times and places; asked for when all messages were added."""
        joined, self._times = self._of.joined(self._times), []
        return joined

    def samples(self, joint: str) -> JointSamples:
        """Return one joint's samples."""
        stamps_ns, log_times_ns, places = self.clock
        values = np.empty(len(places))
        begin = 0
        for count, kept in self._blocks:
            self._of.spill.copy_row(kept, self.rows[joint], values[begin : begin + count])
            begin += count
        return JointSamples(stamps_ns, log_times_ns, places, values)

    def probes(self, joint: str) -> Iterator[Numbers]:
        """Yield some numbers of a joint: from the begin, the middle and the end."""
        for at in sorted({0, len(self._blocks) // 2, len(self._blocks) - 1}):
            count, kept = self._blocks[at]
            values = np.empty(count)
            self._of.spill.copy_row(kept, self.rows[joint], values)
            middle = max(0, (count - _PROBED) // 2)
            yield values[middle : middle + _PROBED]


_INTERFACES = frozenset({"position", "velocity", "acceleration", "effort"})
_INTERFACE_OF = {
    **dict.fromkeys(("position", "reference", "feedback"), "position"),
    "velocity": "velocity",
    "effort": "effort",
}
_MOST_NAMES = 5


class JointStream:
    """Collects one field of a topic's messages by joint."""

    def __init__(
        self,
        layouts: Layouts,
        field: str,
        joints: Container[str] | None = None,
        elements: Mapping[int, str] | None = None,
    ) -> None:
        self._layouts = layouts
        self._field, self._joints, self._elements = field, joints, elements
        self._last: tuple[Layout, dict[str, int]] | None = None  # layout, and its columns
        self._groups: dict[_GroupKey, _Group] = {}
        self._left_out: dict[str, Integers] = {}  # places of the messages that do not count
        self._of: dict[str, list[_Group]] = {}  # those that have numbers of a joint
        self.names: dict[str, None] = {}
        self.interfaces: dict[str, None] = {}  # names of interfaces that are not the field's
        self.repeated: dict[str, None] = {}  # joints that one message names several times
        # messages by the number of their names and of their numbers, where these differ
        self.unequal: Counter[tuple[int, int]] = Counter()

    @property
    def message_count(self) -> int:
        return self._layouts.message_count

    @property
    def undecodable(self) -> int:
        """How many messages are not of the topic's type."""
        return self._layouts.undecodable

    @property
    def first_failure(self) -> str:
        return self._layouts.first_failure

    def add(self, batch: TopicBatch) -> None:
        for each in self._layouts.of(batch):
            self._keep(each)

    def joints(self) -> frozenset[str]:
        return frozenset(self._of)

    def has(self, joint: str) -> bool:
        """Return whether there are samples of a joint that have not been taken."""
        return joint in self._of

    def take(self, joint: str) -> JointSamples | None:
        """Return one joint's samples and forget them; None if there are none."""
        parts = []
        for group in self._of.pop(joint, ()):
            parts.append(group.samples(joint))
            del group.rows[joint]
            if not group.rows:
                del self._groups[group.key]
        return self._joined(joint, parts)

    def peek(self, joint: str) -> JointSamples | None:
        """Return one joint's samples; None if there are none."""
        return self._joined(joint, [each.samples(joint) for each in self._of.get(joint, ())])

    def probes(self, joint: str) -> Iterator[Numbers]:
        """Yield some of the numbers of a joint: from the begin, the middle and the end."""
        for group in self._of.get(joint, ()):
            yield from group.probes(joint)

    def has_numbers(self, joint: str) -> bool:
        """Return whether any of a joint's numbers can be one."""
        if any((np.abs(some) < LARGEST_NUMBER).any() for some in self.probes(joint)):
            return True
        samples = self.peek(joint)
        return samples is not None and len(finite(samples)[0].values) > 0

    def shared(self) -> Iterator[tuple[tuple[str, ...], list[tuple[str, list[Integers]]]]]:
        """Yield joints that the same messages carry, and these by layout.

        Of each layout its text, and stamps, log times and places of its messages.
        """
        joints: dict[tuple[int, ...], list[str]] = {}
        for joint, groups in self._of.items():
            joints.setdefault(tuple(map(id, groups)), []).append(joint)
        for names in joints.values():
            groups = self._of[names[0]]
            yield tuple(names), [(each.text, each.clock) for each in groups]

    def leave_out(self, joint: str, places: Integers) -> None:
        """Leave out the messages at some ascending places for a joint."""
        self._left_out[joint] = places

    def _joined(self, joint: str, parts: Sequence[JointSamples]) -> JointSamples | None:
        if not parts:
            return None
        samples = parts[0] if len(parts) == 1 else JointSamples.joined(parts)
        if joint in self._left_out:
            samples = samples.picked(~np.isin(samples.places, self._left_out[joint]))
            if not len(samples.values):
                return None
        log_times, places = samples.log_times_ns, samples.places
        if (log_times[1:] >= log_times[:-1]).all() and (places[1:] > places[:-1]).all():
            return samples
        return samples.picked(np.lexsort((places, log_times)))

    def _keep(self, alike: Alike) -> None:
        """Append the numbers of messages of one layout to their group."""
        layout = alike.layout
        if self._last is None or self._last[0] is not layout:
            self._last = layout, self._columns(layout)
        columns = self._last[1]
        length = layout.fields[self._field].length if self._field in layout.fields else 0
        if self._elements is None and length not in (0, len(layout.names)):
            self.unequal[len(layout.names), length] += len(alike.rows)
        if not columns:
            return
        key: _GroupKey = tuple(columns), layout.fixed
        group = self._groups.get(key)
        if group is None and len(self._groups) >= _LAYOUTS_AT_MOST:
            key = tuple(sorted(columns)), ()  # however they are ordered
            group = self._groups.get(key)
        if group is None:
            group = _Group(key, tuple(columns), layout.text, self._layouts)
            self._groups[key] = group
            for joint in columns:
                self._of.setdefault(joint, []).append(group)
        at = [columns[joint] for joint in group.joints]
        numbers = layout.columns(alike.rows, self._field, at)
        group.add(alike.times, numbers)

    def _columns(self, layout: Layout) -> dict[str, int]:
        """Return which wanted joint is at which place of the field."""
        length = layout.fields[self._field].length if self._field in layout.fields else 0
        if self._elements is not None:
            return {j: element for element, j in self._elements.items() if element < length}
        names = [self._joint_of(name) for name in layout.names]
        self.names.update(dict.fromkeys(name for name in names if name))
        if length != len(layout.names):
            return {}  # the wire allows arrays of another length than the names
        wanted = self._joints
        columns: dict[str, int] = {}
        for index, name in enumerate(names):
            if name in columns:
                self.repeated[name] = None
            elif name and (wanted is None or name in wanted):
                columns[name] = index
        return columns

    def _joint_of(self, name: str) -> str:
        """Return the joint of a name; none of an interface that is not the field's.

        Some publish what ros2_control calls interfaces: ``j1/position`` is joint ``j1``.
        """
        joint, mark, interface = name.rpartition("/")
        if not mark or interface not in _INTERFACES:
            return name
        if interface == _INTERFACE_OF.get(self._field):
            return joint
        self.interfaces[name] = None
        return ""

    def odd_lines(self, topic: str) -> Iterator[str]:
        """Yield a line for each thing about the names of a topic's messages that is not taken."""
        if self.interfaces:
            names = listed_names(list(self.interfaces), _MOST_NAMES)
            yield f"{topic} names interfaces in place of joints: {names} are no {self._field}s"
        if self.repeated:
            names = listed_names(list(self.repeated), _MOST_NAMES)
            yield f"{topic} names {names} several times in one message: the first is taken"
        for (names_count, length), count in self.unequal.items():
            names = f"{names_count or 'no'} name{'s' if names_count > 1 else ''}"
            yield (
                f"the {self._field}s of {count} messages on {topic} are left out: nothing says "
                f"whose they are, {names} for {length}"
            )


_MULTIPLIER = np.uint64(0x9E37_79B9_7F4A_7C15)


def _equal_rows(rows: Words) -> list[Integers]:
    """Return which rows are equal to each other, the first one's first.

    Rows are sorted by a sum of their words; one that only shares it with others is left out.
    """
    weights = _MULTIPLIER ** np.arange(rows.shape[1], dtype=np.uint64)  # modulo 2^64
    keys = rows @ weights
    order = np.argsort(keys, kind="stable")
    bounds = np.flatnonzero(np.diff(keys[order])) + 1
    groups = [
        group[(rows[group] == rows[group[0]]).all(axis=1)] for group in np.split(order, bounds)
    ]
    return sorted(groups, key=lambda group: int(group[0]))

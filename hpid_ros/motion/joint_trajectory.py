"""A trajectory of several joints, one joint's column of it, and the spline that samples it.

Interpolation follows ``joint_trajectory_controller``: a segment is linear, cubic or quintic by
the derivatives that *both* of its ends give; before the first knot the reference runs from
where it stood when the trajectory took over; after the last knot it holds. Unlike there, the
hold has zero velocity and acceleration whatever the last knot says, since a position that
stands still has no velocity to track.

Messages are not checked point by point: a trajectory of 50 000 points is checked and taken in a
few milliseconds, most of them without Python's lock, so that a loop next to it goes on.

Source: ``trajectory_msgs/msg/JointTrajectory``; the checks are those with which
``joint_trajectory_controller`` rejects a message, the spline is that of its ``src/trajectory.cpp``
in ``ros2_controllers``, functions ``sample`` and ``interpolate_between_points``.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import ClassVar, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import TrajectoryError, unknown_name
from hpid_ros.base.text import names_text
from hpid_ros.base.units import SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.control.reference import Pace

_FOREVER = 2**63 - 1

_Coefficients = tuple[float, float, float, float, float, float]


class Knot(NamedTuple):
    """One point of one joint."""

    time_ns: int  # [ns] time from the start of the trajectory
    position: float  # [rad]
    velocity: float | None = None  # [rad/s] or None
    acceleration: float | None = None  # [rad/s^2] or None
    effort: float | None = None  # [N m] or None


class ReferenceSample(NamedTuple):
    """A reference at one instant."""

    position: float  # [rad]
    velocity: float  # [rad/s]
    acceleration: float  # [rad/s^2]


@dataclass(frozen=True)
class Column:
    """One joint's knots; the trajectory message keeps them as one column of its points."""

    joint: str  # the joint's name
    knots: Sequence[Knot]  # at least one, with strictly increasing times
    stamp_ns: int = 0  # [ns] when the trajectory starts; 0 means with the next state
    goes_by_time: ClassVar[bool] = True

    @property
    def window_ns(self) -> tuple[int, int] | None:
        """Start and end on the control clock in [ns]; None if it begins with the next state."""
        if not self.stamp_ns:
            return None
        return self.stamp_ns, self.stamp_ns + self.knots[-1].time_ns

    @cached_property
    def gives_effort(self) -> bool:
        """Whether every knot has an effort; those of some are not used."""
        if isinstance(self.knots, tuple):
            return all(knot.effort is not None for knot in self.knots)
        return bool(getattr(self.knots, "gives_effort", False))

    @property
    def begin_ns(self) -> int:
        """The instant until which it leaves alone what runs, in [ns]; 0 for at once."""
        return self.stamp_ns and self.stamp_ns + min(self.knots[0].time_ns, 0)

    @cached_property
    def pace(self) -> Pace:
        """How fast it is, and where it leads."""
        return pace(self.knots)

    def start(self, now_ns: int, position: float | None, velocity: float = 0.0) -> SplineReference:
        """Return its reference from an instant on.

        The way to a first knot that is yet to come begins at the position. It overshoots neither
        end: it begins at the velocity, but no faster than a spline between the two without an
        extreme may. Without a position there is no way: the first knot's is held until then.
        """
        start_ns = self.stamp_ns or now_ns
        before, first = None, self.knots[0]
        since_ns = now_ns - start_ns
        if position is not None and since_ns < first.time_ns:
            before = approach(Knot(since_ns, position, velocity), first)
        return SplineReference(self.knots, start_ns, before)

    def is_under_way(self, now_ns: int) -> bool:
        """Return whether the first knot lies before an instant."""
        return now_ns > self.first_ns(now_ns)

    def first_ns(self, now_ns: int) -> int:
        """Return the instant of the first knot if it starts now, in [ns]."""
        return (self.stamp_ns or now_ns) + self.knots[0].time_ns

    def target(self, now_ns: int) -> float:
        """Return the position of the first knot, or the present one of a motion under way."""
        first = self.knots[0].position
        if not self.is_under_way(now_ns):
            return first
        return self.start(now_ns, None).sample(now_ns).position


class SplineReference:
    """Samples a column on the control clock; made by :meth:`Column.start`."""

    def __init__(self, knots: Sequence[Knot], start_ns: int, before: Knot | None) -> None:
        self._before = before  # where the way to the first knot begins
        # Not copied: a loop takes over 50 000 knots between two samples.
        self._knots, self._start_ns = knots, start_ns
        self._index = -1
        self._from_ns = self._to_ns = 0
        self._coefficients: _Coefficients = (0.0,) * 6
        self._effort = 0.0, 0.0  # at the segment's start [N m], and its rate [N m/s]

    @property
    def end_ns(self) -> int:
        """The instant of the last knot on the control clock in [ns]."""
        return self._start_ns + self._knots[-1].time_ns

    def swings(self) -> Iterator[tuple[int, float, float, float]]:
        """Yield for each spline its end's index, lowest, highest [rad] and fastest [rad/s].

        The way to the first knot ends at index 0. Each is looked at in 32 steps, which miss an
        extreme between its ends by less than a thousandth of its height.
        """
        way = () if self._before is None else (self._before,)
        knots = self._knots if isinstance(self._knots, KnotArrays) else KnotArrays.of(self._knots)
        times_ns, *columns = knots.columns
        if way:
            start = KnotArrays.of(way).columns
            times_ns = np.concatenate([start[0], times_ns])
            columns = [np.concatenate(each) for each in zip(start[1:], columns, strict=True)]
        shares = np.linspace(0.0, 1.0, 33)
        for begin in range(0, len(times_ns) - 1, _CHUNK):
            part = slice(begin, begin + _CHUNK + 1)
            spans = np.diff(times_ns[part]) * SECONDS_PER_NANOSECOND
            positions, velocities, accelerations = (each[part] for each in columns)
            places, rates = _along(spans, positions, velocities, accelerations, shares)
            lows, highs = places.min(axis=1), places.max(axis=1)
            rows = zip(lows.tolist(), highs.tolist(), np.abs(rates).max(axis=1), strict=True)
            for index, row in enumerate(rows, begin + 1 - len(way)):
                yield index, row[0], row[1], float(row[2])

    def sample(self, stamp_ns: int) -> ReferenceSample:
        """Return the reference at an instant."""
        if not self._from_ns <= stamp_ns < self._to_ns:
            self._enter(stamp_ns)
        t = (stamp_ns - self._from_ns) * SECONDS_PER_NANOSECOND
        c0, c1, c2, c3, c4, c5 = self._coefficients
        return ReferenceSample(
            c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5)))),
            c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5))),
            2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5)),
        )

    def effort(self, stamp_ns: int) -> float:
        """Return the knots' effort at an instant, linear between them, in [N m].

        Before the first knot it is the first one's, after the last the last one's.
        """
        if not self._from_ns <= stamp_ns < self._to_ns:
            self._enter(stamp_ns)
        start, rate = self._effort
        return start + rate * ((stamp_ns - self._from_ns) * SECONDS_PER_NANOSECOND)

    def _enter(self, stamp_ns: int) -> None:
        """Find the segment of an instant and compute its polynomial once."""
        knots, start_ns = self._knots, self._start_ns
        self._index = index = self._last_before(stamp_ns - start_ns)
        left = knots[index] if index >= 0 else self._before
        if left is not None and index < 0 and stamp_ns < start_ns + left.time_ns:
            left, right = None, left
        else:
            right = knots[index + 1] if index + 1 < len(knots) else None
        if left is None:
            assert right is not None  # there is at least one knot
            self._from_ns, self._to_ns = min(stamp_ns, 0), start_ns + right.time_ns
            self._coefficients = (right.position, 0.0, 0.0, 0.0, 0.0, 0.0)
            self._effort = right.effort or 0.0, 0.0
        elif right is None:
            self._from_ns, self._to_ns = start_ns + left.time_ns, _FOREVER
            self._coefficients = (left.position, 0.0, 0.0, 0.0, 0.0, 0.0)
            self._effort = left.effort or 0.0, 0.0
        else:
            self._from_ns, self._to_ns = start_ns + left.time_ns, start_ns + right.time_ns
            self._coefficients = segment(left, right)
            begin, end = left.effort or 0.0, right.effort or 0.0
            span = (right.time_ns - left.time_ns) * SECONDS_PER_NANOSECOND
            self._effort = begin, (end - begin) / span

    def _last_before(self, time_ns: int) -> int:
        """Return the index of the last knot that is not later than a time; -1 if all are."""
        knots, following = self._knots, self._index + 1
        if (
            following < len(knots)
            and knots[following].time_ns <= time_ns
            and (following + 1 == len(knots) or time_ns < knots[following + 1].time_ns)
        ):
            return following  # time goes on by a segment mostly
        return bisect_right(knots, time_ns, key=itemgetter(0)) - 1


_CHUNK = 2048  # splines that are looked at together


def _along(
    spans: Numbers,
    positions: Numbers,
    velocities: Numbers,
    accelerations: Numbers,
    shares: Numbers,
) -> tuple[Numbers, Numbers]:
    """Return positions and velocities at shares of splines, both of shape (splines, shares)."""
    T, s = spans[:, None], shares[None, :]
    p0, p1 = positions[:-1, None], positions[1:, None]
    v0, v1 = velocities[:-1, None], velocities[1:, None]
    a0, a1 = accelerations[:-1, None], accelerations[1:, None]
    is_linear, is_cubic = np.isnan(v0 + v1), np.isnan(a0 + a1)
    v0, v1 = (np.where(is_linear, (p1 - p0) / T, each) for each in (v0, v1))
    # A cubic is the quintic with the accelerations that it has at its ends.
    ends = 6.0 * (p1 - p0) / T**2
    a0 = np.where(is_cubic | is_linear, ends - (4.0 * v0 + 2.0 * v1) / T, a0)
    a1 = np.where(is_cubic | is_linear, -ends + (2.0 * v0 + 4.0 * v1) / T, a1)
    c2, d = 0.5 * a0 * T**2, p1 - p0
    b0, b1 = v0 * T, v1 * T
    c3 = 10.0 * d - 6.0 * b0 - 4.0 * b1 - (3.0 * a0 - a1) * T**2 / 2.0
    c4 = -15.0 * d + 8.0 * b0 + 7.0 * b1 + (3.0 * a0 - 2.0 * a1) * T**2 / 2.0
    c5 = 6.0 * d - 3.0 * (b0 + b1) - (a0 - a1) * T**2 / 2.0
    places = p0 + s * (b0 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
    rates = b0 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))
    return places, rates / T


_STEEPEST_CUBIC, _STEEPEST_QUINTIC = 3.0, 2.5  # slopes at which a spline may begin


def approach(start: Knot, first: Knot) -> Knot:
    """Return where the way to a first knot begins: as it stands, but no faster than fits.

    A cubic between two positions has no extreme in between if it begins at 0 to 3 times their
    slope, a quintic without acceleration at 0 to 2.5 times.

    Source: F. Fritsch and R. Carlson, "Monotone piecewise cubic interpolation", SIAM Journal on
    Numerical Analysis 17 (1980) 238-246.
    """
    acceleration = None if first.acceleration is None else 0.0
    slope = (first.position - start.position) / (
        (first.time_ns - start.time_ns) * SECONDS_PER_NANOSECOND
    )
    steepest = (_STEEPEST_CUBIC if first.acceleration is None else _STEEPEST_QUINTIC) * slope
    velocity = start.velocity or 0.0
    velocity = min(max(velocity, min(steepest, 0.0)), max(steepest, 0.0))
    return Knot(start.time_ns, start.position, velocity, acceleration, first.effort)


def pace(knots: Sequence[Knot]) -> Pace:
    """Return how fast a spline is, by its knots and their slopes, and what bounds its positions.

    Between two knots with velocities a spline passes their positions by no more than the
    velocities, and accelerations, explain.
    """
    arrays = knots if isinstance(knots, KnotArrays) else KnotArrays.of(knots)
    times_ns, positions, velocities, accelerations = arrays.columns
    given = np.abs(np.nan_to_num(velocities, nan=0.0))
    fastest = largest = float(given.max())
    lowest, highest = float(positions.min()), float(positions.max())
    if len(times_ns) == 1:
        lead = float(times_ns[0]) * SECONDS_PER_NANOSECOND
        return Pace(fastest, largest, lowest, highest, max(lead, 0.0))
    spans = np.diff(times_ns) * SECONDS_PER_NANOSECOND
    fastest = max(fastest, float(np.abs(np.diff(positions) / spans).max()))
    bends = np.abs(np.nan_to_num(accelerations, nan=0.0))
    beyond = _BEYOND_BY_VELOCITY * (given[:-1] + given[1:]) * spans
    beyond = beyond + _BEYOND_BY_ACCELERATION * (bends[:-1] + bends[1:]) * spans * spans
    lowest = float((np.minimum(positions[:-1], positions[1:]) - beyond).min())
    highest = float((np.maximum(positions[:-1], positions[1:]) + beyond).max())
    return Pace(fastest, largest, lowest, highest)


# What a cubic or quintic exceeds its ends by, at most: 4/27 and 0.175 v T, 0.0173 a T^2.
_BEYOND_BY_VELOCITY, _BEYOND_BY_ACCELERATION = 0.18, 0.02


def segment(start: Knot, end: Knot) -> _Coefficients:
    """Return the polynomial between two knots, lowest power first, time from the first knot.

    Quintic when both ends give velocity and acceleration, cubic when both give velocity,
    linear otherwise.
    """
    T = (end.time_ns - start.time_ns) * SECONDS_PER_NANOSECOND
    distance = end.position - start.position
    if start.velocity is None or end.velocity is None:
        return (start.position, distance / T, 0.0, 0.0, 0.0, 0.0)
    v0, v1 = start.velocity, end.velocity
    if start.acceleration is None or end.acceleration is None:
        c2 = (3.0 * distance - (2.0 * v0 + v1) * T) / T**2
        c3 = (-2.0 * distance + (v0 + v1) * T) / T**3
        return (start.position, v0, c2, c3, 0.0, 0.0)
    a0, a1 = start.acceleration, end.acceleration
    c3 = (20.0 * distance - (12.0 * v0 + 8.0 * v1) * T - (3.0 * a0 - a1) * T**2) / (2.0 * T**3)
    c4 = (-30.0 * distance + (16.0 * v0 + 14.0 * v1) * T + (3.0 * a0 - 2.0 * a1) * T**2) / (
        2.0 * T**4
    )
    c5 = (12.0 * distance - 6.0 * (v0 + v1) * T - (a0 - a1) * T**2) / (2.0 * T**5)
    return (start.position, v0, 0.5 * a0, c3, c4, c5)


_LARGEST = 1e9  # [rad, rad/s, rad/s^2]; beyond it is no joint, and splines overflow


class TrajectoryPoint(NamedTuple):
    """One instant of all joints.

    Attributes:
        time_from_start_ns: In [ns].
        positions: One for each joint, in [rad].
        velocities: One for each joint in [rad/s], or empty.
        accelerations: One for each joint in [rad/s^2], or empty.
        efforts: One for each joint in [N m], or empty.
    """

    time_from_start_ns: int
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()
    accelerations: tuple[float, ...] = ()
    efforts: tuple[float, ...] = ()


@dataclass(frozen=True)
class JointTrajectory:
    """A checked trajectory.

    Attributes:
        joint_names: The joints, each once.
        points: At least one point; times from the start strictly increase from 0 or later. Where
            the stamp is not 0, points may lie before it, but not before instant 0.
        stamp_ns: When it starts in [ns]; 0 means with the next state.

    Raises:
        TrajectoryError: No joint, a joint twice, no point, times that do not increase, an
            array of another length than the joints, a number that is not finite.
    """

    joint_names: tuple[str, ...]
    points: tuple[TrajectoryPoint, ...]
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        require_trajectory(self.joint_names, self.points, self.stamp_ns)

    def started(self, start_ns: int) -> JointTrajectory:
        """Return the same motion as one that is under way, for a follower that comes later.

        A stamp of 0 means "with the next state", so a start at instant 0 is sent as a stamp of
        1 ns and times that are 1 ns shorter. Whoever follows the motion already and takes this
        one over after its first point keeps the same reference, to the last bit.

        Args:
            start_ns: When it started in [ns].
        """
        stamp_ns = max(start_ns, 1)
        ahead_ns = stamp_ns - start_ns
        points = tuple(
            point._replace(time_from_start_ns=point.time_from_start_ns - ahead_ns)
            for point in self.points
        )
        return JointTrajectory(self.joint_names, points, stamp_ns)

    def column(self, joint: str) -> Column:
        """Return one joint's part.

        Args:
            joint: A joint of the trajectory.

        Raises:
            TrajectoryError: The trajectory has no such joint.
        """
        if joint not in self.joint_names:
            raise TrajectoryError(unknown_name("joint", joint, self.joint_names))
        index = self.joint_names.index(joint)
        knots = tuple(
            Knot(
                point.time_from_start_ns,
                point.positions[index],
                point.velocities[index] if point.velocities else None,
                point.accelerations[index] if point.accelerations else None,
                point.efforts[index] if point.efforts else None,
            )
            for point in self.points
        )
        return Column(joint, knots, self.stamp_ns)


def require_trajectory(
    joint_names: Sequence[str], points: Sequence[TrajectoryPoint], stamp_ns: int, first: int = 0
) -> None:
    """Refuse what is no trajectory."""
    if not joint_names or len(set(joint_names)) != len(joint_names):
        raise TrajectoryError(
            f"a trajectory must name each of its joints once, not {names_text(joint_names)}"
        )
    if not points:
        raise TrajectoryError("a trajectory must have at least one point, not none")
    if stamp_ns < 0:
        raise TrajectoryError(f"a trajectory cannot start at {stamp_ns} ns, before 0")
    before = -1 - stamp_ns
    for index, point in enumerate(points, first):
        if point.time_from_start_ns <= before:
            raise TrajectoryError(
                f"times must increase from {-stamp_ns} ns on; point {index} has "
                f"{point.time_from_start_ns} ns after {before} ns"
            )
        before = point.time_from_start_ns
        _require_point(joint_names, index, point)


def _require_point(joint_names: Sequence[str], index: int, point: TrajectoryPoint) -> None:
    count = len(joint_names)
    arrays: tuple[tuple[str, Sequence[float], tuple[int, ...]], ...] = (
        ("positions", point.positions, (count,)),
        ("velocities", point.velocities, (0, count)),
        ("accelerations", point.accelerations, (0, count)),
        ("efforts", point.efforts, (0, count)),
    )
    for name, values, lengths in arrays:
        if len(values) not in lengths:
            allowed = " or ".join(str(length) for length in lengths)
            raise TrajectoryError(f"point {index} must have {allowed} {name}, not {len(values)}")
        for joint, value in zip(joint_names, values, strict=False):
            if not math.isfinite(value):
                raise TrajectoryError(
                    f"{name} of point {index} must be finite, not {value} for {joint!r}"
                )
            if abs(value) > _LARGEST:
                raise TrajectoryError(
                    f"{name} of point {index} must be within {_LARGEST:g}, "
                    f"not {value} for {joint!r}"
                )


Integers = NDArray[np.int64]
Point = tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]
"""Time from start [ns], positions, velocities, accelerations and efforts."""


class PointArrays(NamedTuple):
    """The numbers of all points, one row a point, one column a joint.

    A row of NaN is a point that has none.
    """

    positions: Numbers  # [rad]
    velocities: Numbers  # [rad/s]
    accelerations: Numbers  # [rad/s^2]
    efforts: Numbers  # [N m]


class KnotArrays(Sequence[Knot]):
    """One joint's knots, each made when it is asked for."""

    def __init__(
        self,
        times_ns: Integers,
        positions: Numbers,
        velocities: Numbers,
        accelerations: Numbers,
        efforts: Numbers,
    ) -> None:
        self._times_ns, self._positions = times_ns, positions
        self._rest = velocities, accelerations, efforts

    @classmethod
    def of(cls, knots: Sequence[Knot]) -> KnotArrays:
        times_ns, *rest = zip(*knots, strict=True)
        numbers = (np.array([math.nan if x is None else x for x in each]) for each in rest)
        return cls(np.array(times_ns, dtype=np.int64), *numbers)

    @property
    def columns(self) -> tuple[Integers, Numbers, Numbers, Numbers]:
        """Times [ns], positions, velocities and accelerations; NaN for one that is not given."""
        return self._times_ns, self._positions, self._rest[0], self._rest[1]

    @property
    def gives_effort(self) -> bool:
        """Whether every knot has an effort."""
        return not np.isnan(self._rest[2]).any()

    def __len__(self) -> int:
        return len(self._times_ns)

    @overload
    def __getitem__(self, index: int) -> Knot: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Knot, ...]: ...
    def __getitem__(self, index: int | slice) -> Knot | tuple[Knot, ...]:
        """Return a knot, or some of them."""
        if isinstance(index, slice):
            return tuple(self[k] for k in range(*index.indices(len(self))))
        rest = (float(each[index]) for each in self._rest)
        return Knot(
            int(self._times_ns[index]),
            float(self._positions[index]),
            *(None if value != value else value for value in rest),
        )

    def __eq__(self, other: object) -> bool:
        """Return whether another sequence has the same knots."""
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]


def require_arrays(
    names: Sequence[str],
    stamp_ns: int,
    times_ns: Integers,
    arrays: PointArrays,
    lengths: Integers,
    point: Callable[[int], Point],
) -> None:
    """Refuse what ``JointTrajectory`` refuses; ``point`` gives one as it came."""
    for index in _suspects(len(names), times_ns, arrays, lengths):
        _check_alone(names, stamp_ns, point, index)
    # Two points at most: the joints, the stamp, and that there is a point at all.
    _check_alone(names, stamp_ns, point, len(times_ns) - 1)


def checked_column(
    joint: str, at: int, stamp_ns: int, times_ns: Integers, arrays: PointArrays
) -> Column:
    """Return one joint's column of a trajectory that :func:`require_arrays` let pass."""
    columns = [each[:, at] for each in arrays]
    kept = [each if each.strides == (0,) else each.copy() for each in columns]  # one for all
    column = Column(joint, KnotArrays(times_ns, *kept), stamp_ns)
    _ = column.pace  # now: a loop that takes it over has no time for 50 000 knots
    return column


def _suspects(
    joints: int, times_ns: Integers, arrays: PointArrays, lengths: Integers
) -> list[int]:
    """Return the first points of each kind of fault, in their order."""
    if len(times_ns) == 0:
        return []
    suspects = [0]
    wrong = np.flatnonzero(np.diff(times_ns) <= 0)
    suspects += [int(wrong[0]) + 1] if len(wrong) else []
    odd = (lengths != joints) & ((lengths != 0) | [True, False, False, False])
    wrong = np.flatnonzero(odd.any(axis=1))
    suspects += [int(wrong[0])] if len(wrong) else []
    for k, each in enumerate(arrays):
        if not (lengths[:, k] == joints).any():  # one number stands for all
            continue
        bad = ~(np.abs(each) <= _LARGEST).all(axis=1) & (lengths[:, k] == joints)
        suspects += [int(np.argmax(bad))] if bad.any() else []
    return sorted(suspects)


def _check_alone(
    names: Sequence[str], stamp_ns: int, point: Callable[[int], Point], index: int
) -> None:
    """Check one point with the one before it, and what holds for all."""
    first = max(0, index - 1)
    points = [TrajectoryPoint(*point(k)) for k in range(first, index + 1)]
    require_trajectory(names, points, stamp_ns, first)

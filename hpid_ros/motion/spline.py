"""One joint's column of a trajectory, and the spline that samples it.

Interpolation follows ``joint_trajectory_controller``: a segment is linear, cubic or quintic by
the derivatives that *both* of its ends give; before the first knot the reference runs from
where it stood when the trajectory took over; after the last knot it holds. Unlike there, the
hold has zero velocity and acceleration whatever the last knot says, since a position that
stands still has no velocity to track.

Source: ``ros2_controllers``, ``joint_trajectory_controller/src/trajectory.cpp``, functions
``sample`` and ``interpolate_between_points``.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import NamedTuple

from hpid_ros.base.units import SECONDS_PER_NANOSECOND

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

    @cached_property
    def gives_effort(self) -> bool:
        """Whether every knot has an effort; those of some are not used."""
        if isinstance(self.knots, tuple):
            return all(knot.effort is not None for knot in self.knots)
        return bool(getattr(self.knots, "gives_effort", False))

    def start(self, now_ns: int, position: float, velocity: float = 0.0) -> SplineReference:
        """Take over at an instant."""
        start_ns = self.stamp_ns or now_ns
        return SplineReference(self.knots, start_ns, Knot(now_ns - start_ns, position, velocity))

    def is_under_way(self, now_ns: int) -> bool:
        """Return whether the first knot lies before an instant."""
        return self.stamp_ns != 0 and now_ns > self.stamp_ns + self.knots[0].time_ns

    def target(self, now_ns: int) -> float:
        """Return the position of the first knot, or the present one of a motion under way."""
        first = self.knots[0].position
        if not self.is_under_way(now_ns):
            return first
        return self.start(now_ns, first).sample(now_ns).position


class SplineReference:
    """Samples a column on the control clock; made by :meth:`Column.start`."""

    def __init__(self, knots: Sequence[Knot], start_ns: int, before: Knot) -> None:
        first = knots[0]
        self._before: Knot | None = None
        if before.time_ns < first.time_ns:
            acceleration = None if first.acceleration is None else 0.0
            self._before = before._replace(acceleration=acceleration, effort=first.effort)
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

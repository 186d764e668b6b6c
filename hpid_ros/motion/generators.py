"""Reference generators, and trajectories of different joints as one.

Every generator gives a :class:`JointTrajectory` whose splines are the wanted signal, so that
what is published, recorded and sampled is one and the same thing.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from itertools import pairwise

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.motion.joint_trajectory import (
    Column,
    JointTrajectory,
    ReferenceSample,
    TrajectoryPoint,
    segment,
)

_MOST_PIECES = 1_000_000


def minimum_jerk(
    times: Sequence[float], positions: Mapping[str, Sequence[float]]
) -> JointTrajectory:
    """Move through waypoints, at rest in each of them, with the least jerk in between.

    With zero velocity and acceleration at both ends of a segment, the quintic is the curve of
    least integral of squared jerk (Flash and Hogan, 1985).

    Args:
        times: Times of the waypoints from the start in [s], strictly increasing.
        positions: For each joint its position at each waypoint in [rad].

    Raises:
        TrajectoryError: Numbers that make no trajectory.
    """
    _check_lengths(times, positions)
    rest = (0.0,) * len(positions)
    points = tuple(
        TrajectoryPoint(_ns(time), tuple(float(p[k]) for p in positions.values()), rest, rest)
        for k, time in enumerate(times)
    )
    return JointTrajectory(tuple(positions), points)


def step(times: Sequence[float], positions: Mapping[str, Sequence[float]]) -> JointTrajectory:
    """Jump from one position to the next, one nanosecond wide, and hold in between.

    Args:
        times: When each position begins to hold, from the start in [s], strictly increasing.
        positions: For each joint the position held from each time on in [rad].

    Raises:
        TrajectoryError: Numbers that make no trajectory.
    """
    _check_lengths(times, positions)
    points: list[TrajectoryPoint] = []
    for k, time in enumerate(times):
        values = tuple(float(p[k]) for p in positions.values())
        if points:
            points.append(TrajectoryPoint(_ns(time) - 1, points[-1].positions))
        points.append(TrajectoryPoint(_ns(time), values))
    return JointTrajectory(tuple(positions), tuple(points))


_KNOTS = 64  # pieces in the shortest period


def sine(duration: float, positions: Mapping[str, Mapping[str, float]]) -> JointTrajectory:
    """Follow ``offset + amplitude sin(2 pi t / period + phase)`` in each joint.

    The signal is given by quintic pieces; with 64 of them in the shortest period the error is
    below 1e-9 of the amplitude.

    Args:
        duration: Length in [s].
        positions: For each joint ``offset`` [rad], ``amplitude`` [rad], ``period`` [s] and
            ``phase`` [rad]; all but the amplitude and period may be left out.

    Raises:
        TrajectoryError: Numbers that make no trajectory.
    """
    if not duration > 0.0 or not math.isfinite(duration):
        raise TrajectoryError(f"a sine must last a positive finite time, not {duration} s")
    signals: list[tuple[float, float, float, float]] = []
    for joint, given in positions.items():
        missing = {"amplitude", "period"} - set(given)
        if missing:
            raise TrajectoryError(f"the sine of {joint!r} lacks {', '.join(sorted(missing))}")
        if not given["period"] > 0.0:
            raise TrajectoryError(
                f"the period of {joint!r} must be positive, not {given['period']} s"
            )
        rate = 2.0 * math.pi / given["period"]
        signals.append(
            (given.get("offset", 0.0), given["amplitude"], rate, given.get("phase", 0.0))
        )
    if not signals:
        raise TrajectoryError("a sine must name at least one joint")
    fastest = max(rate for _, _, rate, _ in signals)
    pieces = duration * fastest / (2.0 * math.pi) * _KNOTS
    if not pieces <= _MOST_PIECES:
        raise TrajectoryError(
            f"the shortest period is too short: {duration} s of it would have more than "
            f"{_MOST_PIECES} pieces"
        )
    count = max(2, math.ceil(pieces))
    points = []
    for k in range(count + 1):
        time_ns = round(duration * k / count * NANOSECONDS)
        phases = [(o, a, w, w * time_ns / NANOSECONDS + p) for o, a, w, p in signals]
        points.append(
            TrajectoryPoint(
                time_ns,
                tuple(o + a * math.sin(x) for o, a, _, x in phases),
                tuple(a * w * math.cos(x) for _, a, w, x in phases),
                tuple(-a * w * w * math.sin(x) for _, a, w, x in phases),
            )
        )
    return JointTrajectory(tuple(positions), tuple(points))


def _check_lengths(times: Sequence[float], positions: Mapping[str, Sequence[float]]) -> None:
    for joint, values in positions.items():
        if len(values) != len(times):
            raise TrajectoryError(
                f"joint {joint!r} must have one position for each of the {len(times)} times, "
                f"not {len(values)}"
            )


def _ns(time: float) -> int:
    nanoseconds = time * NANOSECONDS
    if not math.isfinite(nanoseconds):
        raise TrajectoryError(f"a time must be finite, not {time} s")
    return round(nanoseconds)


def combined(trajectories: Sequence[JointTrajectory]) -> JointTrajectory:
    """Merge trajectories of different joints, which may have points at different times.

    At every whole nanosecond each joint's reference is what it was alone, but for rounding: a
    spline that is split gives the same polynomials. Where a derivative of one joint jumps (a
    corner of a linear spline, an end in motion) while others go on, the merged trajectory has a
    further point one nanosecond before. A joint whose trajectory ends earlier holds its last
    position.
    """
    _check(trajectories)
    columns = [each.column(joint) for each in trajectories for joint in each.joint_names]
    names = tuple(column.joint for column in columns)
    curves = [_Curve(column) for column in columns]
    order = _common_order(trajectories)
    times = sorted({time for curve in curves for time in curve.times})
    times = _with_jumps(curves, times, order)
    points = []
    for time_ns in times:
        rows = list(
            zip(
                *(
                    curve.before(time_ns) if time_ns == times[-1] else curve.after(time_ns)
                    for curve in curves
                ),
                strict=True,
            )
        )
        points.append(TrajectoryPoint(time_ns, *rows[: order + 1]))
    return JointTrajectory(names, tuple(points), trajectories[0].stamp_ns)


def _check(trajectories: Sequence[JointTrajectory]) -> None:
    if not trajectories:
        raise TrajectoryError("a combined trajectory must have at least one part, not none")
    first = trajectories[0]
    names: set[str] = set()
    for index, each in enumerate(trajectories):
        twice = names.intersection(each.joint_names)
        if twice:
            raise TrajectoryError(
                f"each joint must be in one part only, {sorted(twice)[0]!r} is in two"
            )
        names.update(each.joint_names)
        if each.stamp_ns != first.stamp_ns:
            raise TrajectoryError(
                f"parts must have one stamp, part {index} has {each.stamp_ns} ns and part 0 "
                f"{first.stamp_ns} ns"
            )
        begin, wanted = (t.points[0].time_from_start_ns for t in (each, first))
        if begin != wanted:
            # Before its first point a joint comes from where it stands, which nobody knows here.
            raise TrajectoryError(
                f"parts must begin at one time, part {index} begins at {begin * 1e-9:g} s and "
                f"part 0 at {wanted * 1e-9:g} s"
            )


def _common_order(trajectories: Sequence[JointTrajectory]) -> int:
    """Return 0, 1 or 2 where all splines are linear, cubic or quintic; 2 where they differ."""
    orders = {
        bool(point.velocities) + bool(point.velocities and point.accelerations)
        for each in trajectories
        for point in each.points
    }
    return orders.pop() if len(orders) == 1 else 2


def _with_jumps(curves: Sequence[_Curve], times: Sequence[int], order: int) -> list[int]:
    """Add the nanosecond before each instant at which a derivative jumps."""
    wanted = set(times)
    for time_ns in times[1:-1]:
        if any(
            curve.before(time_ns)[1 : order + 1] != curve.after(time_ns)[1 : order + 1]
            for curve in curves
            if time_ns in curve.knots
        ):
            wanted.add(time_ns - 1)
    return sorted(wanted)


class _Curve:
    """One joint's piecewise polynomial, with its values on both sides of an instant."""

    def __init__(self, column: Column) -> None:
        knots = column.knots
        self.times = [knot.time_ns for knot in knots]
        self.knots = frozenset(self.times)
        self._knots = knots
        self._pieces = [segment(a, b) for a, b in pairwise(knots)]

    def after(self, time_ns: int) -> ReferenceSample:
        """Return the values from an instant on."""
        return self._of(bisect_right(self.times, time_ns) - 1, time_ns)

    def before(self, time_ns: int) -> ReferenceSample:
        """Return the values up to an instant.

        At a knot that gives a derivative and ends a spline that heeds it, that is the knot's own
        number, to the last bit.
        """
        index = bisect_left(self.times, time_ns) - 1
        if index < 0:
            return self.after(time_ns)
        values = self._of(index, time_ns)
        if time_ns not in self.knots:
            return values
        left, knot = self._knots[index], self._knots[index + 1]
        is_smooth = left.velocity is not None and knot.velocity is not None
        velocity, acceleration = knot.velocity, knot.acceleration
        if not is_smooth or velocity is None:
            return values._replace(position=knot.position)
        if acceleration is None or left.acceleration is None:
            return ReferenceSample(knot.position, velocity, values.acceleration)
        return ReferenceSample(knot.position, velocity, acceleration)

    def _of(self, index: int, time_ns: int) -> ReferenceSample:
        if index >= len(self._pieces):
            return ReferenceSample(self._knots[-1].position, 0.0, 0.0)
        if self.times[index + 1] - self.times[index] == 1:  # a step has no slope
            return ReferenceSample(self._knots[index].position, 0.0, 0.0)
        t = (time_ns - self.times[index]) * SECONDS_PER_NANOSECOND
        c0, c1, c2, c3, c4, c5 = self._pieces[index]
        return ReferenceSample(
            c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5)))),
            c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5))),
            2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5)),
        )

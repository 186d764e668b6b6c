"""Reference trajectories made from a few numbers: step, sine, minimum jerk.

Every generator gives a :class:`JointTrajectory` whose splines are the wanted signal, so that
what is published, recorded and sampled is one and the same thing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.trajectory.joint_trajectory import JointTrajectory, TrajectoryPoint

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


def sine(
    duration: float,
    positions: Mapping[str, Mapping[str, float]],
    knots_per_period: int = 64,
) -> JointTrajectory:
    """Follow ``offset + amplitude sin(2 pi t / period + phase)`` in each joint.

    The signal is given by quintic pieces; with 64 of them in the shortest period the error is
    below 1e-9 of the amplitude.

    Args:
        duration: Length in [s].
        positions: For each joint ``offset`` [rad], ``amplitude`` [rad], ``period`` [s] and
            ``phase`` [rad]; all but the amplitude and period may be left out.
        knots_per_period: Pieces in the shortest period.

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
    pieces = duration * fastest / (2.0 * math.pi) * knots_per_period
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

"""How the joints of a group come to rest: a trajectory within decelerations and positions.

A joint that follows goes on as it would have for a moment, so that whenever its controller takes
the stop up it is where the stop says, and then decelerates constantly: a segment that is a cubic
like any other. One that does not follow (something blocks it) is held where it is: its reference
returns there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.goals.trajectories import GroupTrajectory
from hpid_ros.trajectory import Column, Knot
from hpid_ros.trajectory.joint_trajectory import PointArrays

LEAD_NS = NANOSECONDS // 20
"""Time until controllers have taken a stop up; as long joints go on as they did, in [ns]."""

_RESERVE = 0.9  # of a deceleration; the rest is for the glide from where a controller really was
_GRID_NS = NANOSECONDS // 1000  # stops last whole milliseconds, so that knots do not crowd
_GRID = _GRID_NS * SECONDS_PER_NANOSECOND


class Braking(NamedTuple):
    """How a joint may be stopped; "rad" reads "m" where it is prismatic."""

    deceleration: float  # [rad/s^2] at most so much; 0 for none: then duration decides
    duration: float  # [s] how long a joint without a deceleration takes
    lower: float = -math.inf  # [rad] lowest position
    upper: float = math.inf  # [rad] highest position


def coast_down(
    position: float, velocity: float, later: tuple[float, float], braking: Braking
) -> list[Knot]:
    """Return knots of a joint that goes on for LEAD_NS and then stops by constant deceleration.

    Near a limit of its positions it decelerates more: it never passes it. A joint that is beyond
    a limit is told to be at it.
    """
    now, then = _inside(Knot(0, position, velocity), braking), Knot(LEAD_NS, *later)
    was_inside = now.position == position  # else it does not go on from where it was
    may_go_on = was_inside and _inside(then, braking) == then
    if may_go_on and _stopping_distance(then, braking) <= _room(then, braking):
        return [now, *_brake(then, braking)]
    return _brake(now, braking)


def _brake(start: Knot, braking: Braking) -> list[Knot]:
    """Return a knot, and the one at which the joint has stopped, within the positions."""
    velocity = start.velocity or 0.0
    speed, room = abs(velocity), _room(start, braking)
    if speed == 0.0:
        return [start]
    duration = _stopping_time(speed, braking)
    if 0.5 * speed * duration > room:
        duration_ns = max(int(2.0 * room / speed / _GRID), 1) * _GRID_NS
    else:
        duration_ns = math.ceil(duration / _GRID) * _GRID_NS
    distance = min(0.5 * speed * duration_ns * SECONDS_PER_NANOSECOND, room)
    if distance < speed * duration_ns * SECONDS_PER_NANOSECOND / 3.0:  # the cubic would swing back
        return [Knot(start.time_ns, start.position + math.copysign(room, velocity), 0.0)]
    end = start.position + math.copysign(distance, velocity)
    return [start, Knot(start.time_ns + duration_ns, end, 0.0)]


def _stopping_time(speed: float, braking: Braking) -> float:
    if braking.deceleration:
        return speed / (_RESERVE * braking.deceleration)
    return braking.duration


def _stopping_distance(knot: Knot, braking: Braking) -> float:
    speed = abs(knot.velocity or 0.0)
    return 0.5 * speed * _stopping_time(speed, braking)


def _room(knot: Knot, braking: Braking) -> float:
    """Return how far a joint may go in the direction in which it moves."""
    is_up = (knot.velocity or 0.0) > 0.0
    return max(braking.upper - knot.position if is_up else knot.position - braking.lower, 0.0)


def return_to(target: float, position: float, velocity: float, braking: Braking) -> list[Knot]:
    """Return knots of a reference that comes to rest where the joint is.

    The time is such that the cubic to there nowhere accelerates more than the joint may.
    """
    duration = braking.duration
    if braking.deceleration:
        # Least T with 6 |d| + 4 |v| T <= a T^2, which bounds the acceleration at both ends.
        a, v, d = braking.deceleration, abs(velocity), abs(target - position)
        duration = (2.0 * v + math.sqrt(4.0 * v * v + 6.0 * a * d)) / a
    duration_ns = max(math.ceil(duration / _GRID), 1) * _GRID_NS
    return [Knot(0, position, velocity), Knot(duration_ns, target, 0.0)]


def stop_together(
    names: Sequence[str], knots: Sequence[Sequence[Knot]], now_ns: int
) -> GroupTrajectory:
    """Return what all joints are told to stop, each by knots of its own.

    The cubics of one joint are split where others have knots; a part of a cubic is the same cubic.
    """
    stamp_ns = max(now_ns - 1, 1)  # under way for every controller
    times = sorted({knot.time_ns for each in knots for knot in each})
    positions, velocities = (np.zeros((len(times), len(names))) for _ in range(2))
    for joint, each in enumerate(knots):
        reference = Column(names[joint], each, 1).start(1, each[0].position)
        for row, time_ns in enumerate(times):
            at = next((knot for knot in each if knot.time_ns == time_ns), None)
            sample = at[1:3] if at is not None else reference.sample(1 + time_ns)[:2]
            positions[row, joint], velocities[row, joint] = sample
    none = np.full_like(positions, np.nan)
    times_ns = np.array(times, dtype=np.int64)
    arrays = PointArrays(positions, velocities, none, none)
    return GroupTrajectory(tuple(names), stamp_ns, times_ns, arrays)


def _inside(knot: Knot, braking: Braking) -> Knot:
    """Return a knot within the positions; one at a limit does not go further."""
    inside = min(max(knot.position, braking.lower), braking.upper)
    velocity = knot.velocity or 0.0
    goes_out = velocity > 0.0 if inside == braking.upper else velocity < 0.0
    is_at_limit = inside in (braking.upper, braking.lower)
    return Knot(knot.time_ns, inside, 0.0 if is_at_limit and goes_out else velocity)

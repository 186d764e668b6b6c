"""The joints of a group: measured positions, references, and how they are stopped.

The controllers are asked for nothing: the code that follows a trajectory in each of them
(:class:`~hpid_ros.control.reference.Following`) runs here once more, fed with the same
trajectories and stamps. They differ by when exactly a controller took a trajectory up, which fades
with the glide. What controllers tell of their references is used where nothing was told them yet.

A joint that follows goes on as it would have for a moment, so that whenever its controller takes
the stop up it is where the stop says, and then decelerates constantly: a segment that is a cubic
like any other. One that does not follow (something blocks it) is held where it is: its reference
returns there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.control.reference import LARGEST_POSITION, Following, whole_turns
from hpid_ros.control.velocity import MeasuredVelocity, Unwrapper
from hpid_ros.messages.joint_state import JointPart
from hpid_ros.motion.joint_trajectory import Column, Knot, PointArrays, checked_column
from hpid_ros.nodes.parts.goals import GoalRequest, GroupSettings, GroupTrajectory

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


AGREES_WITHIN = 0.01
"""A controller whose reference is further from where it should be follows something else [rad]."""

_VELOCITY_FILTER = 0.05  # [s], for states without velocities: one count of an encoder is no motion


class GroupStates:
    """The newest state of each joint."""

    def __init__(self, settings: GroupSettings) -> None:
        self._joints = settings.joints
        self._timeout = settings.state_timeout
        self._sources = [MeasuredVelocity(_VELOCITY_FILTER) for _ in settings.joints]
        self._unwrappers = [
            Unwrapper(math.tau) if facts.is_endless else None for facts in settings.facts
        ]
        self.unusable = 0
        self.restart()

    def restart(self) -> None:
        """Forget everything: the next state is the first one."""
        count = len(self._joints)
        self.now_ns: int | None = None
        self.stamps_ns: list[int | None] = [None] * count
        self.positions, self.velocities = [0.0] * count, [0.0] * count
        for source in self._sources:
            source.reset()
        for unwrapper in self._unwrappers:
            if unwrapper is not None:
                unwrapper.reset()

    def take(self, stamp_ns: int, parts: Sequence[JointPart]) -> list[int] | None:
        """Take the joints of one message."""
        for part in parts:
            before_ns = self.stamps_ns[part.joint]
            if before_ns is not None and stamp_ns < before_ns:
                return None
        taken = []
        for joint, position, velocity in parts:
            before_ns = self.stamps_ns[joint]
            if stamp_ns == before_ns:
                continue  # a repeat
            if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
                self.unusable += 1
                continue
            since = 0.0 if before_ns is None else (stamp_ns - before_ns) * SECONDS_PER_NANOSECOND
            unwrapper = self._unwrappers[joint]
            steady = position if unwrapper is None else unwrapper.update(position)
            if velocity is not None and not -LARGEST_POSITION <= velocity <= LARGEST_POSITION:
                velocity = None  # drivers fill in NaN for what they do not measure
            self.stamps_ns[joint] = stamp_ns
            self.positions[joint] = position
            self.velocities[joint] = self._sources[joint].update(steady, velocity, since)
            taken.append(joint)
        if taken and (self.now_ns is None or stamp_ns > self.now_ns):
            self.now_ns = stamp_ns
        return taken

    def lack(self) -> str:
        """Return which joint has no state, or an old one; empty if all are there."""
        for joint, stamp_ns in zip(self._joints, self.stamps_ns, strict=True):
            if stamp_ns is None or self.now_ns is None:
                return f"there is no state of {joint} yet"
            age = (self.now_ns - stamp_ns) / NANOSECONDS
            if age > self._timeout:
                return f"{joint} has had no state for {age:.3g} s"
        return ""


class GroupReferences:
    """The references of all joints of a group."""

    def __init__(self, settings: GroupSettings) -> None:
        self._joints, self._takeover_time = settings.joints, settings.takeover_time
        self._following = [Following() for _ in settings.joints]
        for following, facts in zip(self._following, settings.facts, strict=True):
            following.turn = math.tau if facts.takes_shorter_way else 0.0

    def restart(self) -> None:
        """Forget where they are."""
        for following in self._following:
            following.follow(None)
            following.restart()

    def stand(self, joint: int, position: float) -> None:
        """Let a joint's reference be at a position, at rest."""
        self._following[joint].follow(None)
        self._following[joint].stand(position)

    def is_standing(self, joint: int) -> bool:
        """Return whether it is known where a joint's reference is."""
        return self._following[joint].is_standing

    def nearest(self, request: GoalRequest, start_ns: int, now_ns: int) -> GoalRequest:
        """Return a goal as whole turns away as its joints are that take the shorter way to it.

        Its points keep their differences: turns within it are turns that are meant.
        """
        away = [self._turns_to(at, request, start_ns, now_ns) for at in range(len(request.names))]
        if not any(away):
            return request
        arrays = request.arrays
        return replace(request, arrays=arrays._replace(positions=arrays.positions + away))

    def _turns_to(self, at: int, request: GoalRequest, start_ns: int, now_ns: int) -> float:
        """Return the turns between a joint of a goal and where its reference is, in [rad]."""
        joint = self._joints.index(request.names[at])
        turn = self._following[joint].turn
        if not turn:
            return 0.0
        column = checked_column(request.names[at], at, start_ns, request.times_ns, request.arrays)
        return whole_turns(self.look(joint, now_ns)[0] - column.target(now_ns), turn)

    def follow(self, trajectory: GroupTrajectory, now_ns: int) -> None:
        """Let the joints of a trajectory follow it from now on; they must be standing."""
        for at, name in enumerate(trajectory.names):
            following = self._following[self._joints.index(name)]
            following.sample(now_ns, self._takeover_time, None)
            following.follow(trajectory.column(at))
            following.sample(now_ns, self._takeover_time, None)

    def sample(self, joint: int, stamp_ns: int) -> Sequence[float]:
        """Return a joint's reference (position, velocity, acceleration), and go on from there."""
        return self._following[joint].sample(stamp_ns, self._takeover_time, None)

    def look(self, joint: int, stamp_ns: int) -> Sequence[float]:
        """Return the same of any instant, and leave everything as it is."""
        return copy(self._following[joint]).sample(stamp_ns, self._takeover_time, None)

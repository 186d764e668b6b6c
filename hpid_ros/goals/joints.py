"""What is known of a group's joints: what was measured, and where their references are.

The controllers are asked for nothing: the code that follows a trajectory in each of them
(:class:`~hpid_ros.control.reference.Following`) runs here once more, fed with the same
trajectories and stamps. They differ by when exactly a controller took a trajectory up, which fades
with the glide. What controllers tell of their references is used where nothing was told them yet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.control.estimation.velocity import MeasuredVelocity, Unwrapper
from hpid_ros.control.reference import LARGEST_POSITION, Following, whole_turns
from hpid_ros.goals.settings import GroupSettings
from hpid_ros.goals.trajectories import GoalRequest, GroupTrajectory
from hpid_ros.trajectory.joint_trajectory import checked_column
from hpid_ros.wire import JointPart

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

    @property
    def are_complete(self) -> bool:
        """Whether every joint has a state."""
        return None not in self.stamps_ns

    def lack(self) -> str:
        """Return which joint has no state, or an old one, in words; nothing if all are there."""
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
        """Tell whether it is known where a joint's reference is."""
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

"""A goal's trajectory: what came, checked, and what all joints of the group are told for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hpid_ros.base.errors import TrajectoryError, unknown_name
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.goals.results import GoalError, ResultCode
from hpid_ros.goals.settings import GroupSettings
from hpid_ros.goals.tolerances import AskedTolerance, Tolerances
from hpid_ros.trajectory import Column
from hpid_ros.trajectory.joint_trajectory import (
    Integers,
    Point,
    PointArrays,
    checked_column,
    require_arrays,
)
from hpid_ros.wire import MOST_MIXED_POINTS, MOST_POINTS

_EFFORTS = PointArrays._fields.index("efforts")
_AT_REST = 1.2e-7  # [rad/s, m/s], float32's epsilon, as JTC takes it
_ROUNDED = 1e-6  # [rad, m]; limits are written with few digits, and planned with more
_WAITS_AT_MOST = 3600  # [s] for the start of a goal


@dataclass(frozen=True, eq=False)
class GoalRequest:
    """A goal that is a trajectory, whoever may follow it."""

    names: tuple[str, ...]  # its joints, each once
    stamp_ns: int  # [ns] when it starts; 0 means now
    times_ns: Integers  # [ns] time from start of each point, shape (points,)
    arrays: PointArrays  # the numbers of the points, each of shape (points, joints)
    path_tolerance: tuple[AskedTolerance, ...] = ()  # what it asks for while it lasts
    goal_tolerance: tuple[AskedTolerance, ...] = ()  # what it asks for at its end
    goal_time_tolerance: float = 0.0  # [s] 0 is the default, -1 waits for ever

    def require_trajectory(self, lengths: Integers, point: Callable[[int], Point]) -> None:
        """Refuse what is no trajectory."""
        if not self.names or len(set(self.names)) != len(self.names):
            raise GoalError(
                f"a goal must name each of its joints once, not {list(self.names)}",
                ResultCode.INVALID_JOINTS,
            )
        is_mixed = bool(np.any(lengths != lengths[:1]))
        most = (MOST_MIXED_POINTS if is_mixed else MOST_POINTS) - 1  # one may be put before them
        if len(self.times_ns) > most:
            differing = " whose points differ in their arrays" if is_mixed else ""
            raise GoalError(f"a goal{differing} may have {most} points, not {len(self.times_ns)}")
        try:
            require_arrays(self.names, self.stamp_ns, self.times_ns, self.arrays, lengths, point)
        except TrajectoryError as error:
            raise GoalError(str(error)) from None

    def require_group(self, settings: GroupSettings) -> Tolerances:
        """Refuse what is not for these joints, and return the tolerances that hold."""
        for joint in self.names:
            if joint not in settings.joints:
                line = unknown_name("joint", joint, settings.joints)
                raise GoalError(line, ResultCode.INVALID_JOINTS)
        lacking = [joint for joint in settings.joints if joint not in self.names]
        if lacking and not settings.allows_partial_goals:
            raise GoalError(
                f"the goal lacks {', '.join(lacking)}; it must name all joints unless "
                f"allow_partial_joints_goal is true",
                ResultCode.INVALID_JOINTS,
            )
        last = self.arrays.velocities[-1]
        if not settings.allows_final_velocity:
            for joint, velocity in zip(self.names, last.tolist(), strict=True):
                if abs(velocity) > _AT_REST:  # NaN, where there is none, is not
                    unit = settings.facts[settings.joints.index(joint)].unit
                    raise GoalError(
                        f"the last point must be at rest, not {joint} at {velocity:g} {unit}/s, "
                        f"unless allow_nonzero_velocity_at_trajectory_end is true"
                    )
        return settings.tolerances.asked(
            self.path_tolerance, self.goal_tolerance, self.goal_time_tolerance
        )

    def require_positions(self, settings: GroupSettings, positions: Sequence[float]) -> None:
        """Refuse what leads a joint beyond the positions that the robot's description allows.

        A joint that is beyond them may be led back: points may be as far out as it is.
        """
        for at, name in enumerate(self.names):
            joint = settings.joints.index(name)
            facts, here = settings.facts[joint], positions[joint]
            path = self.arrays.positions[:, at]
            low = min(facts.lower - _ROUNDED, here)
            high = max(facts.upper + _ROUNDED, here)
            beyond = np.flatnonzero((path < low) | (path > high))
            if len(beyond):
                point = int(beyond[0])
                value, unit = float(path[point]), facts.unit
                raise GoalError(
                    f"point {point} leads {name} to {value:g} {unit}, its limits are "
                    f"{facts.lower:g} and {facts.upper:g} {unit}"
                )

    def start(self, now_ns: int) -> int:
        """Return the instant at which the goal starts, in [ns]."""
        if self.stamp_ns == 0:
            # One nanosecond ago: for every controller it is under way, whichever state it is at.
            return max(now_ns - 1, 1)
        end_ns = self.stamp_ns + int(self.times_ns[-1])
        if end_ns < now_ns:
            raise GoalError(
                f"the goal ended at {_seconds(end_ns)} s, in the past: the stamps of joint_states "
                f"say {_seconds(now_ns)} s",
                ResultCode.OLD_HEADER_TIMESTAMP,
            )
        if self.stamp_ns > now_ns + _WAITS_AT_MOST * NANOSECONDS:
            raise GoalError(
                f"the goal must start within {_WAITS_AT_MOST} s, not at "
                f"{_seconds(self.stamp_ns)} s: the stamps of joint_states say "
                f"{_seconds(now_ns)} s"
            )
        return self.stamp_ns


def _seconds(instant_ns: int) -> str:
    return f"{instant_ns / NANOSECONDS:.3f}"


@dataclass(frozen=True, eq=False)
class GroupTrajectory:
    """What all joints of a group are told at once, within the numbers that controllers take."""

    names: tuple[str, ...]  # the joints
    stamp_ns: int  # [ns] when it starts; never 0
    times_ns: Integers  # [ns] time from start of each point, shape (points,)
    arrays: PointArrays  # the numbers of the points, each of shape (points, joints)

    def __post_init__(self) -> None:
        """Bound the numbers: controllers would refuse a stop from beyond, and go on."""
        for values in self.arrays:
            np.clip(values, -LARGEST_POSITION, LARGEST_POSITION, out=values)

    @property
    def end_ns(self) -> int:
        """The instant of the last point in [ns]."""
        return self.stamp_ns + int(self.times_ns[-1])

    def column(self, joint: int) -> Column:
        """Return one joint's part."""
        name = self.names[joint]
        return checked_column(name, joint, self.stamp_ns, self.times_ns, self.arrays)


def for_all_joints(
    request: GoalRequest,
    joints: Sequence[str],
    start_ns: int,
    now_ns: int,
    standing: Sequence[Sequence[float]],
    rest: Sequence[float],
) -> GroupTrajectory:
    """Return what all joints are told for a goal, which may name some of them only.

    The others are told to rest. The first point is never in the future: where the goal's own is,
    one is put before it, at which the joints are where their references stand now. So the goal
    is under way for every controller, whenever it takes it up, and none of them jumps: it glides.
    """
    named = [joints.index(name) for name in request.names]
    times_ns = request.times_ns
    arrays = []
    for order, given in enumerate(request.arrays):
        values = np.zeros((len(times_ns), len(joints)))
        values[:] = rest if order == 0 else 0.0
        values[:, named] = given
        values[np.isnan(given[:, 0])] = np.nan
        arrays.append(values)
    before_ns = max(now_ns - 1, 0) - start_ns
    if times_ns[0] > before_ns:
        times_ns = np.concatenate([[before_ns], times_ns])
        for order, values in enumerate(arrays):
            if order == _EFFORTS:  # until its own first point as there, as a spline has it
                first = values[0]
            else:
                first = np.array(rest if order == 0 else [0.0] * len(joints))
                first[named] = [standing[joint][order] for joint in named]
                first[np.isnan(values[0])] = np.nan
            arrays[order] = np.vstack([first, values])
    return GroupTrajectory(tuple(joints), start_ns, times_ns, PointArrays(*arrays))

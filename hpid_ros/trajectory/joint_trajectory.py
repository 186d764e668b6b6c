"""A trajectory of several joints, checked as a whole, without ROS.

Source: ``trajectory_msgs/msg/JointTrajectory``; the checks are those with which
``joint_trajectory_controller`` rejects a message.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from hpid_ros.errors import TrajectoryError, unknown_name
from hpid_ros.trajectory.spline import Column, Knot

_LARGEST = 1e9  # [rad, rad/s, rad/s^2]; beyond it is no joint, and splines overflow


class TrajectoryPoint(NamedTuple):
    """One instant of all joints.

    Attributes:
        time_from_start_ns: In [ns].
        positions: One for each joint, in [rad].
        velocities: One for each joint in [rad/s], or empty.
        accelerations: One for each joint in [rad/s^2], or empty.
    """

    time_from_start_ns: int
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()
    accelerations: tuple[float, ...] = ()


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
        """Return the same motion as one that is under way, for whoever comes later.

        A stamp of 0 means "with the next state", so a start at instant 0 is told as a stamp of
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
            )
            for point in self.points
        )
        return Column(joint, knots, self.stamp_ns)


def require_trajectory(
    joint_names: Sequence[str], points: Sequence[TrajectoryPoint], stamp_ns: int, first: int = 0
) -> None:
    """Refuse what is no trajectory.

    Args:
        joint_names: Its joints.
        points: Its points, or some that follow each other.
        stamp_ns: When it starts in [ns].
        first: Which of its points the first of these is.

    Raises:
        TrajectoryError: As for :class:`JointTrajectory`.
    """
    if not joint_names or len(set(joint_names)) != len(joint_names):
        raise TrajectoryError(
            f"a trajectory must name each of its joints once, not {list(joint_names)}"
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

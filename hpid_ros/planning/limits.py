"""Whether a reference asks for more than the robot's description allows."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hpid_ros.errors import TrajectoryError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.trajectory import JointTrajectory
from hpid_ros.trajectory.spline import SECONDS_PER_NANOSECOND, segment

_LOOKS = np.linspace(0.0, 1.0, 21)  # in each segment
_SLACK = 1e-9  # of a limit, for rounding


def check_limits(trajectory: JointTrajectory, description: RobotDescription) -> None:
    """Refuse a trajectory that passes a joint's limits of position or velocity.

    Args:
        trajectory: The trajectory.
        description: The robot.

    Raises:
        TrajectoryError: It does; the line names the joint and the time.
        RobotDescriptionError: The robot lacks one of its joints.
    """
    for joint in description.select(trajectory.joint_names):
        for start, end in pairwise(trajectory.column(joint.name).knots):
            c = segment(start, end)
            t = _LOOKS * (end.time_ns - start.time_ns) * SECONDS_PER_NANOSECOND
            position = np.polynomial.polynomial.polyval(t, c)
            rate = np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyder(c))
            at = f"{joint.name} at {start.time_ns * SECONDS_PER_NANOSECOND:.3f} s"
            if position.min() < joint.lower - _SLACK or position.max() > joint.upper + _SLACK:
                raise TrajectoryError(
                    f"{at} would be at {position.min():.4g} to {position.max():.4g} rad, its "
                    f"limits are {joint.lower:g} and {joint.upper:g} rad"
                )
            fastest = float(np.abs(rate).max())
            if fastest > joint.velocity + _SLACK:
                raise TrajectoryError(
                    f"{at} would turn at {fastest:.4g} rad/s, its limit is "
                    f"{joint.velocity:g} rad/s: lower arm_speed, line_speed or drive_speed"
                )

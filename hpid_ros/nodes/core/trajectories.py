"""Trajectories as ROS messages, and one joint's column of a decoded one."""

from __future__ import annotations

from builtin_interfaces.msg import Duration, Time
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage
from trajectory_msgs.msg import JointTrajectoryPoint

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.joint_trajectory import MixedTrajectory, TrajectoryArrays
from hpid_ros.motion.joint_trajectory import (
    Column,
    JointTrajectory,
    PointArrays,
    column_from_arrays,
)


def column_of(decoded: TrajectoryArrays | MixedTrajectory, joint: str) -> Column | None:
    """Check a decoded message and return one joint's column."""
    if joint not in decoded.names:
        return None
    return column_from_arrays(
        joint,
        decoded.names,
        decoded.stamp_ns,
        decoded.times_ns,
        PointArrays(*decoded[3:7]),
        decoded.lengths,
        decoded.point,
    )


def to_message(trajectory: JointTrajectory) -> JointTrajectoryMessage:
    """Return the message of a trajectory."""
    seconds, nanoseconds = divmod(trajectory.stamp_ns, NANOSECONDS)
    message = JointTrajectoryMessage(joint_names=list(trajectory.joint_names))
    message.header.stamp = Time(sec=seconds, nanosec=nanoseconds)
    for point in trajectory.points:
        seconds, nanoseconds = divmod(point.time_from_start_ns, NANOSECONDS)
        message.points.append(
            JointTrajectoryPoint(
                positions=point.positions,
                velocities=point.velocities,
                accelerations=point.accelerations,
                effort=point.efforts,
                time_from_start=Duration(sec=seconds, nanosec=nanoseconds),
            )
        )
    return message

"""``trajectory_msgs/msg/JointTrajectory`` read message by message, beside the readers of bytes."""

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.joint_trajectory import decode_trajectory
from hpid_ros.motion import JointTrajectory, TrajectoryPoint
from hpid_ros.nodes.parts.references import column_of


def from_message(message):
    """Check a message and return what it says."""
    stamp = message.header.stamp
    points = (
        TrajectoryPoint(
            point.time_from_start.sec * NANOSECONDS + point.time_from_start.nanosec,
            tuple(point.positions),
            tuple(point.velocities),
            tuple(point.accelerations),
            tuple(point.effort),
        )
        for point in message.points
    )
    return JointTrajectory(
        tuple(message.joint_names), tuple(points), stamp.sec * NANOSECONDS + stamp.nanosec
    )


def column_from_bytes(raw, joint):
    """Check a serialised message and return one joint's column, as a controller does."""
    return column_of(decode_trajectory(raw), joint)

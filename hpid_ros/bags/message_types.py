"""The message definitions of ROS 2 Jazzy, for writing complete bags and reading rare messages."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.trajectory import JointTrajectory

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


@functools.cache
def jazzy_types() -> Typestore:
    """Return Jazzy's message definitions; building them takes some 50 ms, once."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def encode_joint_trajectory(trajectory: JointTrajectory) -> bytes:
    """Return a trajectory as a serialised ``trajectory_msgs/msg/JointTrajectory``."""
    types = jazzy_types()
    time, duration, header, point_type, message_type = (
        types.types[name]
        for name in (
            "builtin_interfaces/msg/Time",
            "builtin_interfaces/msg/Duration",
            "std_msgs/msg/Header",
            "trajectory_msgs/msg/JointTrajectoryPoint",
            JOINT_TRAJECTORY,
        )
    )
    points = [
        point_type(
            positions=np.array(point.positions),
            velocities=np.array(point.velocities),
            accelerations=np.array(point.accelerations),
            effort=np.array([]),
            time_from_start=duration(*divmod(point.time_from_start_ns, NANOSECONDS)),
        )
        for point in trajectory.points
    ]
    stamp = time(*divmod(trajectory.stamp_ns, NANOSECONDS))
    message = message_type(
        header=header(stamp=stamp, frame_id=""),
        joint_names=list(trajectory.joint_names),
        points=points,
    )
    return bytes(types.serialize_cdr(message, JOINT_TRAJECTORY))

"""The message definitions of ROS 2 Jazzy, for writing complete bags and reading rare messages."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from hpid_ros.errors import MessageError
from hpid_ros.trajectory import JointTrajectory, TrajectoryPoint

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"

_NS_PER_S = 1_000_000_000


@functools.cache
def jazzy_types() -> Typestore:
    """Return Jazzy's message definitions; building them takes some 50 ms, once."""
    return get_typestore(Stores.ROS2_JAZZY)


def decode_joint_trajectory(raw: bytes) -> JointTrajectory:
    """Decode a serialised ``trajectory_msgs/msg/JointTrajectory``.

    Args:
        raw: The message with its encapsulation header.

    Raises:
        MessageError: The bytes are no such message.
        TrajectoryError: They are, but a controller would refuse the trajectory.
    """
    message: Any
    try:
        message = jazzy_types().deserialize_cdr(raw, JOINT_TRAJECTORY)
    # rosbags lets whatever its generated code trips over escape: struct, index, Unicode errors.
    except Exception as error:
        raise MessageError(f"{len(raw)} bytes are no {JOINT_TRAJECTORY}: {error!r}") from error
    return JointTrajectory(
        tuple(message.joint_names),
        tuple(
            TrajectoryPoint(
                _nanoseconds(point.time_from_start),
                tuple(point.positions.tolist()),
                tuple(point.velocities.tolist()),
                tuple(point.accelerations.tolist()),
            )
            for point in message.points
        ),
        _nanoseconds(message.header.stamp),
    )


def _nanoseconds(time: Any) -> int:
    """Return a ``builtin_interfaces`` Time or Duration in [ns]."""
    return int(time.sec) * _NS_PER_S + int(time.nanosec)


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
            time_from_start=duration(*divmod(point.time_from_start_ns, _NS_PER_S)),
        )
        for point in trajectory.points
    ]
    stamp = time(*divmod(trajectory.stamp_ns, _NS_PER_S))
    message = message_type(
        header=header(stamp=stamp, frame_id=""),
        joint_names=list(trajectory.joint_names),
        points=points,
    )
    return bytes(types.serialize_cdr(message, JOINT_TRAJECTORY))

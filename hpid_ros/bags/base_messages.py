"""Odometry, poses and slip of a base as messages, and back from a bag as columns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.bags.whole_messages import (
    PoseValues,
    Stamp,
    Vector,
    encoded,
    header_of,
    messages_on,
    new,
    pose_of,
    stamp_ns_of,
    vector_of,
)
from hpid_ros.errors import BagError

ODOMETRY = "nav_msgs/msg/Odometry"
VECTOR = "geometry_msgs/msg/Vector3Stamped"

Numbers = NDArray[np.float64]


class PlanarColumns(NamedTuple):
    """Poses of a base in the plane, as one topic tells them.

    Attributes:
        stamps_ns: Ascending, (N,), in [ns].
        poses: x [m], y [m] and heading [rad], which does not wrap, (N, 3).
    """

    stamps_ns: NDArray[np.int64]
    poses: Numbers


def encode_odometry(
    header: Stamp,
    child: str,
    pose: PoseValues,
    pose_covariance: Sequence[float],
    twist: tuple[Vector, Vector],
    twist_covariance: Sequence[float],
) -> bytes:
    """Return a serialised ``nav_msgs/msg/Odometry``.

    Args:
        header: Stamp and frame of the pose.
        child: Frame of the twist, ``child_frame_id``.
        pose: Position in [m] and quaternion x, y, z, w.
        pose_covariance: 36 numbers, row by row.
        twist: Linear [m/s] and angular [rad/s].
        twist_covariance: 36 numbers, row by row.
    """
    linear, angular = twist
    return encoded(
        ODOMETRY,
        header=header_of(header),
        child_frame_id=child,
        pose=new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=pose_of(pose),
            covariance=np.array(pose_covariance, dtype=np.float64),
        ),
        twist=new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=new(
                "geometry_msgs/msg/Twist", linear=vector_of(linear), angular=vector_of(angular)
            ),
            covariance=np.array(twist_covariance, dtype=np.float64),
        ),
    )


def encode_vector(header: Stamp, vector: Vector) -> bytes:
    """Return a serialised ``geometry_msgs/msg/Vector3Stamped``."""
    return encoded(VECTOR, header=header_of(header), vector=vector_of(vector))


def read_planar(bag: Path, topic: str) -> PlanarColumns:
    """Return the poses of an odometry topic in the plane.

    Args:
        bag: The bag.
        topic: Its name; without a leading slash also its last part.

    Raises:
        BagError: The bag lacks the topic or messages on it, or cannot be read.
    """
    stamps, rows = [], []
    for message in _present(bag, topic, ODOMETRY):
        pose = message.pose.pose
        q = pose.orientation
        heading = np.arctan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
        stamps.append(stamp_ns_of(message))
        rows.append((pose.position.x, pose.position.y, float(heading)))
    order, stamps_ns = _ordered(stamps)
    poses = np.array(rows)[order]
    poses[:, 2] = np.unwrap(poses[:, 2])
    return PlanarColumns(stamps_ns, poses)


def read_vectors(bag: Path, topic: str) -> tuple[NDArray[np.int64], Numbers]:
    """Return stamps in [ns], (N,), and x, y, z, (N, 3), of a topic of stamped vectors.

    Raises:
        BagError: As for :func:`read_planar`.
    """
    stamps, rows = [], []
    for message in _present(bag, topic, VECTOR):
        stamps.append(stamp_ns_of(message))
        rows.append((message.vector.x, message.vector.y, message.vector.z))
    order, stamps_ns = _ordered(stamps)
    return stamps_ns, np.array(rows)[order]


def _present(bag: Path, topic: str, kind: str) -> list[Any]:
    found = messages_on(bag, topic, kind)
    if not found:
        raise BagError(f"bag {bag}: no message on {topic}")
    return found


def _ordered(stamps: list[int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return places in the order of the stamps, the last of each stamp, and the stamps."""
    stamps_ns = np.array(stamps, dtype=np.int64)
    order = np.argsort(stamps_ns, kind="stable")
    is_last = np.append(np.diff(stamps_ns[order]) > 0, True)
    order = order[is_last]
    return order, stamps_ns[order]

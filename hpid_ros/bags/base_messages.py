"""Odometry, poses and slip of a base as messages, and back from a bag as columns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.bags.message_types import jazzy_types
from hpid_ros.bags.storage import Storage
from hpid_ros.bags.topic_names import find_topic
from hpid_ros.errors import BagError

ODOMETRY = "nav_msgs/msg/Odometry"
VECTOR = "geometry_msgs/msg/Vector3Stamped"

_NS_PER_S = 1_000_000_000

Numbers = NDArray[np.float64]
Vector = tuple[float, float, float]


class Stamp(NamedTuple):
    """Header of a message.

    Attributes:
        stamp_ns: In [ns].
        frame: Its ``frame_id``.
    """

    stamp_ns: int
    frame: str


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
    pose: tuple[Vector, Sequence[float]],
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
    position, orientation = pose
    linear, angular = twist
    message = _new(
        ODOMETRY,
        header=_header(header),
        child_frame_id=child,
        pose=_new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=_new(
                "geometry_msgs/msg/Pose",
                position=_new("geometry_msgs/msg/Point", **_xyz(position)),
                orientation=_new(
                    "geometry_msgs/msg/Quaternion",
                    **dict(zip("xyzw", map(float, orientation), strict=True)),
                ),
            ),
            covariance=np.array(pose_covariance, dtype=np.float64),
        ),
        twist=_new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=_new(
                "geometry_msgs/msg/Twist",
                linear=_new("geometry_msgs/msg/Vector3", **_xyz(linear)),
                angular=_new("geometry_msgs/msg/Vector3", **_xyz(angular)),
            ),
            covariance=np.array(twist_covariance, dtype=np.float64),
        ),
    )
    return bytes(jazzy_types().serialize_cdr(message, ODOMETRY))


def encode_vector(header: Stamp, vector: Vector) -> bytes:
    """Return a serialised ``geometry_msgs/msg/Vector3Stamped``."""
    message = _new(
        VECTOR,
        header=_header(header),
        vector=_new("geometry_msgs/msg/Vector3", **_xyz(vector)),
    )
    return bytes(jazzy_types().serialize_cdr(message, VECTOR))


def read_planar(bag: Path, topic: str) -> PlanarColumns:
    """Return the poses of an odometry topic in the plane.

    Args:
        bag: The bag.
        topic: Its name; without a leading slash also its last part.

    Raises:
        BagError: The bag lacks the topic or messages on it, or cannot be read.
    """
    stamps, rows = [], []
    for message in _messages(bag, topic, ODOMETRY):
        pose = message.pose.pose
        q = pose.orientation
        heading = np.arctan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
        stamps.append(_stamp_ns(message))
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
    for message in _messages(bag, topic, VECTOR):
        stamps.append(_stamp_ns(message))
        rows.append((message.vector.x, message.vector.y, message.vector.z))
    order, stamps_ns = _ordered(stamps)
    return stamps_ns, np.array(rows)[order]


def _messages(bag: Path, topic: str, kind: str) -> list[Any]:
    deserialize = jazzy_types().deserialize_cdr
    with Storage(bag) as storage:
        where = f"bag {storage.path}"
        known = {name: info.type for name, info in storage.topics().items()}
        name = find_topic(where, topic, known, (kind,))
        found = []
        for batch in storage.batches(frozenset({name}), lambda share: None):
            for index in range(len(batch.starts)):
                try:
                    found.append(deserialize(batch.raw(index), kind))
                # rosbags lets whatever its generated code trips over escape.
                except Exception as error:
                    line = f"{where}: a message on {name} is no {kind}: {error!r}"
                    raise BagError(line) from error
    if not found:
        raise BagError(f"{where}: no message on {name}")
    return found


def _ordered(stamps: list[int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return places in the order of the stamps, the last of each stamp, and the stamps."""
    stamps_ns = np.array(stamps, dtype=np.int64)
    order = np.argsort(stamps_ns, kind="stable")
    is_last = np.append(np.diff(stamps_ns[order]) > 0, True)
    order = order[is_last]
    return order, stamps_ns[order]


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def _header(header: Stamp) -> Any:
    seconds, rest = divmod(header.stamp_ns, _NS_PER_S)
    stamp = _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=header.frame)


def _xyz(vector: Vector) -> dict[str, float]:
    return dict(zip("xyz", map(float, vector), strict=True))


def _new(kind: str, **values: Any) -> Any:
    return jazzy_types().types[kind](**values)

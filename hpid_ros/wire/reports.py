"""Codec of a simulated robot's reports: odometry, poses, slip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from hpid_ros.base.arrays import Vector
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.wire.cdr import Writer

CLOCK = "rosgraph_msgs/msg/Clock"
ODOMETRY = "nav_msgs/msg/Odometry"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
POSE = "geometry_msgs/msg/PoseStamped"
POSES = "geometry_msgs/msg/PoseArray"
STATUSES = "diagnostic_msgs/msg/DiagnosticArray"

PoseValues = tuple[Vector, tuple[float, float, float, float]]
"""Position in [m] and quaternion x, y, z, w."""


class Stamp(NamedTuple):
    """Header of a message."""

    stamp_ns: int  # [ns]
    frame: str  # its frame_id


class Status(NamedTuple):
    """One ``diagnostic_msgs/DiagnosticStatus`` with the stamp of its array."""

    stamp_ns: int  # [ns]
    level: int  # 0 good, 1 a warning, 2 an error
    name: str
    message: str  # in words
    values: Mapping[str, str]  # figures as texts, by name


def encode_clock(stamp_ns: int) -> bytes:
    """Return a serialised ``rosgraph_msgs/msg/Clock`` of a time in [ns]."""
    writer = Writer()
    _time(writer, stamp_ns)
    return writer.raw


def encode_odometry(
    header: Stamp,
    child: str,
    pose: PoseValues,
    pose_covariance: Sequence[float],
    twist: tuple[Vector, Vector],
    twist_covariance: Sequence[float],
) -> bytes:
    """Return a serialised ``nav_msgs/msg/Odometry``."""
    writer = _begun(header)
    writer.string(child)
    for values in (*pose, pose_covariance, *twist, twist_covariance):
        writer.doubles(values)
    return writer.raw


def encode_vector(header: Stamp, vector: Vector) -> bytes:
    """Return a serialised ``geometry_msgs/msg/Vector3Stamped``."""
    writer = _begun(header)
    writer.doubles(vector)
    return writer.raw


def encode_pose(header: Stamp, pose: PoseValues) -> bytes:
    """Return a serialised ``geometry_msgs/msg/PoseStamped``."""
    writer = _begun(header)
    for values in pose:
        writer.doubles(values)
    return writer.raw


def encode_poses(header: Stamp, poses: Sequence[PoseValues]) -> bytes:
    """Return a serialised ``geometry_msgs/msg/PoseArray``."""
    writer = _begun(header)
    writer.scalar("I", len(poses))
    for pose in poses:
        for values in pose:
            writer.doubles(values)
    return writer.raw


def encode_status(status: Status) -> bytes:
    """Return a serialised ``diagnostic_msgs/msg/DiagnosticArray`` of one status."""
    writer = _begun(Stamp(status.stamp_ns, ""))
    writer.scalar("I", 1)
    writer.scalar("B", status.level)
    writer.string(status.name)
    writer.string(status.message)
    writer.string("")  # hardware_id
    writer.scalar("I", len(status.values))
    for key, value in status.values.items():
        writer.string(key)
        writer.string(value)
    return writer.raw


def _begun(header: Stamp) -> Writer:
    writer = Writer()
    _time(writer, header.stamp_ns)
    writer.string(header.frame)
    return writer


def _time(writer: Writer, stamp_ns: int) -> None:
    seconds, rest = divmod(stamp_ns, NANOSECONDS)
    writer.scalar("i", seconds)
    writer.scalar("I", rest)

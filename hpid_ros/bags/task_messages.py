"""Poses of end effector and bricks and what the gripper did, as messages and back from a bag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.bags.whole_messages import (
    PoseValues,
    Stamp,
    encoded,
    header_of,
    messages_on,
    new,
    pose_of,
    stamp_ns_of,
)
from hpid_ros.errors import BagError

POSE = "geometry_msgs/msg/PoseStamped"
POSES = "geometry_msgs/msg/PoseArray"
STATUSES = "diagnostic_msgs/msg/DiagnosticArray"

Numbers = NDArray[np.float64]


class PoseColumns(NamedTuple):
    """K poses at N times, as one topic tells them.

    Attributes:
        stamps_ns: Ascending, (N,), in [ns].
        positions: (N, K, 3), in [m].
        orientations: Quaternions x, y, z, w, (N, K, 4).
    """

    stamps_ns: NDArray[np.int64]
    positions: Numbers
    orientations: Numbers


class Status(NamedTuple):
    """One ``diagnostic_msgs/DiagnosticStatus`` with the stamp of its array.

    Attributes:
        stamp_ns: In [ns].
        level: 0 good, 1 a warning, 2 an error.
        name: Of what it is.
        message: In words.
        values: Figures as texts, by name.
    """

    stamp_ns: int
    level: int
    name: str
    message: str
    values: Mapping[str, str]


def encode_pose(header: Stamp, pose: PoseValues) -> bytes:
    """Return a serialised ``geometry_msgs/msg/PoseStamped``.

    Args:
        header: Its header.
        pose: The pose.
    """
    return encoded(POSE, header=header_of(header), pose=pose_of(pose))


def encode_poses(header: Stamp, poses: Sequence[PoseValues]) -> bytes:
    """Return a serialised ``geometry_msgs/msg/PoseArray``.

    Args:
        header: Its header.
        poses: The poses.
    """
    return encoded(POSES, header=header_of(header), poses=[pose_of(pose) for pose in poses])


def encode_status(status: Status) -> bytes:
    """Return a serialised ``diagnostic_msgs/msg/DiagnosticArray`` of one status."""
    one = new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=status.level,
        name=status.name,
        message=status.message,
        hardware_id="",
        values=[
            new("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in status.values.items()
        ],
    )
    return encoded(STATUSES, header=header_of(Stamp(status.stamp_ns, "")), status=[one])


def read_poses(bag: Path, topic: str, kind: str = POSES) -> PoseColumns | None:
    """Return the poses of a topic; None where there is no such topic or nothing on it.

    Args:
        bag: The bag.
        topic: Its name; without a leading slash also its last part.
        kind: :data:`POSES` or :data:`POSE`.

    Raises:
        BagError: The bag or a message cannot be read, or the number of poses changes.
    """
    rows: dict[int, Numbers] = {}
    for message in messages_on(bag, topic, kind):
        poses = message.poses if kind == POSES else [message.pose]
        rows[stamp_ns_of(message)] = np.array([_numbers(pose) for pose in poses]).reshape(-1, 7)
    if not rows:
        return None
    stamps = sorted(rows)
    if len({len(row) for row in rows.values()}) > 1:
        raise BagError(f"bag {bag}: the number of poses on {topic} changes")
    whole = np.array([rows[stamp] for stamp in stamps])
    return PoseColumns(np.array(stamps, dtype=np.int64), whole[..., :3], whole[..., 3:])


def read_statuses(bag: Path, topic: str) -> list[Status]:
    """Return what a topic of diagnostics says, in the order of the log; nothing without it.

    Raises:
        BagError: The bag or a message cannot be read.
    """
    return [
        Status(
            stamp_ns_of(message),
            int(status.level),
            status.name,
            status.message,
            {pair.key: pair.value for pair in status.values},
        )
        for message in messages_on(bag, topic, STATUSES)
        for status in message.status
    ]


def _numbers(pose: Any) -> tuple[float, ...]:
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w

"""Poses of end effector and bricks and what the gripper did, as messages and back from a bag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.bags.base_messages import Stamp, Vector
from hpid_ros.bags.message_types import jazzy_types
from hpid_ros.bags.storage import Storage
from hpid_ros.bags.topic_names import find_topic
from hpid_ros.errors import BagError

POSE = "geometry_msgs/msg/PoseStamped"
POSES = "geometry_msgs/msg/PoseArray"
STATUSES = "diagnostic_msgs/msg/DiagnosticArray"

_NS_PER_S = 1_000_000_000

Numbers = NDArray[np.float64]
PoseValues = tuple[Vector, tuple[float, float, float, float]]
"""Position in [m] and quaternion x, y, z, w."""


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
    return _encoded(POSE, header=_header(header), pose=_pose(pose))


def encode_poses(header: Stamp, poses: Sequence[PoseValues]) -> bytes:
    """Return a serialised ``geometry_msgs/msg/PoseArray``.

    Args:
        header: Its header.
        poses: The poses.
    """
    return _encoded(POSES, header=_header(header), poses=[_pose(pose) for pose in poses])


def encode_status(status: Status) -> bytes:
    """Return a serialised ``diagnostic_msgs/msg/DiagnosticArray`` of one status."""
    one = _new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=status.level,
        name=status.name,
        message=status.message,
        hardware_id="",
        values=[
            _new("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in status.values.items()
        ],
    )
    return _encoded(STATUSES, header=_header(Stamp(status.stamp_ns, "")), status=[one])


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
    for message in _messages(bag, topic, kind):
        poses = message.poses if kind == POSES else [message.pose]
        rows[_stamp_ns(message)] = np.array([_numbers(pose) for pose in poses]).reshape(-1, 7)
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
            _stamp_ns(message),
            int(status.level),
            status.name,
            status.message,
            {pair.key: pair.value for pair in status.values},
        )
        for message in _messages(bag, topic, STATUSES)
        for status in message.status
    ]


def _messages(bag: Path, topic: str, kind: str) -> list[Any]:
    deserialize = jazzy_types().deserialize_cdr
    with Storage(bag) as storage:
        where = f"bag {storage.path}"
        known = {name: info.type for name, info in storage.topics().items()}
        if not any(name.rpartition("/")[2] == topic.rpartition("/")[2] for name in known):
            return []
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
    return found


def _numbers(pose: Any) -> tuple[float, ...]:
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def _header(header: Stamp) -> Any:
    seconds, rest = divmod(header.stamp_ns, _NS_PER_S)
    stamp = _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=header.frame)


def _pose(pose: PoseValues) -> Any:
    (x, y, z), (qx, qy, qz, qw) = pose
    return _new(
        "geometry_msgs/msg/Pose",
        position=_new("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z)),
        orientation=_new(
            "geometry_msgs/msg/Quaternion", x=float(qx), y=float(qy), z=float(qz), w=float(qw)
        ),
    )


def _encoded(kind: str, **values: Any) -> bytes:
    return bytes(jazzy_types().serialize_cdr(_new(kind, **values), kind))


def _new(kind: str, **values: Any) -> Any:
    return jazzy_types().types[kind](**values)

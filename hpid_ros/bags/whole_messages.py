"""Messages as whole objects: made, serialised, and read back from one topic of a bag.

For topics of a few messages; what comes a thousand times a second is read as columns.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from hpid_ros.bags.message_types import jazzy_types
from hpid_ros.bags.storage import Storage
from hpid_ros.bags.topic_names import find_topic
from hpid_ros.errors import BagError

_NS_PER_S = 1_000_000_000

Vector = tuple[float, float, float]
PoseValues = tuple[Vector, tuple[float, float, float, float]]
"""Position in [m] and quaternion x, y, z, w."""


class Stamp(NamedTuple):
    """Header of a message.

    Attributes:
        stamp_ns: In [ns].
        frame: Its ``frame_id``.
    """

    stamp_ns: int
    frame: str


def new(kind: str, **values: Any) -> Any:
    """Return a message of a type by its fields."""
    return jazzy_types().types[kind](**values)


def encoded(kind: str, **values: Any) -> bytes:
    """Return a serialised message of a type by its fields."""
    return bytes(jazzy_types().serialize_cdr(new(kind, **values), kind))


def header_of(stamp: Stamp) -> Any:
    """Return a ``std_msgs/msg/Header``."""
    seconds, rest = divmod(stamp.stamp_ns, _NS_PER_S)
    time = new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
    return new("std_msgs/msg/Header", stamp=time, frame_id=stamp.frame)


def pose_of(pose: PoseValues) -> Any:
    """Return a ``geometry_msgs/msg/Pose``."""
    (x, y, z), (qx, qy, qz, qw) = pose
    return new(
        "geometry_msgs/msg/Pose",
        position=new("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z)),
        orientation=new(
            "geometry_msgs/msg/Quaternion", x=float(qx), y=float(qy), z=float(qz), w=float(qw)
        ),
    )


def vector_of(vector: Vector) -> Any:
    """Return a ``geometry_msgs/msg/Vector3``."""
    x, y, z = vector
    return new("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))


def stamp_ns_of(message: Any) -> int:
    """Return the stamp of a message with a header, in [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def messages_on(bag: Path, topic: str, kind: str) -> list[Any]:
    """Return the messages on a topic in the order of the log; none where it is not there.

    Args:
        bag: The bag.
        topic: Its name; without a leading slash also its last part.
        kind: Its type.

    Raises:
        BagError: The topic has another type, or the bag or a message cannot be read.
    """
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

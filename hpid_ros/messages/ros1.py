"""ROS 1: files of rosbag, and its messages as ROS 2 serialises them.

rosbag's files are read by rosbags, one message after the other; MCAP holds messages of ROS 1, too.
Only types that this package knows are converted: no definition that a file brings is compiled.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hpid_ros.base.errors import BagError, reason_of
from hpid_ros.messages.columns import CONTROLLER_STATE, TopicBatch, TopicInfo, batch_of
from hpid_ros.messages.mcap_file import Advance, Allowance, Report, decompressed_chunk
from hpid_ros.messages.rosbags_internals import bound_chunks

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

_STATE = """
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
"""
"""``control_msgs/JointTrajectoryControllerState`` of ROS 1."""

_DIFFERENT = frozenset(
    {"sensor_msgs/msg/Range", "shape_msgs/msg/SolidPrimitive", "visualization_msgs/msg/Marker"}
)
"""Types with other fields in ROS 2."""

_BATCH_ROWS = 1 << 12
_BATCH_BYTES = 4 << 20


@functools.cache
def _types() -> Typestore:
    """Return the types that are converted; their fields are those of ROS 2 but for the header."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    types.register(get_types_from_msg(_STATE, CONTROLLER_STATE))
    return types


def as_ros2(info: TopicInfo) -> TopicInfo:
    """Return a topic of ROS 1 as it is after the conversion; unchanged where there is none."""
    package, _, name = info.type.partition("/")
    kind = f"{package}/msg/{name.removeprefix('msg/')}"
    if kind in _DIFFERENT or kind not in _types().types:
        return info._replace(type=kind)
    return info._replace(type=kind, encoding="cdr", definition="")


def converted(batch: TopicBatch, kind: str, report: Report) -> TopicBatch:
    """Return messages of ROS 1 in CDR; those that are not of their type are left out."""
    from rosbags.serde import SerdeError

    raws: list[bytes] = []
    kept: list[int] = []
    reason = ""
    convert = _types().ros1_to_cdr
    for index, raw in enumerate(batch.raws()):
        try:
            raws.append(bytes(convert(raw, kind)))
        except (SerdeError, AssertionError, ValueError, IndexError) as error:
            reason = reason or reason_of(error)
        else:
            kept.append(index)
    if reason:
        count = len(batch.starts) - len(kept)
        report(f"{count} messages on {batch.topic} are no {kind} of ROS 1, left out: {reason}")
    return batch_of(batch.topic, raws, batch.log_times_ns[kept], batch.places[kept])


class RosbagFile:
    """A file of rosbag, version 2.0, with its index."""

    def __init__(self, path: Path, report: Report) -> None:
        from rosbags.rosbag1 import Reader

        self._size = path.stat().st_size
        self._reader: Any = Reader(path)
        try:
            self._reader.open()
        # rosbags lets what its reader trips over escape.
        except Exception as error:
            raise BagError(_reason(error)) from error
        allowance = Allowance()
        bound_chunks(self._reader, lambda kind, raw: decompressed_chunk(kind, raw, allowance))
        self._connections: dict[str, list[Connection]] = {}
        for each in self._reader.connections:
            self._connections.setdefault(_full(each.topic), []).append(each)

    def topics(self) -> dict[str, TopicInfo]:
        """Return the topics by full name."""
        return {
            topic: TopicInfo(each[0].msgtype, "ros1", "", "")
            for topic, each in self._connections.items()
        }

    def close(self) -> None:
        if self._reader.bio is not None:
            self._reader.close()

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""
        wanted = [each for name in sorted(topics) for each in self._connections.get(name, ())]
        total, place = max(sum(each.msgcount for each in wanted), 1), 0
        parts: dict[str, list[tuple[int, int, bytes]]] = {}
        size = 0
        try:
            for connection, time_ns, raw in self._reader.messages(wanted) if wanted else ():
                part = parts.setdefault(_full(connection.topic), [])
                part.append((time_ns, place, bytes(raw)))
                place, size = place + 1, size + len(raw)
                if place % _BATCH_ROWS == 0 or size >= _BATCH_BYTES:
                    yield from _batches(parts)
                    parts, size = {}, 0
                    done(self._size * place // total)
        except Exception as error:
            report(f"{place} messages were read, the rest is left out: {_reason(error)}")
        yield from _batches(parts)
        done(self._size)


def _full(topic: str) -> str:
    return f"/{topic.lstrip('/')}"


def _batches(parts: dict[str, list[tuple[int, int, bytes]]]) -> Iterator[TopicBatch]:
    for topic in sorted(parts):
        times, places, raws = zip(*parts[topic], strict=True)
        yield batch_of(topic, raws, np.array(times, np.int64), np.array(places, np.int64))


def _reason(error: Exception) -> str:
    """Return in one line why a file cannot be read, with the remedy where there is one."""
    text = reason_of(error).removeprefix("ReaderError: ")
    text = text.replace("('", "").replace("',)", "")  # it quotes the error that it met
    if "not indexed" in text:
        return "its recorder was stopped by force, the index is missing: rosbag reindex writes it"
    return text

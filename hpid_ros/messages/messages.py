"""Messages of a bag that are read one by one: poses, descriptions, parameter events.

For topics of a few messages; what comes a thousand times a second is read as columns.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import BagError, MessageError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.control.settings import LOOP_PARAMETERS
from hpid_ros.messages.columns import JOINT_STATE
from hpid_ros.messages.joint_state import JointReader, JointSample
from hpid_ros.messages.reading.topic_choice import choose_topics, find_topic, matching
from hpid_ros.messages.reports import (
    ODOMETRY,
    POSES,
    STATUSES,
    VECTOR,
    ParameterEvent,
    Status,
    decode_parameter_event,
    decode_text,
)
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import Retune
from hpid_ros.messages.storage import Storage, opened
from hpid_ros.messages.writer import jazzy_types


def stamp_ns_of(message: Any) -> int:
    """Return the stamp of a message with a header, in [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


class PlanarColumns(NamedTuple):
    """Poses of a base in the plane, as one topic has them."""

    stamps_ns: NDArray[np.int64]  # [ns] ascending, (N,)
    poses: Numbers  # x [m], y [m], heading [rad] (not wrapped), (N, 3)


class PoseColumns(NamedTuple):
    """K poses at N times, as one topic has them."""

    stamps_ns: NDArray[np.int64]  # [ns] ascending, (N,)
    positions: Numbers  # [m] (N, K, 3)
    orientations: Numbers  # quaternions x, y, z, w, (N, K, 4)


class BagMessages:
    """The messages of a bag's topics, each read when it is asked for, some read together."""

    def __init__(self, bag: Path | Storage, *together: str) -> None:
        self._raws: dict[str, list[bytes]] = {}
        with opened(bag) as storage:
            self._bag, self._where = storage.path, f"bag {storage.path}"
            self._known = {name: info.type for name, info in storage.topics().items()}
            names = {name for topic in together for name in matching(topic, self._known)}
            self._read(storage, names)

    def _read(self, storage: Storage, names: Collection[str]) -> None:
        self._raws |= {name: [] for name in names}
        for batch in storage.batches(frozenset(names)) if names else ():
            self._raws[batch.topic] += batch.raws()

    def on(self, topic: str, kind: str) -> list[Any]:
        """Return the messages on a topic in the order of the log; none where it is not there."""
        if not any(name.rpartition("/")[2] == topic.rpartition("/")[2] for name in self._known):
            return []
        name = find_topic(self._where, topic, self._known, (kind,))
        if name not in self._raws:
            with Storage(self._bag) as storage:
                self._read(storage, {name})
        deserialize = jazzy_types().deserialize_cdr
        try:
            return [deserialize(raw, kind) for raw in self._raws[name]]
        # rosbags lets whatever its generated code trips over escape.
        except Exception as error:
            line = f"{self._where}: a message on {name} is no {kind}: {error!r}"
            raise BagError(line) from error

    def planar(self, topic: str) -> PlanarColumns:
        """Return the poses of an odometry topic in the plane."""

        def row(message: Any) -> tuple[float, float, float]:
            p, q = message.pose.pose.position, message.pose.pose.orientation
            heading = np.arctan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
            return p.x, p.y, float(heading)

        stamps_ns, poses = self._rows(topic, ODOMETRY, row)
        poses[:, 2] = np.unwrap(poses[:, 2])
        return PlanarColumns(stamps_ns, poses)

    def vectors(self, topic: str) -> tuple[NDArray[np.int64], Numbers]:
        """Return stamps in [ns], (N,), and x, y, z, (N, 3), of a topic of stamped vectors."""
        return self._rows(
            topic, VECTOR, lambda each: (each.vector.x, each.vector.y, each.vector.z)
        )

    def poses(self, topic: str, kind: str = POSES) -> PoseColumns | None:
        """Return the poses of a topic; None where there is no such topic or nothing on it."""
        rows: dict[int, Numbers] = {}
        for message in self.on(topic, kind):
            poses = message.poses if kind == POSES else [message.pose]
            rows[stamp_ns_of(message)] = np.array([_numbers(pose) for pose in poses]).reshape(
                -1, 7
            )
        if not rows:
            return None
        stamps = sorted(rows)
        if len({len(row) for row in rows.values()}) > 1:
            raise BagError(f"{self._where}: the number of poses on {topic} changes")
        whole = np.array([rows[stamp] for stamp in stamps])
        return PoseColumns(np.array(stamps, dtype=np.int64), whole[..., :3], whole[..., 3:])

    def statuses(self, topic: str) -> list[Status]:
        """Return what a topic of diagnostics says, in the order of the log; nothing without it."""
        return [
            Status(
                stamp_ns_of(message),
                int(status.level),
                status.name,
                status.message,
                {pair.key: pair.value for pair in status.values},
            )
            for message in self.on(topic, STATUSES)
            for status in message.status
        ]

    def _rows(
        self, topic: str, kind: str, row: Callable[[Any], Sequence[float]]
    ) -> tuple[NDArray[np.int64], Numbers]:
        """Return stamps, ascending, and a row for each; of one stamp the last stands."""
        rows = {stamp_ns_of(message): row(message) for message in self.on(topic, kind)}
        if not rows:
            raise BagError(f"{self._where}: no message on {topic}")
        stamps = sorted(rows)
        return np.array(stamps, dtype=np.int64), np.array([rows[stamp] for stamp in stamps])


def _numbers(pose: Any) -> tuple[float, ...]:
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def odometry_topics(bag: Path) -> list[str]:
    with Storage(bag) as storage:
        return [name for name, info in storage.topics().items() if info.type == ODOMETRY]


def measures_velocity(path: Path, joint: str) -> bool:
    """Return whether the first state of a joint in a bag has a velocity."""
    for _, sample in _joint_samples(path, [joint]):
        return sample.velocity is not None
    return False


def read_velocities(path: Path, joints: Sequence[str]) -> dict[str, dict[int, float]]:
    """Return the finite velocities of joints in a bag, in [rad/s], by the stamp of the state."""
    found: dict[str, dict[int, float]] = {joint: {} for joint in joints}
    for joint, sample in _joint_samples(path, joints):
        if sample.velocity is not None and math.isfinite(sample.velocity):
            found[joint][sample.stamp_ns] = sample.velocity
    return found


def _joint_samples(path: Path, joints: Sequence[str]) -> Iterator[tuple[str, JointSample]]:
    readers = [JointReader(joint) for joint in joints]
    with Storage(path) as bag:
        types = {name: info.type for name, info in bag.topics().items()}
        states = choose_topics(f"bag {path}", types, BagSelection()).states
        for batch in bag.batches(frozenset(states)):
            for raw in batch.raws():
                for reader in readers:
                    with suppress(MessageError):
                        sample = reader.read(raw)
                        if sample is not None:
                            yield reader.joint, sample


TEXT = "std_msgs/msg/String"
_DESCRIPTION = "robot_description"


def read_robot_descriptions(
    bag: Path | Storage, namespace: str | None = None
) -> list[tuple[str, str]]:
    """Return the last text on each topic ``robot_description``, with the topic; often none."""
    only = (
        None if namespace is None else f"/{namespace.strip('/')}/{_DESCRIPTION}".replace("//", "/")
    )
    found: dict[str, str] = {}
    with opened(bag) as storage:
        topics = frozenset(
            name
            for name, info in storage.topics().items()
            if info.type == TEXT
            and name.rpartition("/")[2] == _DESCRIPTION
            and only in (None, name)
        )
        for batch in storage.batches(topics) if topics else ():
            for raw in batch.raws():
                with suppress(MessageError):
                    found[batch.topic] = decode_text(raw)
    return sorted(found.items())


PARAMETER_EVENTS = "rcl_interfaces/msg/ParameterEvent"


def parameter_events(bag: Storage) -> list[tuple[int, ParameterEvent]]:
    """Return the parameter events of all nodes of a bag, each with its place, in their order."""
    topics = bag.topics()
    names = frozenset(name for name, each in topics.items() if each.type == PARAMETER_EVENTS)
    events = []
    for batch in bag.batches(names) if names else ():
        for _, place, raw in batch.messages():
            event = read_event(raw)
            if event is not None:
                events.append((place, event))
    return sorted(events, key=lambda each: each[0])


def read_event(raw: bytes) -> ParameterEvent | None:
    """Return a serialised event; None for bytes that are none."""
    try:
        return decode_parameter_event(raw)
    except MessageError:
        return None


_HEADER = 12  # bytes of an encapsulation header and a stamp


def read_retunes(path: Path | Storage) -> tuple[Retune, ...]:
    """Return what was set at controllers that ran, each with the state before it."""
    with opened(path) as bag:
        topics = bag.topics()
        states = [name for name, topic in topics.items() if topic.type == JOINT_STATE]
        states = [name for name in states if name.endswith("joint_states")]
        events = parameter_events(bag) if states else []
        if not events:
            return ()
        stamps = _stamps_before([place for place, _ in events], bag, states[0])
    retunes = []
    for (_, event), stamp_ns in zip(events, stamps, strict=True):
        texts = [f"{k} = {_shown(v)}" for k, v in event.changed.items() if k in LOOP_PARAMETERS]
        if texts and stamp_ns is not None:
            retunes.append(Retune(stamp_ns, event.node, ", ".join(texts)))
    return tuple(retunes)


def _stamps_before(places: Sequence[int], bag: Storage, states: str) -> list[int | None]:
    """Return for each place the stamp of the last state before it, None if there is none."""
    stamps: list[int | None] = [None] * len(places)
    for batch in bag.batches(frozenset((states,))):  # their places ascend
        before = np.searchsorted(batch.places, places) - 1
        for number, index in enumerate(before.tolist()):
            if index >= 0 and batch.sizes[index] >= _HEADER:
                raw = batch.raw(index)  # it begins with a header, which begins with the stamp
                seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
                stamps[number] = int(seconds) * NANOSECONDS + int(nanoseconds)
    return stamps


def _shown(value: Any) -> str:
    if value is None:
        return "unset"
    return f"{value:g}" if isinstance(value, float) else str(value)

"""Bags written, and bags repaired: whatever can be read of one that was cut off or damaged."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hpid_ros.base.errors import BagError, HpidError, ResultExistsError, unknown_name
from hpid_ros.base.files import finished_folder
from hpid_ros.messages.columns import JOINT_TRAJECTORY, TopicBatch
from hpid_ros.messages.storage import Progress, Storage, no_progress

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos
    from rosbags.typesys.store import Typestore
    from typing_extensions import Self


@functools.cache
def jazzy_types() -> Typestore:
    """Return Jazzy's message definitions; building them takes some 50 ms, once."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


_MAX_TIME_NS = 2**63


class TopicQos(NamedTuple):
    """Offered quality of service of a recorded topic, so that a replay offers the same."""

    reliable: bool = True  # reliable if True, best effort if False
    transient_local: bool = False  # the last message reaches late subscribers; volatile if False
    depth: int = 10  # messages kept (keep last)


class BagTopic(NamedTuple):
    """A topic of an open bag; :meth:`BagWriter.write` takes it."""

    name: str  # the topic's name
    type: str  # its type, for instance "sensor_msgs/msg/JointState"
    connection: Connection  # the same in the words of rosbags


class BagWriter:
    """A new bag folder with one MCAP file (rosbag2 version 9, Jazzy's message definitions).

    Messages are taken as they came off the wire. What has been written is in the file after half
    a second of log time or 1 MiB, whichever comes first, or after :meth:`flush`. Leaving the
    ``with`` block finishes the bag in any case, also when the block raised. Not safe to share
    between threads.

    Args:
        path: The folder to create, parents included.
        metadata: Free text by name, kept in the bag's ``custom_data``.

    Raises:
        ResultExistsError: If the path exists; nothing is touched.
        BagError: If the folder cannot be written.
    """

    def __init__(self, path: Path | str, *, metadata: Mapping[str, str] | None = None) -> None:
        self.path = Path(path)
        self._topics: list[BagTopic] = []
        self._failure: str | None = None
        self._is_gone = False
        self._is_closed = False
        from rosbags.rosbag2 import WriterError

        from hpid_ros.messages.rosbags_internals import FlushingWriter

        self._refusal = WriterError
        try:
            self._writer = FlushingWriter(self.path)
            for name, text in (metadata or {}).items():
                self.describe(name, text)
            self._writer.open()
        except WriterError as error:
            if self.path.exists():
                raise ResultExistsError(
                    f"bag {self.path} exists already, nothing is overwritten"
                ) from error
            raise BagError(f"cannot create bag {self.path}: {error}") from error
        except OSError as error:
            raise BagError(f"cannot create bag {self.path}: {error.strerror or error}") from error

    def describe(self, name: str, text: str) -> None:
        """Add an entry to the bag's metadata, which is written when the bag is closed.

        Args:
            name: Its name; an entry of that name is replaced.
            text: What it says.
        """
        self._writer.set_custom_data(name, text)

    @property
    def counts(self) -> dict[str, int]:
        """Messages taken so far, by topic; after a failure or closing, those in the file."""
        counts = self._writer.counts
        return {topic.name: counts[topic.connection.id] for topic in self._topics}

    def add_topic(
        self,
        name: str,
        type: str,
        qos: TopicQos | str | None = None,
        definition: str | None = None,
    ) -> BagTopic:
        """Add a topic.

        Args:
            name: Its name, with the leading slash as ROS 2 resolves it.
            type: A type of ROS 2 Jazzy, for instance ``"sensor_msgs/msg/JointState"``.
            qos: What its publisher offers; reliable and volatile if not given. Or the profiles as
                another bag holds them, in YAML.
            definition: The type's definition as another bag holds it, for types that Jazzy
                lacks; empty where that has none.

        Raises:
            BagError: If the type is unknown, the topic is there already or the bag is closed.
        """
        self._check_open()
        types = jazzy_types()
        if type not in types.types and definition is None:
            raise BagError(f"bag {self.path}: {unknown_name('message type', type, types.types)}")
        if any(topic.name == name for topic in self._topics):
            raise BagError(f"bag {self.path}: topic {name!r} was added before")
        connection = self._writer.add_connection(
            name,
            type,
            typestore=types,
            # The hash of a foreign type is not known here; readers do not need it.
            **({} if type in types.types else {"msgdef": definition or "", "rihs01": "unknown"}),
            offered_qos_profiles=_profiles(qos),
        )
        self._topics.append(topic := BagTopic(name, type, connection))
        return topic

    def write(self, topic: BagTopic, log_time_ns: int, raw: bytes) -> None:
        """Write one message.

        Args:
            topic: What :meth:`add_topic` returned.
            log_time_ns: When it was received, in [ns], not negative.
            raw: The serialised message with its CDR header.

        Raises:
            BagError: If the bag is closed, the disk is full, the time is negative or the topic is
                another bag's. After a full disk every further call raises, and closing keeps all
                that had reached the file.
        """
        if self._failure is not None or not 0 <= log_time_ns < _MAX_TIME_NS:
            self._check_open()
            raise BagError(
                f"bag {self.path}: log time {log_time_ns} ns of {topic.name} is not in [0, 2^63)"
            )
        try:
            self._writer.write(topic.connection, log_time_ns, raw)
        except OSError as error:
            raise self._fail(error) from error
        except self._refusal as error:
            self._check_open()
            raise BagError(f"bag {self.path}: {topic.name} is no topic of it") from error

    def flush(self) -> None:
        """Hand everything that was written to the operating system, for instance when idle.

        Raises:
            BagError: If the bag is closed, the disk is full, or the file is no longer where it
                was made: what goes on being written to a deleted file is lost with the process.
        """
        self._check_open()
        mcap = self._writer.mcap
        if mcap is None:
            return
        try:
            mcap.flush()
            self._is_gone = not mcap.is_in_place()
        except OSError as error:
            raise self._fail(error) from error
        if self._is_gone:
            self._failure = "is gone: it was deleted, moved or replaced while it was written"
            self._check_open()

    def close(self) -> None:
        """Write all that is left, the index and ``metadata.yaml``; does nothing the second time.

        Raises:
            BagError: If that fails. Without its index the bag cannot be opened.
        """
        if self._is_closed:
            return
        self._is_closed = True
        try:
            if self._failure is None:
                self.flush()
        finally:
            self._finish()
            self._failure = self._failure or "is closed"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if error is None:
            self.close()
        else:
            # The error that ended the block says more than a bag that could not be finished.
            with suppress(BagError):
                self.close()

    def _finish(self) -> None:
        if self._is_gone:
            # Whatever is at the path now is somebody else's. A bag that was moved is as after
            # kill -9: without index, and repairable.
            self._writer.abort()
            return
        try:
            self._writer.close()
        except (OSError, ValueError) as error:  # of a file that a failure has closed
            with suppress(OSError, ValueError):
                if (mcap := self._writer.mcap) is not None:
                    mcap.abort()
            reason = getattr(error, "strerror", None) or error
            raise BagError(f"cannot finish bag {self.path}: {reason}") from error

    def _fail(self, error: OSError) -> BagError:
        self._failure = f"cannot be written: {error.strerror or error}"
        self._writer.count_what_is_stored()
        return BagError(f"bag {self.path} {self._failure}")

    def _check_open(self) -> None:
        if self._failure is not None:
            raise BagError(f"bag {self.path} {self._failure}")


def _profiles(qos: TopicQos | str | None) -> list[Qos]:
    """Return offered profiles in the words of rosbags."""
    from hpid_ros.messages.rosbags_internals import recorded_qos

    if isinstance(qos, str):
        return recorded_qos(qos) or [_rosbags_qos(TopicQos())]
    return [_rosbags_qos(qos or TopicQos())]


def _rosbags_qos(qos: TopicQos) -> Qos:
    """Return the profile in the words of rosbags."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    # RMW_DURATION_INFINITE, as rosbag2 writes an unset deadline, lifespan or lease.
    forever = QosTime(9_223_372_036, 854_775_807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=qos.depth,
        reliability=QosReliability.RELIABLE if qos.reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL
        if qos.transient_local
        else QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


_LATCHED = TopicQos(transient_local=True, depth=1)


@dataclass(frozen=True)
class Repair:
    """What came of a repair."""

    target: Path  # the folder that was written
    saved: dict[str, int]  # messages in it, by topic
    span_ns: tuple[int, int] | None  # [ns] first and last log time in it; None without messages
    unreadable: tuple[str, ...]  # a line for each thing of the old bag that could not be read


def repair_bag(source: Path, target: Path, progress: Progress | None = None) -> Repair:
    """Write what can be read of a bag into a new one, with index and ``metadata.yaml``.

    The old bag is only read. Messages keep their bytes, their log times and their order. The new
    one gets its name when it is whole.
    """
    with Storage(source) as storage:
        if not storage.topics():
            reasons = "; ".join(storage.unreadable) or "it has no topic"
            raise BagError(f"nothing of bag {source} can be read ({reasons})")
        if storage.is_of_ros1:
            raise BagError(
                f"bag {source} is of ROS 1: rosbags-convert --src {source.name} --dst NEW_BAG "
                "makes one of ROS 2 of it"
            )
        try:
            with finished_folder(target) as place:
                saved = _rewrite(storage, place, target, progress or no_progress)
        except HpidError:  # one of them is an OSError, too
            raise
        except FileExistsError:
            raise ResultExistsError(
                f"bag {target} exists already, nothing is overwritten"
            ) from None
        except OSError as error:
            reason = error.strerror or error
            raise BagError(f"cannot repair bag {source} into {target}: {reason}") from None
    return replace(saved, target=target)


def _rewrite(storage: Storage, place: Path, target: Path, progress: Progress) -> Repair:
    """Write what can be read of an open bag into a new one, which is going to be the target."""
    try:
        return _rewritten(storage, place, progress)
    except BagError as error:  # about what the person has named
        raise BagError(str(error).replace(str(place), str(target))) from None


def _rewritten(storage: Storage, place: Path, progress: Progress) -> Repair:
    """Write what can be read of an open bag into a new one."""
    span_ns: tuple[int, int] | None = None
    impossible, topics = 0, storage.topics()
    with BagWriter(place, metadata=storage.custom_data) as writer:
        handles: dict[str, BagTopic] = {}
        for name, info in sorted(topics.items()):
            qos = info.qos or (_LATCHED if info.type == JOINT_TRAJECTORY else None)
            handles[name] = writer.add_topic(name, info.type, qos, info.definition)
        batches = storage.batches(frozenset(topics), progress)
        for _, topic, time_ns, raw in _in_order(batches):
            if time_ns < 0:
                impossible += 1
                continue
            writer.write(handles[topic], time_ns, raw)
            first, last = span_ns or (time_ns, time_ns)
            span_ns = min(first, time_ns), max(last, time_ns)
    lost = list(storage.unreadable)
    if impossible:
        lost.append(f"{impossible} messages with a negative time")
    return Repair(place, writer.counts, span_ns, tuple(lost))


def _in_order(batches: Iterable[TopicBatch]) -> Iterator[tuple[int, str, int, bytes]]:
    """Yield place, topic, log time and bytes of messages as the files held them.

    One part of a file comes as a batch for each of its topics, in the order of their names; a
    topic that is not after the one before it begins the next part.
    """
    part: list[tuple[int, str, int, bytes]] = []
    before = ""
    for batch in batches:
        if batch.topic <= before:
            yield from sorted(part)
            part = []
        before = batch.topic
        part += [(place, batch.topic, time_ns, raw) for time_ns, place, raw in batch.messages()]
    yield from sorted(part)

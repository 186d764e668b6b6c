"""Bags written, and bags repaired: whatever can be read of one that was cut off or damaged."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hpid_ros.base.errors import BagError, HpidError, ResultExistsError, unknown_name
from hpid_ros.base.files import finished_folder, write_file
from hpid_ros.base.yaml_files import parse_yaml
from hpid_ros.base.yaml_text import dump_yaml
from hpid_ros.messages.columns import JOINT_TRAJECTORY, TopicBatch
from hpid_ros.messages.storage import ReadingProgress, Storage, no_progress

if TYPE_CHECKING:
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
    channel: int  # its number in the file


class _Recorded(NamedTuple):
    """What ``metadata.yaml`` says of a topic besides its name and type."""

    qos: list[dict[str, Any]]  # offered profiles
    hash: str  # of the type


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
        # A library that is missing is named before anything is created.
        jazzy_types()
        from hpid_ros.messages.mcap_writer import McapWriter

        self.path = Path(path)
        self._metadata = dict(metadata or {})
        self._topics: list[BagTopic] = []
        self._recorded: list[_Recorded] = []
        self._failure: str | None = None
        self._is_gone = False
        self._is_closed = False
        try:
            self.path.mkdir(parents=True)
            self._file = McapWriter(self.path / f"{self.path.name}.mcap")
        except FileExistsError as error:
            raise ResultExistsError(
                f"bag {self.path} exists already, nothing is overwritten"
            ) from error
        except OSError as error:
            raise BagError(f"cannot create bag {self.path}: {error.strerror or error}") from error

    def describe(self, name: str, text: str) -> None:
        """Add an entry to the bag's metadata, which is written when the bag is closed.

        Args:
            name: Its name; an entry of that name is replaced.
            text: What it says.
        """
        self._metadata[name] = text

    @property
    def counts(self) -> dict[str, int]:
        """Messages taken so far, by topic; after a failure or closing, those in the file."""
        return {topic.name: self._file.counts[topic.channel] for topic in self._topics}

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
        if type in types.types:
            definition, _ = types.generate_msgdef(type, ros_version=2)
            type_hash = types.hash_rihs01(type)
        else:
            type_hash = "unknown"  # of a foreign type; readers do not need it
        recorded = _Recorded(_profiles(qos), type_hash)
        profiles = dump_yaml(recorded.qos).strip()
        channel = self._file.add_channel(name, type, definition or "", profiles)
        topic = BagTopic(name, type, channel)
        self._topics.append(topic)
        self._recorded.append(recorded)
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
        if not self._has(topic):
            raise BagError(f"bag {self.path}: {topic.name} is no topic of it")
        try:
            self._file.write(topic.channel, log_time_ns, raw)
        except OSError as error:
            raise self._fail(error) from error

    def flush(self) -> None:
        """Hand everything that was written to the operating system, for instance when idle.

        Raises:
            BagError: If the bag is closed, the disk is full, or the file is no longer where it
                was made: what goes on being written to a deleted file is lost with the process.
        """
        self._check_open()
        try:
            self._file.flush()
            self._is_gone = not self._file.is_in_place()
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
            self._file.abort()
            return
        try:
            information = self._information()
            self._file.finish(dump_yaml(information, may_have_nul=True).strip())
            document = {"rosbag2_bagfile_information": information}
            text = dump_yaml(document, may_have_nul=True)
            write_file(self.path / "metadata.yaml", text)
        except (OSError, ValueError) as error:  # of a file that a failure has closed
            with suppress(OSError, ValueError):
                self._file.abort()
            reason = getattr(error, "strerror", None) or error
            raise BagError(f"cannot finish bag {self.path}: {reason}") from error

    def _information(self) -> dict[str, Any]:
        """Return what rosbag2 keeps of a bag, version 9 of it."""
        start_ns, counts = self._file.start_ns, self.counts
        extent = {
            "duration": {"nanoseconds": max(0, self._file.end_ns - start_ns)},
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "message_count": sum(counts.values()),
        }
        file = f"{self.path.name}.mcap"
        topics = [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": recorded.qos,
                    "type_description_hash": recorded.hash,
                },
                "message_count": counts[topic.name],
            }
            for topic, recorded in zip(self._topics, self._recorded, strict=True)
        ]
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [file],
            **extent,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": file, **extent}],
            "custom_data": self._metadata or None,
            "ros_distro": "jazzy",  # whose message definitions these are
        }

    def _fail(self, error: OSError) -> BagError:
        self._failure = f"cannot be written: {error.strerror or error}"
        return BagError(f"bag {self.path} {self._failure}")

    def _has(self, topic: BagTopic) -> bool:
        place = topic.channel - 1
        return place < len(self._topics) and self._topics[place] is topic

    def _check_open(self) -> None:
        if self._failure is not None:
            raise BagError(f"bag {self.path} {self._failure}")


_POLICIES: Mapping[str, Sequence[str]] = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": (
        "system_default",
        "automatic",
        "manual_by_node",
        "manual_by_topic",
        "unknown",
        "best_available",
    ),
}
"""The names of rmw's policies in the order of their numbers, which bags before version 9 have."""
_DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")
# RMW_DURATION_INFINITE, as rosbag2 writes an unset deadline, lifespan or lease.
_FOREVER = {"sec": 9_223_372_036, "nsec": 854_775_807}


def _profiles(qos: TopicQos | str | None) -> list[dict[str, Any]]:
    """Return offered profiles as ``metadata.yaml`` has them."""
    if isinstance(qos, str):
        return _recorded_profiles(qos) or [_profile(TopicQos())]
    return [_profile(qos or TopicQos())]


def _profile(qos: TopicQos) -> dict[str, Any]:
    return {
        "history": "keep_last",
        "depth": qos.depth,
        "reliability": "reliable" if qos.reliable else "best_effort",
        "durability": "transient_local" if qos.transient_local else "volatile",
        "deadline": _FOREVER,
        "lifespan": _FOREVER,
        "liveliness": "automatic",
        "liveliness_lease_duration": _FOREVER,
        "avoid_ros_namespace_conventions": False,
    }


def _recorded_profiles(text: str) -> list[dict[str, Any]]:
    """Return offered profiles from their YAML; none if it cannot be read."""
    with suppress(BagError, LookupError, TypeError, ValueError, OverflowError):
        return [_recorded_profile(each) for each in parse_yaml("profiles", text, BagError) or ()]
    return []


def _recorded_profile(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Return a profile of another bag, its policies by their names."""
    return {
        **{key: _policy(names, recorded[key]) for key, names in _POLICIES.items()},
        **{key: {part: int(recorded[key][part]) for part in _FOREVER} for key in _DURATIONS},
        "depth": int(recorded["depth"]),
        "avoid_ros_namespace_conventions": bool(recorded["avoid_ros_namespace_conventions"]),
    }


def _policy(names: Sequence[str], recorded: object) -> str:
    """Return a policy's name, which bags have as a number or in words."""
    if isinstance(recorded, int):
        return names[recorded] if 0 <= recorded < len(names) else "unknown"
    name = str(recorded).lower()
    return name if name in names else "unknown"


_LATCHED = TopicQos(transient_local=True, depth=1)


@dataclass(frozen=True)
class Repair:
    """What came of a repair."""

    target: Path  # the folder that was written
    saved: dict[str, int]  # messages in it, by topic
    span_ns: tuple[int, int] | None  # [ns] first and last log time in it; None without messages
    unreadable: tuple[str, ...]  # a line for each thing of the old bag that could not be read


def repair_bag(source: Path, target: Path, progress: ReadingProgress | None = None) -> Repair:
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


def _rewrite(storage: Storage, place: Path, target: Path, progress: ReadingProgress) -> Repair:
    """Write what can be read of an open bag into a new one, which is going to be the target."""
    try:
        return _rewritten(storage, place, progress)
    except BagError as error:  # about what the person has named
        raise BagError(str(error).replace(str(place), str(target))) from None


def _rewritten(storage: Storage, place: Path, progress: ReadingProgress) -> Repair:
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

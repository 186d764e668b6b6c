"""A bag that was cut off or damaged, written anew with everything in it that can be read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from hpid_ros.bags.columns.batches import TopicBatch
from hpid_ros.bags.columns.storage import Progress, Storage
from hpid_ros.bags.message_types import JOINT_TRAJECTORY
from hpid_ros.bags.writer import BagTopic, BagWriter, TopicQos
from hpid_ros.base.errors import BagError

_LATCHED = TopicQos(transient_local=True, depth=1)


@dataclass(frozen=True)
class Repair:
    """What came of a repair."""

    target: Path  # the folder that was written
    saved: dict[str, int]  # messages in it, by topic
    span_ns: tuple[int, int] | None  # [ns] first and last log time in it; None without messages
    unreadable: tuple[str, ...]  # a line for each thing of the old bag that could not be read


class _Message(NamedTuple):
    place: int
    topic: str
    log_time_ns: int
    raw: bytes


def repair_bag(source: Path, target: Path, progress: Progress | None = None) -> Repair:
    """Write what can be read of a bag into a new one, with index and ``metadata.yaml``.

    The old bag is only read. Messages keep their bytes, their log times and their order.
    """
    saved: dict[str, int] = {}
    span_ns: tuple[int, int] | None = None
    with Storage(source) as storage:
        topics = storage.topics()
        if not topics:
            reasons = "; ".join(storage.unreadable) or "it has no topic"
            raise BagError(f"nothing of bag {source} can be read ({reasons})")
        with BagWriter(target, metadata=storage.custom_data) as writer:
            handles: dict[str, BagTopic] = {}
            for name, info in sorted(topics.items()):
                qos = _LATCHED if info.type == JOINT_TRAJECTORY else None
                handles[name] = writer.add_topic(name, info.type, qos, info.definition)
            batches = storage.batches(frozenset(topics), progress or (lambda share: None))
            for message in _in_order(batches):
                writer.write(handles[message.topic], message.log_time_ns, message.raw)
                time_ns = message.log_time_ns
                first, last = span_ns or (time_ns, time_ns)
                span_ns = min(first, time_ns), max(last, time_ns)
        saved = writer.counts
        return Repair(target, saved, span_ns, tuple(storage.unreadable))


def _in_order(batches: Iterable[TopicBatch]) -> Iterator[_Message]:
    """Yield messages as the files held them.

    One part of a file comes as a batch for each of its topics, in the order of their names; a
    topic that is not after the one before it begins the next part.
    """
    part: list[_Message] = []
    before = ""
    for batch in batches:
        if batch.topic <= before:
            yield from sorted(part)
            part = []
        before = batch.topic
        part.extend(
            _Message(place, batch.topic, log_time_ns, batch.raw(index))
            for index, (place, log_time_ns) in enumerate(
                zip(batch.places.tolist(), batch.log_times_ns.tolist(), strict=True)
            )
        )
    yield from sorted(part)

"""Records topics into an MCAP bag: raw bytes, straight from the subscription into the file.

What it cannot keep up with is not dropped in silence. It keeps all that it has received (a
subscription that keeps the last N overwrites without a word, and the events executor may never be
notified again afterwards), so what is lost is lost at the publishers, which the middleware
reports: the counts stand in the bag's metadata, in ``/diagnostics`` and in the log.
"""

from __future__ import annotations

import importlib
import re
import shutil
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.validate_topic_name import validate_topic_name

from hpid_ros.base.errors import BagError, HpidError, SettingError
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.base.yaml_text import dump_yaml
from hpid_ros.control.parameter_files import settings_from_parameters
from hpid_ros.messages.metadata import CONTROLLERS_ENTRY, missed_entries, slides_entry
from hpid_ros.messages.writer import BagTopic, BagWriter, TopicQos
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.middleware import OFFERED, steady_timer
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.core.status import ERROR, OK, WARN, Diagnostics, StatusPipe
from hpid_ros.nodes.core.waiting import PUBLISHER, Wait, Waiting, described, topic_view

_LOOK_PERIOD = 0.02  # [s]
_REPORT_PERIOD = 0.05  # [s]
_DIAGNOSTICS_PERIOD = 1.0  # [s]
_AT_ONCE = 64  # messages
_LATCHED_WITHIN = 2.0  # [s] for a latched message; its topic may have none
_STANDSTILL = 2.0  # [s] between two reports: well below the lease after which nobody counts
_SELDOM = frozenset(("/parameter_events", "/rosout"))  # topics that may well stay empty
_MESSAGE_TYPE = re.compile(r"([A-Za-z]\w*)/msg/([A-Za-z]\w*)", re.ASCII)


@dataclass(frozen=True)
class RecorderParameters(Record):
    """What is recorded, and where."""

    bag: str = quantity("Folder of the bag to create", default="")
    topics: tuple[str, ...] = quantity(
        "Topics to record, subscribed in this order",
        default=("/parameter_events", "joint_trajectory", "joint_commands", "joint_states"),
    )
    controllers_file: str = quantity(
        "Parameter file of the controllers, kept in the bag so that hpid replay finds it",
        default="",
    )
    slides: tuple[str, ...] | None = quantity(
        "Joints that slide, noted in the bag so that their numbers are in m and N", default=None
    )


class BagRecorder(executor.ClosingNode):
    """Records a list of topics as soon as each has a publisher.

    Topics are subscribed in the order of the list, each after the one before: with the states
    last, a subscriber of the states means that all that answers them is recorded.
    The last waits for the latched messages of the others, 2 s at most: a reference that began
    before the first state stands before it in the bag.

    Topics of joint states in ``handed`` are not subscribed: this process has them (:meth:`keep`).
    """

    def __init__(self, handed: Collection[str] = ()) -> None:
        super().__init__("bag_recorder")
        asked = read(self, RecorderParameters)
        path, topics = asked.bag, asked.topics
        if not path or not topics:
            raise SettingError("the parameters bag and topics must name a new folder and topics")
        for topic in topics:
            validate_topic_name(topic)
        self._status = StatusPipe(self)
        self._waiting = [self.resolve_topic_name(topic) for topic in topics]
        if len(set(self._waiting)) != len(self._waiting):
            raise SettingError(f"topics must name each topic once, not {', '.join(topics)}")
        metadata = _controllers(asked.controllers_file) | slides_entry(asked.slides or ())
        self._writer = BagWriter(path, metadata=metadata)
        self._failure = ""
        self._missed: dict[str, int] = {}
        self._latched: list[str] = []
        self._looked = self._subscribed = time.monotonic()
        self._stood_still = 0.0  # [s]
        self._reported: tuple[dict[str, int], dict[str, int]] = ({}, {})
        self._diagnostics = Diagnostics(self, path)
        self.is_recording = False
        self._kept: list[tuple[str, int, bytes]] = []
        self._handed = {
            topic: self._add(topic, "sensor_msgs/msg/JointState", is_reliable=True)
            for topic in self._waiting
            if topic in handed
        }
        self._waiting = [topic for topic in self._waiting if topic not in handed]
        self._look = steady_timer(self, _LOOK_PERIOD, self._subscribe_next)
        waiting = Waiting(self)
        waiting.add(self._awaited)
        waiting.add(self._awaited_messages)
        waiting.begin()
        steady_timer(self, _REPORT_PERIOD, self._report)
        steady_timer(self, _DIAGNOSTICS_PERIOD, self._diagnose)

    def _subscribe_next(self) -> None:
        while self._waiting and not self._failure:
            topic = self._waiting[0]
            publishers = self.get_publishers_info_by_topic(topic)
            is_last = len(self._waiting) == 1 and not self._handed
            if not publishers or (is_last and self._waits_for_latched()):
                return
            try:
                self._record(topic, publishers)
            except HpidError as error:
                return self._fail(error)
            del self._waiting[0]
            # Importing a type takes long on a busy machine.
            self._looked = self._subscribed = time.monotonic()
        if self._handed and self._waits_for_latched():
            return  # those that are handed over are the last
        self._look.cancel()
        self.is_recording = True
        self._status.send("recording")

    def _awaited(self) -> Wait | None:
        """Return the topic whose publisher the bag waits for, for the log."""
        if self._failure or not self._waiting:
            return None
        topic, rest = self._waiting[0], self._waiting[1:]
        found = partial(self._found, topic, rest)
        return Wait(f"a publisher of {topic}", "is there", topic, found)

    def _found(self, topic: str, rest: Sequence[str], _: Sequence[str]) -> str:
        line = described(topic_view(self, topic, PUBLISHER))
        return f"{line}; only then are recorded: {', '.join(rest)}" if rest else line

    def _awaited_messages(self) -> Wait | None:
        """Return the topics that are recorded and empty, for the log."""
        empty = [topic for topic, count in self._writer.counts.items() if not count]
        topics = sorted({*empty} - _SELDOM)
        if self._failure or self._waiting or not topics:
            return None
        return Wait("the first message", "has come", "", self._messages_found, tuple(topics))

    def _messages_found(self, topics: Sequence[str]) -> str:
        return "; ".join(described(topic_view(self, topic, PUBLISHER)) for topic in topics)

    def keep(self, topic: str, raw: bytes) -> None:
        """Record a message of a topic that is handed over, if it is to be recorded.

        Some at a time: one after the other goes three times as fast as each between others' work.
        """
        self._kept.append((topic, time.time_ns(), raw))
        if len(self._kept) >= _AT_ONCE:
            self._write_kept()

    def _write_kept(self) -> None:
        kept, self._kept = self._kept, []
        for topic, log_time_ns, raw in kept:
            if topic in self._handed and not self._failure:
                self._try(partial(self._writer.write, self._handed[topic], log_time_ns, raw))

    def _waits_for_latched(self) -> bool:
        """Return whether the message of a latched topic may still be on its way."""
        counts = self._writer.counts
        is_awaited = not all(counts[topic] for topic in self._latched)
        return is_awaited and time.monotonic() < self._subscribed + _LATCHED_WITHIN

    def _record(self, topic: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        type_name = publishers[0].topic_type
        qos = _matching(publishers)
        is_latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        is_reliable = qos.reliability == ReliabilityPolicy.RELIABLE
        handle = self._add(topic, type_name, is_reliable=is_reliable, is_latched=is_latched)
        if is_latched:
            self._latched.append(topic)
        self.create_subscription(
            _message_class(type_name),
            topic,
            partial(self._write, handle),
            qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(message_lost=partial(self._miss, topic)),
        )
        self.get_logger().info(f"recording {topic} [{type_name}]")

    def _add(
        self, topic: str, type_name: str, *, is_reliable: bool, is_latched: bool = False
    ) -> BagTopic:
        self._missed[topic] = 0
        # The graph does not say a publisher's depth; this is what those of a run have.
        qos = TopicQos(is_reliable, is_latched, depth=OFFERED.depth)
        return self._writer.add_topic(topic, type_name, qos)

    def _miss(self, topic: str, event: Any) -> None:
        """Take from the middleware how many messages never came."""
        self._missed[topic] = event.total_count

    def _write(self, handle: BagTopic, raw: bytes) -> None:
        if not self._failure:
            self._try(partial(self._writer.write, handle, time.time_ns(), raw))

    def _try(self, action: Callable[[], None]) -> None:
        """Write to the bag; the first failure is reported once and ends the process."""
        try:
            action()
        except BagError as error:
            self._fail(error)

    def _fail(self, error: HpidError) -> None:
        if self._failure:
            return
        self._failure = str(error)
        self.get_logger().error(self._failure)
        self._status.send("failed", reason=self._failure)
        self._diagnose()
        self.request_stop(executor.FAILED)

    def _report(self) -> None:
        """Put what is waiting into the file, and only then report that it is recorded.

        Also while nothing comes: a bag that was deleted is found out at once.
        """
        if self._failure:
            return
        self._look_at_clock()
        self._write_kept()
        counts, missed = self._writer.counts, dict(self._missed)
        self._try(self._writer.flush)
        if self._failure or (counts, missed) == self._reported:
            return
        if missed != self._reported[1] and any(missed.values()):
            self.get_logger().warning(
                f"missed {_listed(missed)}: this process was frozen or too slow",
                throttle_duration_sec=1.0,
            )
        self._reported = counts, missed
        self._status.send("recorded", counts=counts, missed=_positive(missed))

    def _look_at_clock(self) -> None:
        """Notice that this process was stopped, or blocked by its disk."""
        now = time.monotonic()
        gap, self._looked = now - self._looked, now
        if gap > _STANDSTILL:
            self._stood_still += gap
            self.get_logger().warning(
                f"stood still for {gap:.1f} s: what was published meanwhile may be missing"
            )
            self._status.send("stood_still", duration=gap)

    def _diagnose(self) -> None:
        counts = self._writer.counts
        values: dict[str, object] = {}
        for topic in counts:
            values |= {f"recorded {topic}": counts[topic], f"missed {topic}": self._missed[topic]}
        if self._failure:
            level, message = ERROR, self._failure
        elif missed := _positive(self._missed):
            level, message = WARN, f"missed {_listed(missed)}"
        elif self._stood_still:
            level, message = WARN, f"stood still for {self._stood_still:.1f} s"
        elif self._waiting:
            level, message = OK, f"waiting for a publisher of {self._waiting[0]}"
        else:
            level, message = OK, "recording"
        self._diagnostics.publish(level, message, values)

    def destroy_node(self) -> None:
        """Leave no folder in the way of the next start where this one was refused."""
        super().destroy_node()
        if self.supervisor is None and not any(self._writer.counts.values()):
            shutil.rmtree(self._writer.path, ignore_errors=True)

    def close(self) -> None:
        """Finish the bag, and say what is in it and what is not."""
        self._write_kept()
        for name, text in missed_entries(self._missed, self._stood_still).items():
            self._writer.describe(name, text)
        self._try(self._writer.close)
        if self._failure:
            return
        counts = self._writer.counts
        each = ", ".join(f"{count} on {topic}" for topic, count in counts.items())
        line = f"recorded {each or 'nothing'}"
        if self._stood_still:
            line += f"; stood still for {self._stood_still:.1f} s"
        if any(self._missed.values()) or self._stood_still:
            self.get_logger().warning(f"{line}; missed {_listed(self._missed) or 'nothing'}")
        else:
            self.get_logger().info(f"{line}; missed nothing")
        self._status.send("closed", counts=counts, missed=_positive(self._missed))


def _controllers(file: str) -> dict[str, str]:
    """Return the entry of the bag's metadata that keeps the controllers' parameters."""
    if not file:
        return {}
    document = load_yaml(Path(file), SettingError)
    settings_from_parameters(document, file)
    return {CONTROLLERS_ENTRY: dump_yaml(document)}


def _positive(missed: Mapping[str, int]) -> dict[str, int]:
    return {topic: count for topic, count in missed.items() if count}


def _listed(missed: Mapping[str, int]) -> str:
    return ", ".join(f"{count} on {topic}" for topic, count in _positive(missed).items())


def _message_class(type_name: str) -> Any:
    """Return the Python class of a message type, for instance ``std_msgs/msg/String``.

    The name comes from a publisher: nothing but a package's messages is imported for it.
    """
    parts = _MESSAGE_TYPE.fullmatch(type_name)
    if parts is None:
        raise SettingError(f"{type_name!r} is no message type")
    try:
        return getattr(importlib.import_module(f"{parts[1]}.msg"), parts[2])
    except (ImportError, AttributeError):
        raise SettingError(f"the message type {type_name} is not installed") from None


def _matching(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """Return the strictest quality of service that every publisher of a topic offers.

    Everything that came is kept until it is written. What that bounds is the middleware's limit
    of samples (5000 in Fast DDS): beyond it reliable publishers are made to repeat.
    """
    reliable = all(
        info.qos_profile.reliability == ReliabilityPolicy.RELIABLE for info in publishers
    )
    latched = all(
        info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in publishers
    )
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )

"""Records topics into an MCAP bag: raw bytes, straight from the subscription into the file."""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.validate_topic_name import validate_topic_name

from hpid_ros.bags.writer import BagTopic, BagWriter, TopicQos
from hpid_ros.errors import BagError, SettingError
from hpid_ros.nodes import executor
from hpid_ros.nodes.parameters import read_only
from hpid_ros.nodes.status_pipe import StatusPipe
from hpid_ros.nodes.steady_timer import steady_timer
from hpid_ros.nodes.usage import Usage

_LOOK_PERIOD = 0.02  # [s]
_REPORT_PERIOD = 0.05  # [s]
_BEHIND_AT_MOST = 20_000  # messages that may wait in one subscription
_DEFAULT_TOPICS = ["joint_trajectory", "joint_commands", "joint_states"]


class BagRecorder(executor.ClosingNode):
    """Records a list of topics as soon as each has a publisher.

    Topics are subscribed in the order of the list, each after the one before: with the states
    last, whoever waits for a subscriber of the states has a recorder for all that answers them.

    Raises:
        SettingError: No bag or no topic was named, or a topic twice.
        InvalidTopicNameException: A topic's name is none.
        HpidError: The bag cannot be created.
    """

    def __init__(self) -> None:
        super().__init__("bag_recorder")
        path = str(read_only(self, "bag", "", "Folder of the bag to create"))
        topics = read_only(
            self, "topics", _DEFAULT_TOPICS, "Topics to record, subscribed in this order"
        )
        if not path or not topics:
            raise SettingError("the parameters bag and topics must name a new folder and topics")
        for topic in topics:
            validate_topic_name(topic)
        self._status = StatusPipe(self)
        self._waiting = [self.resolve_topic_name(topic) for topic in topics]
        if len(set(self._waiting)) != len(self._waiting):
            raise SettingError(f"topics must name each topic once, not {', '.join(topics)}")
        self._writer = BagWriter(path)
        self._failed = False
        self._reported: dict[str, int] = {}
        self._look = steady_timer(self, _LOOK_PERIOD, self._subscribe_next)
        steady_timer(self, _REPORT_PERIOD, self._report)

    def _subscribe_next(self) -> None:
        while self._waiting:
            topic = self._waiting[0]
            publishers = self.get_publishers_info_by_topic(topic)
            if not publishers:
                return
            self._record(topic, publishers)
            del self._waiting[0]
        self._look.cancel()
        self._status.send("recording")

    def _record(self, topic: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        type_name = publishers[0].topic_type
        qos = _matching(publishers)
        handle = self._writer.add_topic(
            topic,
            type_name,
            TopicQos(
                reliable=qos.reliability == ReliabilityPolicy.RELIABLE,
                transient_local=qos.durability == DurabilityPolicy.TRANSIENT_LOCAL,
                depth=qos.depth,
            ),
        )
        self.create_subscription(
            _message_class(type_name), topic, self._callback(handle), qos, raw=True
        )
        self.get_logger().info(f"recording {topic} [{type_name}]")

    def _callback(self, handle: BagTopic) -> Callable[[bytes], Any]:
        return partial(self._write, handle)

    def _write(self, handle: BagTopic, raw: bytes) -> None:
        if not self._failed:
            self._try(partial(self._writer.write, handle, time.time_ns(), raw))

    def _try(self, action: Callable[[], None]) -> None:
        """Write to the bag; end the process with one line when that fails."""
        try:
            action()
        except BagError as error:
            self._failed = True
            self.get_logger().error(str(error))
            self._status.send("failed", reason=str(error))
            self.request_stop(executor.BAD_INPUT)

    def _report(self) -> None:
        """Put what is waiting into the file, and only then tell that it is recorded."""
        if self._failed:
            return
        counts = self._writer.counts
        if counts != self._reported:
            self._reported = counts
            self._try(self._writer.flush)
            if not self._failed:
                self._status.send("recorded", counts=counts)

    def close(self) -> None:
        """Finish the bag."""
        self._try(self._writer.close)
        if not self._failed:
            self._status.send("closed", counts=self._writer.counts)


def _message_class(type_name: str) -> Any:
    """Return the Python class of a message type, for instance ``std_msgs/msg/String``."""
    package, kind, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError):
        raise SettingError(f"the message type {type_name} is not installed") from None


def _matching(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """Return the strictest quality of service that every publisher of a topic offers."""
    reliable = all(
        info.qos_profile.reliability == ReliabilityPolicy.RELIABLE for info in publishers
    )
    latched = all(
        info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in publishers
    )
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_BEHIND_AT_MOST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


USAGE = Usage(
    "bag_recorder",
    "Records topics into a new MCAP bag.",
    "-p bag:=FOLDER",
    ["bag", "topics", "status_fd"],
    ["those of the parameter topics"],
)


def main(args: Sequence[str] | None = None) -> int:
    """Run the recorder."""
    return executor.run(lambda: [BagRecorder()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())

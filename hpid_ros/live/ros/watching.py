"""Streams of the controllers that the page shows, as samples."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.live.graph import Samples
from hpid_ros.live.streams import (
    ControlClock,
    Heard,
    JointSampler,
    MessageColumns,
    Part,
    bare_numbers,
    joint_numbers,
)
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.rclpy_internals import taker

_STATES, _COMMANDS = "joint_states", "joint_commands"
KINDS: dict[str, Any] = {
    "sensor_msgs/msg/JointState": JointState,
    "std_msgs/msg/Float64MultiArray": Float64MultiArray,
    "std_msgs/msg/Float64": Float64,
}
JOINT_STATE = "sensor_msgs/msg/JointState"


class Topic(NamedTuple):
    """A topic."""

    name: str  # its full name
    type: str  # one of KINDS
    is_reliable: bool = False  # whether what was lost is sent again


class ControllerTopics(NamedTuple):
    """The topics of one controller that tell how it does."""

    states: Topic  # where its states come from
    commands: Topic | None  # where its commands go; None where they are not to be listened to
    reference: Topic


def controller_topics(node: Node, controller: str) -> tuple[ControllerTopics, bool]:
    """Return the topics of a controller, and whether the graph has told all of them.

    One that is not active listens to no states, and one of several in a process may leave both to
    the process: these have their usual names then.
    """
    space, _, name = controller.rpartition("/")
    known = [
        Topic(topic, kind)
        for topic, kinds in node.get_topic_names_and_types()
        for kind in kinds
        if kind in KINDS
    ]

    def of_controller(find: Callable[[str], list[TopicEndpointInfo]]) -> list[Topic]:
        """Go by endpoints: a dead node's name may be left, and hide a new node of that name."""
        who = (name, space or "/")
        return [
            each
            for each in known
            if any(
                (*who, each.type) == (info.node_name, info.node_namespace, info.topic_type)
                for info in find(each.name)
            )
        ]

    listens = of_controller(node.get_subscriptions_info_by_topic)
    tells = of_controller(node.get_publishers_info_by_topic)
    states = _chosen(listens, controller, _STATES, (JOINT_STATE,))
    commands = _chosen(tells, controller, _COMMANDS, tuple(KINDS))
    topics = ControllerTopics(
        states or Topic(f"{space}/{_STATES}", JOINT_STATE),
        commands or Topic(f"{space}/{_COMMANDS}", JOINT_STATE),
        Topic(f"{controller}/reference", JOINT_STATE, is_reliable=True),
    )
    return topics, states is not None and commands is not None


def _chosen(
    found: Sequence[Topic], controller: str, usual: str, kinds: Sequence[str]
) -> Topic | None:
    """Return the one that can be meant: of the usual name, if there are several."""
    own = f"{controller}/"
    might = [
        each
        for each in found
        if each.type in kinds and not (each.type == JOINT_STATE and each.name.startswith(own))
    ]
    might.sort(key=lambda each: (each.name.rpartition("/")[2] != usual, each.name))
    return might[0] if might else None


KEPT = 10_000
"""Messages of a topic that are kept until somebody takes them: eight joints at 1 kHz for 1.2 s."""

_PROFILES = {
    is_reliable: QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=KEPT,
        reliability=reliability,
        durability=DurabilityPolicy.VOLATILE,
    )
    for is_reliable, reliability in enumerate(
        (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE)
    )
}


class Streams:
    """Subscriptions of a node of their own, which no executor spins: a message costs its copy.

    Of one thread at a time.
    """

    def __init__(self, node: Node) -> None:
        self._node = Node(
            f"{node.get_name()}_streams",
            context=node.context,
            namespace=node.get_namespace(),
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        ClosingNode.made.append(self._node)  # for a process that ends without closing it
        self._subscriptions: dict[Topic, tuple[Subscription, Callable[[], bytes | None]]] = {}
        self._taken: dict[Topic, list[bytes]] = {}

    def listen(self, topics: Iterable[Topic]) -> None:
        """Subscribe to these topics from now on, and to no others."""
        wanted = set(topics)
        for topic in set(self._subscriptions) - wanted:
            subscription, _ = self._subscriptions.pop(topic)
            self._node.destroy_subscription(subscription)
            self._taken.pop(topic, None)
        for topic in wanted - set(self._subscriptions):
            made = self._node.create_subscription(
                KINDS[topic.type],
                topic.name,
                _ignore,
                _PROFILES[topic.is_reliable],
                raw=True,
            )
            self._subscriptions[topic] = made, taker(made)

    def peek(self, topic: Topic) -> bytes | None:
        """Return the newest message of a topic that is not taken yet; None if there is none."""
        self._fill(topic)
        messages = self._taken.get(topic)
        return messages[-1] if messages else None

    def take(self, topic: Topic) -> list[bytes]:
        """Return the messages of a topic since the last call."""
        self._fill(topic)
        return self._taken.pop(topic, [])

    def _fill(self, topic: Topic) -> None:
        if topic not in self._subscriptions:
            return
        _, take = self._subscriptions[topic]
        messages = self._taken.setdefault(topic, [])
        # At most what can have waited: a publisher that is faster than this must not hold it up.
        for _ in range(KEPT):
            message = take()
            if message is None:
                return
            messages.append(message)
        del messages[:-KEPT]

    def close(self) -> None:
        """Subscribe to nothing any more."""
        self.listen(())
        self._node.destroy_node()


def _ignore(message: bytes) -> None:
    """No executor calls it."""


_STAMP_OFFSET = 4  # of a message with a header, in bytes


class Watched(NamedTuple):
    """A controller that is looked at."""

    joint: str
    topics: ControllerTopics


class Watching:
    """Takes samples; every method may be called from any thread.

    A topic that several controllers share is subscribed to, taken and decoded once.
    """

    def __init__(self, node: Node) -> None:
        self._lock = threading.Lock()
        self._streams = Streams(node)
        self._watched: dict[str, Watched] = {}
        self._samplers: dict[str, JointSampler] = {}
        self._clocks: dict[Topic, ControlClock] = {}
        self._columns: dict[Topic, MessageColumns] = {}

    def watch(self, watched: Mapping[str, Watched]) -> None:
        """Take samples of these controllers from now on, and of no others."""
        with self._lock:
            if watched == self._watched:
                return
            topics = {topic for each in watched.values() for topic in each.topics if topic}
            self._streams.listen(topics)
            self._columns = {
                topic: self._columns.get(topic) or MessageColumns(topic.type) for topic in topics
            }
            states = {each.topics.states for each in watched.values()}
            self._clocks = {topic: self._clocks.get(topic, ControlClock()) for topic in states}
            self._samplers = {
                node: self._samplers[node]
                if self._is_same(node, each)
                else JointSampler(self._clocks[each.topics.states])
                for node, each in watched.items()
            }
            self._watched = dict(watched)

    def _is_same(self, node: str, watched: Watched) -> bool:
        before = self._watched.get(node)
        return before is not None and (before.joint, before.topics.states) == (
            watched.joint,
            watched.topics.states,
        )

    def listens_to(self, topic: Topic) -> bool:
        """Return whether a topic is subscribed to."""
        with self._lock:
            return topic in self._columns

    def take(self) -> dict[str, Samples]:
        """Return what came since the last call, by node."""
        with self._lock:
            # What answers a state is taken before the states: so the state is there, too.
            parts: dict[Topic, list[Part]] = {}
            for which in ("commands", "reference", "states"):
                topics = {getattr(each.topics, which) for each in self._watched.values()}
                for topic in topics - {None}:
                    parts[topic] = self._columns[topic].read(self._streams.take(topic))
            return {
                node: self._samplers[node].take(_heard(each, parts))
                for node, each in self._watched.items()
            }

    def time_of(self, node: str) -> float:
        """Return the time now on the control clock of a controller, in [s]; nan if unknown."""
        with self._lock:
            if node not in self._samplers:
                return math.nan
            clock = self._samplers[node].clock
            if clock.last_ns is None:
                return math.nan
            newest = self._streams.peek(self._watched[node].topics.states)
            stamp_ns = clock.last_ns if newest is None else _stamp_ns(newest, clock.last_ns)
            return clock.now(stamp_ns) if stamp_ns >= clock.last_ns else math.nan

    def close(self) -> None:
        """Take no more."""
        self.watch({})
        self._streams.close()


def _heard(watched: Watched, parts: Mapping[Topic, list[Part]]) -> Heard:
    joint, topics = watched
    is_bare = topics.commands is not None and topics.commands.type != JOINT_STATE
    commands = parts[topics.commands] if topics.commands else []
    return Heard(
        joint_numbers(parts[topics.states], joint),
        joint_numbers([] if is_bare else commands, joint),
        bare_numbers(commands if is_bare else []),
        joint_numbers(parts[topics.reference], joint),
    )


def _stamp_ns(raw: bytes, otherwise: int) -> int:
    if len(raw) < _STAMP_OFFSET + 8:
        return otherwise
    order = "<" if raw[1] else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw, _STAMP_OFFSET)
    return int(seconds * NANOSECONDS + nanoseconds)

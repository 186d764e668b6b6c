"""Messages of joints as samples on their control clocks, and the subscriptions they come from."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from hpid_bench.live.known_controllers import Samples
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.columns import FLOAT64, FLOAT64_MULTI_ARRAY, JOINT_STATE, Integers
from hpid_ros.messages.joint_state import (
    STAMP_OFFSET,
    Cursor,
    EffortReader,
    JointStateFields,
    decode_joint_state,
)
from hpid_ros.messages.reports import decode_numbers
from hpid_ros.nodes.core.executor import note_made
from hpid_ros.nodes.core.rclpy_internals import taker


class JointNumbers(NamedTuple):
    """One joint's part of some messages, in the order in which they came."""

    stamps_ns: Integers  # [ns] of the messages, (n,)
    # position [rad], velocity [rad/s] and effort [N m], nan where messages have none, (n, 3)
    values: Numbers

    def picked(self, which: slice | Integers) -> JointNumbers:
        return JointNumbers(self.stamps_ns[which], self.values[which])


def joint_numbers(messages: Sequence[JointStateFields], joint: str) -> JointNumbers:
    """Return one joint's numbers out of joint states; of each message the first that names it."""
    stamps, rows = [], []
    for each in messages:
        if joint in each.names:
            at, count = each.names.index(joint), len(each.names)
            arrays = each.position, each.velocity, each.effort
            rows.append([array[at] if len(array) == count else math.nan for array in arrays])
            stamps.append(each.stamp_ns)
    return JointNumbers(np.array(stamps, dtype=np.int64), np.array(rows).reshape(-1, 3))


def _command_reader(kind: str) -> Callable[[bytes], Any]:
    """Return what reads a command: fields of a joint state, or the number of one without names."""
    if kind == FLOAT64:
        return lambda raw: Cursor(raw, "Float64").double()
    if kind == FLOAT64_MULTI_ARRAY:
        return lambda raw: decode_numbers(raw)[0]
    efforts = EffortReader()  # several times as quick, for the most frequent of all messages

    def read(raw: bytes) -> JointStateFields:
        stamp_ns, names, effort = efforts.read(raw)
        return JointStateFields(stamp_ns, "", names, (), (), effort)

    return read


@dataclass
class ControlClock:
    """Where the control clock of a topic of states began, and how often it has."""

    start_ns: int | None = None
    epoch: int = 0


class JointClock:
    """The control clock as one joint has seen it.

    Joints of one topic may be told by several publishers, which do not go back at the same time:
    the first one begins the clock again, the others join it when they go back, too.
    """

    def __init__(self, clock: ControlClock) -> None:
        self._clock = clock
        self._start_ns = self._epoch = 0
        self.last_ns: int | None = None

    def take(self, stamps_ns: Integers) -> tuple[int, bool]:
        """Take the stamps of new states."""
        before = stamps_ns[:1] if self.last_ns is None else np.array([self.last_ns])
        back = np.flatnonzero(np.diff(stamps_ns, prepend=before) < 0)
        first = int(back[-1]) if len(back) else 0
        if self.last_ns is None or len(back):
            self._join(int(stamps_ns[first]))
        self.last_ns = int(stamps_ns[-1])
        return first, bool(len(back))

    def _join(self, stamp_ns: int) -> None:
        """Take the topic's clock, and begin it again where nobody else has done so."""
        clock = self._clock
        is_first_back = self.last_ns is not None and clock.epoch == self._epoch
        if clock.start_ns is None or is_first_back or stamp_ns < clock.start_ns:
            clock.start_ns = stamp_ns
            clock.epoch += 1
        self._start_ns, self._epoch = clock.start_ns, clock.epoch

    def seconds(self, stamps_ns: Any) -> Any:
        """Return times since the clock began in [s]: of many stamps, or of one."""
        return (stamps_ns - self._start_ns) / NANOSECONDS

    def present(self, stamps_ns: Integers, is_restarted: bool) -> Integers:
        """Return which answers to states are of the present time, as indices."""
        if self.last_ns is None:
            return np.zeros(0, dtype=np.int64)
        if not is_restarted:
            return np.arange(len(stamps_ns))
        within = (stamps_ns >= self._start_ns - _BESIDE) & (stamps_ns <= self.last_ns + _BESIDE)
        back = np.flatnonzero(np.diff(stamps_ns) < -_BESIDE)
        if len(back):
            within[: back[-1] + 1] = False
        return np.flatnonzero(within)


_BESIDE = 1_000_000  # [ns]; an answer may be stamped beside its state, and come before it


class JointSampler:
    """Makes samples of what comes of one joint."""

    def __init__(self, clock: ControlClock) -> None:
        self.clock = JointClock(clock)
        self._has_commands = False

    def take(
        self,
        states: JointNumbers,
        commands: JointNumbers,  # stamped with the states that they answer
        bare_commands: Numbers,  # [N m] where they have no stamps, (n,)
        references: JointNumbers,  # what the controller published as its reference
    ) -> Samples:
        """Return what came since the last call; what nobody can place in time is left out."""
        self._has_commands |= bool(len(commands.stamps_ns) or len(bare_commands))
        clock, stamps = self.clock, states.stamps_ns
        first, is_restarted = clock.take(stamps) if len(stamps) else (0, False)
        states = states.picked(slice(first, None))
        times = clock.seconds(states.stamps_ns)
        references, commands = (
            each.picked(clock.present(each.stamps_ns, is_restarted))
            for each in (references, commands)
        )
        if len(bare_commands):
            efforts = _rows(self._times_of(len(bare_commands), times), bare_commands)
        elif self._has_commands:
            efforts = _rows(clock.seconds(commands.stamps_ns), commands.values[:, 2])
        else:  # as measured
            is_known = np.isfinite(states.values[:, 2])
            efforts = _rows(times[is_known], states.values[is_known, 2])
        return Samples(
            _rows(times, states.values[:, :2]),
            efforts,
            _rows(clock.seconds(references.stamps_ns), references.values[:, :2]),
            is_restarted,
        )

    def _times_of(self, count: int, times: Numbers) -> Numbers:
        """Return times of so many commands without stamps: the newest answers the newest state."""
        if not len(times):
            last_ns = self.clock.last_ns
            return np.full(count, np.nan if last_ns is None else self.clock.seconds(last_ns))
        return times[np.clip(np.arange(len(times) - count, len(times)), 0, None)]


def _rows(times: Numbers, values: Numbers) -> Numbers:
    return np.column_stack((times, values))


_STATES, _COMMANDS = "joint_states", "joint_commands"
_KINDS: dict[str, Any] = {
    JOINT_STATE: JointState,
    FLOAT64_MULTI_ARRAY: Float64MultiArray,
    FLOAT64: Float64,
}


class Topic(NamedTuple):
    name: str  # its full name
    type: str = JOINT_STATE  # one of _KINDS
    is_reliable: bool = False  # whether what was lost is sent again


class ControllerTopics(NamedTuple):
    """The topics of one controller that tell how its joint does."""

    joint: str
    states: Topic  # where its states come from
    commands: Topic | None  # where its commands go; None where they are not to be listened to
    reference: Topic

    @classmethod
    def usual(cls, controller: str, joint: str, states: str = _STATES) -> ControllerTopics:
        """Return the topics of a controller where nobody has renamed any; states are given."""
        space = controller.rpartition("/")[0]
        full = states if states.startswith("/") else f"{space}/{states}"
        reference = Topic(f"{controller}/reference", is_reliable=True)
        return cls(joint, Topic(full), Topic(f"{space}/{_COMMANDS}"), reference)


def controller_topics(node: Node, controller: str, joint: str) -> tuple[ControllerTopics, bool]:
    """Return the topics of a controller, and whether the graph has told all of them.

    One that is not active listens to no states, and one of several in a process may leave both to
    the process: these have their usual names then.
    """
    space, _, name = controller.rpartition("/")
    known = [
        Topic(topic, kind)
        for topic, kinds in node.get_topic_names_and_types()
        for kind in kinds
        if kind in _KINDS
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

    def chosen(found: Sequence[Topic], usual: str, kinds: Sequence[str]) -> Topic | None:
        """Return the one that can be meant: of the usual name, if there are several."""
        might = [
            each
            for each in found
            if each.type in kinds
            and not (each.type == JOINT_STATE and each.name.startswith(f"{controller}/"))
        ]
        might.sort(key=lambda each: (each.name.rpartition("/")[2] != usual, each.name))
        return might[0] if might else None

    listens = of_controller(node.get_subscriptions_info_by_topic)
    publishes = of_controller(node.get_publishers_info_by_topic)
    states = chosen(listens, _STATES, (JOINT_STATE,))
    commands = chosen(publishes, _COMMANDS, tuple(_KINDS))
    usual = ControllerTopics.usual(controller, joint)
    topics = usual._replace(states=states or usual.states, commands=commands or usual.commands)
    return topics, states is not None and commands is not None


_KEPT = 10_000  # messages of a topic until they are taken: eight joints at 1 kHz for 1.2 s


class _Stream:
    """The messages of a topic, which no executor takes: a message costs its copy."""

    def __init__(self, node: Node, topic: Topic, read: Callable[[bytes], Any]) -> None:
        kinds = ReliabilityPolicy
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=_KEPT,
            reliability=kinds.RELIABLE if topic.is_reliable else kinds.BEST_EFFORT,
            durability=DurabilityPolicy.VOLATILE,
        )
        self.subscription: Subscription = node.create_subscription(
            _KINDS[topic.type], topic.name, lambda _: None, profile, raw=True
        )
        self._next = taker(self.subscription)
        self._messages: list[bytes] = []
        self._read = read

    def newest(self) -> bytes | None:
        """Return the newest message that has not been read; None if there is none."""
        # At most what can have waited: a publisher that is faster than this must not hold it up.
        for _ in range(_KEPT):
            message = self._next()
            if message is None:
                break
            self._messages.append(message)
        del self._messages[:-_KEPT]
        return self._messages[-1] if self._messages else None

    def read(self) -> list[Any]:
        """Return the messages since the last call; what is none of the type is passed over."""
        self.newest()
        raws, self._messages = self._messages, []
        found = []
        for raw in raws:
            with suppress(Exception):  # of any kind: it is one message
                found.append(self._read(raw))
        return found


class Watching:
    """Takes samples of controllers; every method may be called from any thread.

    A topic that several controllers share is subscribed to, taken and decoded once. Subscriptions
    are of a node of their own, which no executor spins.
    """

    def __init__(self, node: Node) -> None:
        self._lock = threading.Lock()
        self._node = Node(
            f"{node.get_name()}_streams",
            context=node.context,
            namespace=node.get_namespace(),
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        note_made(self._node)  # for a process that ends without closing it
        self._watched: dict[str, ControllerTopics] = {}
        self._samplers: dict[str, JointSampler] = {}
        self._clocks: dict[Topic, ControlClock] = {}
        self._streams: dict[Topic, _Stream] = {}

    def watch(self, watched: Mapping[str, ControllerTopics]) -> None:
        """Take samples of these controllers from now on, and of no others."""
        with self._lock:
            if watched == self._watched:
                return
            topics = {
                topic
                for each in watched.values()
                for topic in (each.states, each.commands, each.reference)
                if topic
            }
            commands = {each.commands for each in watched.values()}
            for topic in self._streams.keys() - topics:
                self._node.destroy_subscription(self._streams.pop(topic).subscription)
            for topic in topics - self._streams.keys():
                read = _command_reader(topic.type) if topic in commands else decode_joint_state
                self._streams[topic] = _Stream(self._node, topic, read)
            states = {each.states for each in watched.values()}
            self._clocks = {topic: self._clocks.get(topic, ControlClock()) for topic in states}
            self._samplers = {
                node: self._samplers[node]
                if self._is_same(node, each)
                else JointSampler(self._clocks[each.states])
                for node, each in watched.items()
            }
            self._watched = dict(watched)

    def _is_same(self, node: str, topics: ControllerTopics) -> bool:
        before = self._watched.get(node)
        return before is not None and before[:2] == topics[:2]  # joint and states

    def listens_to(self, topic: Topic) -> bool:
        with self._lock:
            return topic in self._streams

    def take(self) -> dict[str, Samples]:
        with self._lock:
            # What answers a state is taken before the states: so the state is there, too.
            found: dict[Topic | None, list[Any]] = {None: []}
            for which in ("commands", "reference", "states"):
                for topic in {getattr(each, which) for each in self._watched.values()} - {None}:
                    found[topic] = self._streams[topic].read()
            taken = {}
            for node, (joint, states, commands, reference) in self._watched.items():
                has_stamps = commands is None or commands.type == JOINT_STATE
                taken[node] = self._samplers[node].take(
                    joint_numbers(found[states], joint),
                    joint_numbers(found[commands] if has_stamps else [], joint),
                    np.array([] if has_stamps else found[commands]),
                    joint_numbers(found[reference], joint),
                )
            return taken

    def time_of(self, node: str) -> float:
        """Return the time now on the control clock of a controller, in [s]; nan if unknown."""
        with self._lock:
            clock = self._samplers[node].clock if node in self._samplers else None
            if clock is None or clock.last_ns is None:
                return math.nan
            newest = self._streams[self._watched[node].states].newest()
            stamp_ns = clock.last_ns if newest is None else _stamp_ns(newest, clock.last_ns)
            return float(clock.seconds(stamp_ns)) if stamp_ns >= clock.last_ns else math.nan

    def close(self) -> None:
        self.watch({})
        self._node.destroy_node()


def _stamp_ns(raw: bytes, otherwise: int) -> int:
    if len(raw) < STAMP_OFFSET + 8:
        return otherwise
    order = "<" if raw[1] else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw, STAMP_OFFSET)
    return int(seconds * NANOSECONDS + nanoseconds)

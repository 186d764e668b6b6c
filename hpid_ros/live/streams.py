"""Messages of joints as samples on their control clocks, and the subscriptions they come from."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.live.controllers import Samples
from hpid_ros.messages.batches import SLACK, Integers
from hpid_ros.messages.columns import LAYOUTS, WORD, Layout, LayoutFamily, Words, gather_words
from hpid_ros.messages.joint_state import ENCAPSULATION
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.rclpy_internals import taker

_MOST_FAMILIES = 64  # of layouts; a topic has one or two
_MOST_LEARNED = 64  # layouts in one batch; a robot has fewer joints, and a flood is passed over


class Part(NamedTuple):
    """Messages of one layout."""

    layout: Layout
    rows: Words  # the messages, (n, words)
    order: Integers  # their places among all messages of the batch, (n,), ascending

    def numbers(self, field: str, index: int) -> Numbers | None:
        """Return one number of each message, (n,); None where the field is not one a name."""
        length = self.layout.fields[field].length
        if self.layout.names and length != len(self.layout.names):
            return None
        return self.layout.column(self.rows, field, index) if index < length else None


class MessageColumns:
    """Reads the numbers of a topic's messages; their layouts are learned once.

    What is no message of the type is passed over.
    """

    def __init__(self, type: str) -> None:
        self._learn = LAYOUTS[type]
        self._families: dict[int, list[LayoutFamily]] = {}

    def read(self, raws: Sequence[bytes]) -> list[Part]:
        """Return messages by their layouts, in the order in which they came within each."""
        if not raws:
            return []
        sizes = np.fromiter(map(len, raws), np.int64, len(raws))
        slack = bytes(SLACK)
        buffer = np.frombuffer(b"".join((slack, *raws, slack)), dtype=np.uint8)
        starts = SLACK + np.cumsum(sizes) - sizes
        parts: list[Part] = []
        for size in np.unique(sizes).tolist():
            here = np.flatnonzero(sizes == size)
            words = -(-(size + ENCAPSULATION) // WORD)
            rows = gather_words(buffer, starts[here] - ENCAPSULATION, words)
            parts += self._read_size(raws, rows, here, size)
        return parts

    def _read_size(
        self, raws: Sequence[bytes], rows: Words, here: Integers, size: int
    ) -> Iterator[Part]:
        """Yield messages of one length by their layouts."""
        is_left = np.ones(len(rows), dtype=np.bool_)
        for family in self._families.get(size, ()):
            for layout, claims in family.split(rows):
                claims &= is_left
                yield Part(layout, rows[claims], here[claims])
                is_left &= ~claims
        for _ in range(_MOST_LEARNED):
            if not is_left.any():
                return
            first = int(np.argmax(is_left))
            is_left[first] = False
            learned = self._learned(raws[here[first]], size)
            if learned is not None:
                claims = ((rows & learned.mask) == learned.values).all(axis=1) & is_left
                claims[first] = True
                yield Part(learned, rows[claims], here[claims])
                is_left &= ~claims

    def _learned(self, raw: bytes, size: int) -> Layout | None:
        """Learn a message's layout; None where it is none of the type."""
        try:
            layout = self._learn(raw)
        except MessageError:
            return None
        self._remember(layout, size)
        return layout

    def _remember(self, layout: Layout, size: int) -> None:
        if sum(map(len, self._families.values())) >= _MOST_FAMILIES:
            self._families.clear()
        families = self._families.setdefault(size, [])
        for family in families:
            if family.accepts(layout):
                family.add(layout)
                return
        families.append(LayoutFamily(layout))


class JointNumbers(NamedTuple):
    """One joint's part of some messages, in the order in which they came."""

    stamps_ns: Integers  # [ns] of the messages, (n,)
    position: Numbers  # [rad] (n,); nan where messages have none, as in the others
    velocity: Numbers  # [rad/s] (n,)
    effort: Numbers  # [N m] (n,)

    def picked(self, which: slice | Integers) -> JointNumbers:
        """Return some of them."""
        return JointNumbers(
            self.stamps_ns[which], self.position[which], self.velocity[which], self.effort[which]
        )


def joint_numbers(parts: Sequence[Part], joint: str) -> JointNumbers:
    """Return one joint's numbers out of joint states; of each message the first that names it."""
    found = [part for part in parts if joint in part.layout.names]
    stamps = [part.layout.stamps_ns(part.rows, slice(None)) for part in found]
    columns = [
        [_or_nan(part, field, part.layout.names.index(joint)) for part in found]
        for field in ("position", "velocity", "effort")
    ]
    if not found:
        none = np.zeros(0)
        return JointNumbers(np.zeros(0, dtype=np.int64), none, none, none)
    if len(found) == 1:
        return JointNumbers(stamps[0], *(np.ascontiguousarray(each[0]) for each in columns))
    order = np.argsort(np.concatenate([part.order for part in found]))
    return JointNumbers(
        np.concatenate(stamps)[order], *(np.concatenate(each)[order] for each in columns)
    )


def _or_nan(part: Part, field: str, index: int) -> Numbers:
    numbers = part.numbers(field, index)
    return np.full(len(part.rows), np.nan) if numbers is None else numbers


def bare_numbers(parts: Sequence[Part]) -> Numbers:
    """Return the first number of each message without stamps and names, in their order, (n,)."""
    found = [(part.order, part.numbers("data", 0)) for part in parts]
    known = [(order, numbers) for order, numbers in found if numbers is not None]
    if not known:
        return np.zeros(0)
    order = np.argsort(np.concatenate([order for order, _ in known]))
    numbers: Numbers = np.concatenate([numbers for _, numbers in known])[order]
    return numbers


class ControlClock:
    """Where the control clock of a topic of states began."""

    def __init__(self) -> None:
        self.start_ns: int | None = None
        self.epoch = 0

    def begin(self, stamp_ns: int) -> None:
        """Start again with a stamp."""
        self.start_ns = stamp_ns
        self.epoch += 1


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
        start_ns = clock.start_ns
        if start_ns is None or is_first_back or stamp_ns < start_ns:
            clock.begin(stamp_ns)
            start_ns = stamp_ns
        self._start_ns, self._epoch = start_ns, clock.epoch

    def seconds(self, stamps_ns: Integers) -> Numbers:
        """Return times since the clock began, in [s]."""
        seconds: Numbers = (stamps_ns - self._start_ns) / float(NANOSECONDS)
        return seconds

    def now(self, stamp_ns: int) -> float:
        """Return one time in [s]."""
        return (stamp_ns - self._start_ns) / NANOSECONDS

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


class Heard(NamedTuple):
    """What came of one joint, by where it came from."""

    states: JointNumbers
    commands: JointNumbers  # its commands, stamped with the states that they answer
    bare_commands: Numbers  # [N m] its commands where they have no stamps, (n,)
    references: JointNumbers  # what its controller told as its reference


class JointSampler:
    """Makes samples of what comes of one joint."""

    def __init__(self, clock: ControlClock) -> None:
        self.clock = JointClock(clock)
        self._has_commands = False

    def take(self, heard: Heard) -> Samples:
        """Return what came since the last call; what nobody can place in time is left out."""
        stamps = heard.states.stamps_ns
        first, is_restarted = self.clock.take(stamps) if len(stamps) else (0, False)
        states = heard.states.picked(slice(first, None))
        times = self.clock.seconds(states.stamps_ns)
        references = self._answers(heard.references, is_restarted)
        return Samples(
            np.column_stack((times, states.position, states.velocity)),
            self._efforts(heard, states, times, is_restarted),
            np.column_stack(
                (
                    self.clock.seconds(references.stamps_ns),
                    references.position,
                    references.velocity,
                )
            ),
            is_restarted,
        )

    def _answers(self, told: JointNumbers, is_restarted: bool) -> JointNumbers:
        """Return what answers states of the present time."""
        return told.picked(self.clock.present(told.stamps_ns, is_restarted))

    def _efforts(
        self, heard: Heard, states: JointNumbers, times: Numbers, is_restarted: bool
    ) -> Numbers:
        """Return times and efforts: as commanded, or else as measured."""
        bare = heard.bare_commands
        self._has_commands |= bool(len(heard.commands.stamps_ns) or len(bare))
        if len(bare):
            return np.column_stack((self._times_of(len(bare), times), bare))
        if self._has_commands:
            commands = self._answers(heard.commands, is_restarted)
            return np.column_stack((self.clock.seconds(commands.stamps_ns), commands.effort))
        is_told = np.isfinite(states.effort)
        return np.column_stack((times[is_told], states.effort[is_told]))

    def _times_of(self, count: int, times: Numbers) -> Numbers:
        """Return times of so many commands without stamps: the newest answers the newest state."""
        if not len(times):
            last_ns = self.clock.last_ns
            return np.full(count, np.nan if last_ns is None else self.clock.now(last_ns))
        return times[np.clip(np.arange(len(times) - count, len(times)), 0, None)]


_STATES, _COMMANDS = "joint_states", "joint_commands"
_KINDS: dict[str, Any] = {
    "sensor_msgs/msg/JointState": JointState,
    "std_msgs/msg/Float64MultiArray": Float64MultiArray,
    "std_msgs/msg/Float64": Float64,
}
_JOINT_STATE = "sensor_msgs/msg/JointState"


class Topic(NamedTuple):
    """A topic."""

    name: str  # its full name
    type: str = _JOINT_STATE  # one of _KINDS
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
            and not (each.type == _JOINT_STATE and each.name.startswith(f"{controller}/"))
        ]
        might.sort(key=lambda each: (each.name.rpartition("/")[2] != usual, each.name))
        return might[0] if might else None

    listens = of_controller(node.get_subscriptions_info_by_topic)
    publishes = of_controller(node.get_publishers_info_by_topic)
    states = chosen(listens, _STATES, (_JOINT_STATE,))
    commands = chosen(publishes, _COMMANDS, tuple(_KINDS))
    usual = ControllerTopics.usual(controller, joint)
    topics = usual._replace(states=states or usual.states, commands=commands or usual.commands)
    return topics, states is not None and commands is not None


_KEPT = 10_000  # messages of a topic until they are taken: eight joints at 1 kHz for 1.2 s


class _Stream:
    """The messages of a topic, which no executor takes: a message costs its copy."""

    def __init__(self, node: Node, topic: Topic) -> None:
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
        self._columns = MessageColumns(topic.type)

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

    def read(self) -> list[Part]:
        """Return the messages since the last call."""
        self.newest()
        messages, self._messages = self._messages, []
        return self._columns.read(messages)


_STAMP_OFFSET = 4  # of a message with a header, in bytes


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
        ClosingNode.made.append(self._node)  # for a process that ends without closing it
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
            for topic in self._streams.keys() - topics:
                self._node.destroy_subscription(self._streams.pop(topic).subscription)
            for topic in topics - self._streams.keys():
                self._streams[topic] = _Stream(self._node, topic)
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
        """Return whether a topic is subscribed to."""
        with self._lock:
            return topic in self._streams

    def take(self) -> dict[str, Samples]:
        """Return what came since the last call, by node."""
        with self._lock:
            # What answers a state is taken before the states: so the state is there, too.
            parts: dict[Topic, list[Part]] = {}
            for which in ("commands", "reference", "states"):
                for topic in {getattr(each, which) for each in self._watched.values()} - {None}:
                    parts[topic] = self._streams[topic].read()
            return {
                node: self._samplers[node].take(_heard(each, parts))
                for node, each in self._watched.items()
            }

    def time_of(self, node: str) -> float:
        """Return the time now on the control clock of a controller, in [s]; nan if unknown."""
        with self._lock:
            clock = self._samplers[node].clock if node in self._samplers else None
            if clock is None or clock.last_ns is None:
                return math.nan
            newest = self._streams[self._watched[node].states].newest()
            stamp_ns = clock.last_ns if newest is None else _stamp_ns(newest, clock.last_ns)
            return clock.now(stamp_ns) if stamp_ns >= clock.last_ns else math.nan

    def close(self) -> None:
        """Take no more."""
        self.watch({})
        self._node.destroy_node()


def _heard(topics: ControllerTopics, parts: Mapping[Topic, list[Part]]) -> Heard:
    joint = topics.joint
    is_bare = topics.commands is not None and topics.commands.type != _JOINT_STATE
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

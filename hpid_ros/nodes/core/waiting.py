"""Waiting: what a node has waited for too long, in one line of its log, and one when it came.

A node gives :class:`Waiting` a function that returns what it waits for at present. That is asked
by a timer that runs only while there is something to wait for, never when a state comes.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from hpid_ros.base.errors import MessageError, listed_names, nearest_name
from hpid_ros.base.text import bounded
from hpid_ros.messages.joint_state import decode_joint_state
from hpid_ros.nodes.core.executor import names_of_nodes
from hpid_ros.nodes.core.middleware import UNNAMED, full_name, steady_timer

PATIENCE = 2.0  # [s]
_LONGEST_PATIENCE = 64.0  # [s]; what flaps is told ever more rarely
_LOOK_PERIOD = 0.1  # [s]
_NAMES = 10  # of nodes or joints in a line
_TOPICS = 5

PUBLISHER, SUBSCRIBER = "publisher", "subscriber"


class Endpoint(NamedTuple):
    """A publisher or subscription of another node."""

    node: str  # its full name
    type: str  # of its messages
    misfit: str = ""  # why no message passes in spite of the same type, in words


class TopicView(NamedTuple):
    """What the graph knows of a topic's other side."""

    topic: str  # its full name
    type: str  # of the messages that are wanted; empty if any is
    role: str  # of the other side: PUBLISHER or SUBSCRIBER
    ends: tuple[Endpoint, ...]
    elsewhere: tuple[str, ...] = ()  # topics that might have been meant
    empty_domain: int | None = None  # the ROS domain, where no other node is seen in it


def described(view: TopicView) -> str:
    """Return in words how many publishers or subscribers a topic has, and what does not fit."""
    parts = []
    names = list(dict.fromkeys(end.node for end in view.ends))
    if names:
        count = len(view.ends)
        who = listed_names(names, _NAMES)
        parts.append(f"{view.topic} has {count} {view.role}{'s' * (count > 1)} ({who})")
    else:
        parts.append(f"{view.topic} has no {view.role}")
    does = "publishes" if view.role == PUBLISHER else "subscribes to"
    for end in dict.fromkeys(view.ends):
        if view.type and end.type != view.type:
            parts.append(f"{end.node} {does} {end.type}, not {view.type}")
        elif end.misfit:
            parts.append(f"{end.node} {end.misfit}")
    if not names and view.elsewhere:
        others = listed_names(view.elsewhere, _TOPICS)
        parts.append(f"{view.role}s are on {others}: is a namespace or a remapping missing?")
    if not names and view.empty_domain is not None:
        parts.append(f"no other node is seen in the domain {view.empty_domain} (ROS_DOMAIN_ID)")
    return "; ".join(parts)


def fits(view: TopicView) -> bool:
    """Return whether there is anybody from whom, or to whom, a message can pass."""
    return any((not view.type or end.type == view.type) and not end.misfit for end in view.ends)


def unseen(joints: Sequence[str], seen: Iterable[str]) -> str:
    """Return in words which joints have been seen instead of those that are waited for."""
    known = sorted(set(seen) - set(joints))
    if not known:
        return ""
    pairs = [(joint, nearest_name(joint, known)) for joint in joints]
    hints = [f"{near!r} for {joint}" for joint, near in pairs if near]
    if len(joints) == 1 and hints:
        hints = [repr(pairs[0][1])]
    line = f"joints seen there: {listed_names(known, _NAMES)}"
    return f"{line}; did you mean {listed_names(hints, _NAMES)}?" if hints else line


def qos_misfit(offered: QoSProfile, asked: QoSProfile, *, by_this_node: bool) -> str:
    """Return in words why a publisher sends a subscription nothing; empty if it does.

    Args:
        offered: The publisher's profile.
        asked: The subscription's profile.
        by_this_node: Whether it is this node that publishes; the words are about the other one.
    """
    compatibility, reason = qos_check_compatible(offered, asked)
    if compatibility != QoSCompatibility.ERROR:
        return ""
    own, other = ("offers", "asks for") if by_this_node else ("asks for", "offers")
    lines = []
    if (
        offered.reliability == ReliabilityPolicy.BEST_EFFORT
        and asked.reliability == ReliabilityPolicy.RELIABLE
    ):
        lines.append(("best effort", "reliable delivery"))
    if (
        offered.durability == DurabilityPolicy.VOLATILE
        and asked.durability == DurabilityPolicy.TRANSIENT_LOCAL
    ):
        lines.append(("volatile durability", "transient local durability"))
    if not lines:
        return f"has another quality of service: {reason}"
    ordered = [pair if by_this_node else pair[::-1] for pair in lines]
    return "; ".join(f"{other} {theirs}, this node {own} {ours}" for ours, theirs in ordered)


def type_name(kind: Any) -> str:
    """Return the name of a message type, for instance ``sensor_msgs/msg/JointState``."""
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


def other_side(node: Node, end: Publisher | Subscription) -> TopicView:
    """Return what the graph knows of who receives from a publisher, or sends to a subscription."""
    role = SUBSCRIBER if isinstance(end, Publisher) else PUBLISHER
    return topic_view(node, end.topic_name, role, end.msg_type, end.qos_profile)


def topic_view(
    node: Node, topic: str, role: str, kind: Any = None, profile: QoSProfile | None = None
) -> TopicView:
    """Return what the graph knows of a topic's publishers or subscribers.

    Args:
        node: The node that waits; its own endpoints are left out.
        topic: Full name of the topic.
        role: PUBLISHER or SUBSCRIBER, whichever is waited for.
        kind: The message type that is wanted, if it matters.
        profile: The quality of service that this node has or would have there.
    """
    is_publisher = role == PUBLISHER
    infos = (
        node.get_publishers_info_by_topic(topic)
        if is_publisher
        else node.get_subscriptions_info_by_topic(topic)
    )
    own, ends = node.get_fully_qualified_name(), []
    for info in infos:
        name = full_name(info)
        if name == own:
            continue
        against = ""
        if profile is not None:
            pair = (info.qos_profile, profile) if is_publisher else (profile, info.qos_profile)
            against = qos_misfit(*pair, by_this_node=not is_publisher)
        name = "a node without a name yet" if info.node_name == UNNAMED else name
        ends.append(Endpoint(name, info.topic_type, against))
    wanted = "" if kind is None else type_name(kind)
    if ends:
        return TopicView(topic, wanted, role, tuple(ends))
    return TopicView(topic, wanted, role, (), _elsewhere(node, topic, wanted, role), _alone(node))


def _elsewhere(node: Node, topic: str, wanted: str, role: str) -> tuple[str, ...]:
    """Return topics of the wanted type that have what is missed, those of a like name first."""
    own = names_of_nodes()

    def is_meant(name: str) -> bool:
        """Tell whether others have there what is missed, and this process has nothing to do."""
        publishers = node.get_publishers_info_by_topic(name)
        subscriptions = node.get_subscriptions_info_by_topic(name)
        ends = publishers if role == PUBLISHER else subscriptions
        return any(not wanted or end.topic_type == wanted for end in ends) and own.isdisjoint(
            map(full_name, (*publishers, *subscriptions))
        )

    known = [
        name
        for name, types in node.get_topic_names_and_types()
        if name != topic and (not wanted or wanted in types) and is_meant(name)
    ]
    if role == PUBLISHER and wanted and not any(_last(name) == _last(topic) for name in known):
        return tuple(sorted(known))
    near = nearest_name(_last(topic), {_last(name) for name in known})
    return tuple(sorted(name for name in known if _last(name) == near))


def _last(topic: str) -> str:
    return topic.rpartition("/")[2]


def _alone(node: Node) -> int | None:
    """Return the domain where nobody else is seen in it, but those of this process."""
    own = names_of_nodes()
    found = {f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces()}
    others = [name for name in found - own if not name.rpartition("/")[2].startswith("_")]
    return None if others else int(node.context.get_domain_id())


_SEEN_AT_MOST = 1000  # joints


class SeenJoints:
    """The joints of states or commands that have come, as far as they were looked at.

    Where they come only the newest message is kept; it is read when somebody asks.
    """

    def __init__(self) -> None:
        self.newest: bytes | None = None
        self._names: set[str] = set()

    def names(self) -> set[str]:
        """Return those that were seen until now; to be called now and then."""
        raw, self.newest = self.newest, None
        if raw is not None:
            with contextlib.suppress(MessageError):
                self._names.update(decode_joint_state(raw).names)
        if len(self._names) > _SEEN_AT_MOST:
            self._names = set(sorted(self._names)[:_SEEN_AT_MOST])
        return self._names


class Wait(NamedTuple):
    """Something that a node waits for. Those of the same words and topic are told together."""

    what: str  # for instance "states"
    arrival: str  # how its end is told, for instance "come"
    topic: str  # full name; empty where it is about none
    found: Callable[[Sequence[str]], str]  # by all joints that wait so: what there is instead
    joints: tuple[str, ...] = ()
    has_come: Callable[[], bool] = lambda: True  # asked at its end: else it is waited for no more


class _UnderWay:
    """A wait since it was first seen."""

    def __init__(self, now: float) -> None:
        self.since = now
        self.told = ""  # what was told to be waited for; empty before that


_Key = tuple[str, str]


class Waiting:
    """Logs what nodes of a process wait for too long, once, and that it has come."""

    def __init__(self, node: Node, patience: float = PATIENCE) -> None:
        self._node, self._patience = node, patience
        self._sources: list[Callable[[], Wait | None]] = []
        self._under_way: dict[_Key, tuple[_UnderWay, Wait]] = {}
        self._patiences: dict[_Key, float] = {}
        self._timer: Timer | None = None

    def add(self, source: Callable[[], Wait | None]) -> None:
        """Ask this for what is waited for, from the next :meth:`begin` on; None is nothing."""
        self._sources.append(source)

    def begin(self) -> None:
        """Begin to look, as there may be something to wait for; that ends by itself."""
        if self._timer is None:
            self._timer = steady_timer(
                self._node, _LOOK_PERIOD, lambda: self.look(time.monotonic())
            )

    def look(self, now: float) -> None:
        """Look at what is waited for, and log what has to be; the time is a steady one, in [s]."""
        waits: dict[_Key, Wait] = {}
        for source in self._sources:
            wait = source()
            if wait is not None:
                key = wait.what, wait.topic
                joints = (*waits[key].joints, *wait.joints) if key in waits else wait.joints
                waits[key] = waits.get(key, wait)._replace(joints=joints)
        for key in [key for key in self._under_way if key not in waits]:
            self._end(*self._under_way.pop(key), now)
        for key, wait in waits.items():
            under_way = self._under_way[key][0] if key in self._under_way else _UnderWay(now)
            self._under_way[key] = under_way, wait
            patience = self._patiences.get(key, self._patience)
            if not under_way.told and now - under_way.since >= patience:
                self._patiences[key] = min(2.0 * patience, _LONGEST_PATIENCE)
                self._tell(under_way, wait)
        if not waits and self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def _tell(self, under_way: _UnderWay, wait: Wait) -> None:
        names = listed_names(wait.joints, _NAMES)
        under_way.told = f"{wait.what} of {names}" if names else wait.what
        found = wait.found(wait.joints)
        line = f"waiting for {under_way.told}{': ' * bool(found)}{found}"
        self._node.get_logger().warning(bounded(line))

    def _end(self, under_way: _UnderWay, wait: Wait, now: float) -> None:
        if under_way.told and wait.has_come():
            after = now - under_way.since
            line = f"{under_way.told} {wait.arrival} now, after {after:.1f} s"
            self._node.get_logger().info(bounded(line))

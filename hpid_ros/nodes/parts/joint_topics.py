"""What a controller subscribes to and publishes: states in, efforts out."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from hashlib import sha256
from typing import NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import (
    NEWEST_STATES,
    OFFERED,
    held,
    overridable,
    subscribe_raw,
)
from hpid_ros.nodes.parts.command_interfaces import (
    COMMAND_INTERFACES,
    COMMANDS,
    JOINT_STATE_INTERFACE,
    OF_CONTROLLERS,
    Template,
    message_type,
)

STATES = "joint_states"

TakeState = Callable[[bytes], None]
"""Is called with each state as it came, in CDR."""


class Sink(NamedTuple):
    """Where one joint's efforts go."""

    publisher: Publisher
    subscribers: Callable[[], int]  # counts those that receive what is sent
    send: Callable[[int, float], None]  # publishes an effort [N m] with the stamp [ns] it answers


Sinks = Mapping[str, Callable[[Node, str, str], Sink]]
"""By the names of ``command_interface``: what makes a sink of a node, its joint and its sender."""


def _publisher(node: Node, kind: type, topic: str, profile: object) -> Publisher:
    return node.create_publisher(kind, topic, profile, qos_overriding_options=overridable())


def _sink(interface: str, node: Node, joint: str, sender: str) -> Sink:
    """Return the sink of a controller that has its commands for itself."""
    found = COMMAND_INTERFACES[interface]
    kind = message_type(interface)
    publisher = _publisher(node, kind, found.controller_topic, found.controller_qos)
    publish, encode = publisher.publish, found.template([joint], sender).encode
    scale = found.scale(node, joint)
    return Sink(
        publisher,
        publisher.get_subscription_count,
        lambda stamp_ns, effort: publish(encode(stamp_ns, effort=(scale * effort,))),
    )


SINKS: Sinks = {name: partial(_sink, name) for name in OF_CONTROLLERS}
"""The sinks of a controller that has its commands for itself."""


class SharedTopics:
    """One subscription to the states for the controllers of a process, and one answer to each.

    The subscription begins when all that are going to listen are ready, so that a robot in
    lock-step, which publishes once it has a subscriber, is answered for every joint from its first
    state on. A controller that is ready later joins it. Each state is given to all controllers,
    and what they send meanwhile goes out in one message at the end. What one sends at any other
    time, or from another thread, goes out at once, and takes the place of an answer that still
    waits for the others. Controllers of other topics have their own.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._expected: set[Node] = set()
        self._takes: dict[Node, TakeState] = {}
        self._subscription: Subscription | None = None
        self._publisher: Publisher | None = None
        self._sender = ""
        self._joints: list[str] = []
        self._templates: dict[tuple[str, ...], Template] = {}
        self._answers: dict[str, tuple[int, float]] = {}
        self._collector: int | None = None  # the thread that gives a state to all
        self._lock = threading.Lock()

    def has_same(self, controller: Node, topic: str) -> bool:
        return controller.resolve_topic_name(topic) == self._node.resolve_topic_name(topic)

    def expect(self, controller: Node) -> None:
        """Wait for a controller before the states are subscribed to."""
        self._expected.add(controller)

    def listen(self, controller: ClosingNode, take: TakeState) -> None:
        """Give a controller states, with all others; on the executor's thread, as all of these.

        An error that one of them meets is none of the others'.
        """
        self._expected.discard(controller)
        self._takes = {**self._takes, controller: controller.guarded(STATES, take)}
        self._settle()

    def leave(self, controller: Node) -> None:
        """Give a controller no states, and wait for it no more."""
        self._expected.discard(controller)
        self._takes = {node: take for node, take in self._takes.items() if node != controller}
        self._settle()

    @property
    def states(self) -> Subscription | None:
        """The subscription; None while not all are ready."""
        return self._subscription

    def _settle(self) -> None:
        """Subscribe once all are ready, and until all have left."""
        if self._subscription is None:
            if self._takes and not self._expected:
                self._subscription = subscribe_raw(self._node, STATES, self._give, NEWEST_STATES)
        elif not self._takes:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _give(self, raw: bytes) -> None:
        takes = self._takes  # one of them may leave, or make another leave
        self._collector = threading.get_ident()
        try:
            for node, take in takes.items():
                if node in self._takes:
                    take(raw)
        finally:
            self._collector = None
            with self._lock:
                self._publish_answers()

    def sink(self, controller: Node, joint: str, sender: str) -> Sink:
        if not self.has_same(controller, COMMANDS):
            return _sink(JOINT_STATE_INTERFACE, controller, joint, sender)
        if self._publisher is None:
            self._publisher = _publisher(self._node, JointState, COMMANDS, OFFERED)
            own = self._node.get_fully_qualified_name()
            self._sender = own + sender.removeprefix(node_of(sender))
        self._joints.append(joint)
        count = self._publisher.get_subscription_count
        return Sink(self._publisher, count, partial(self._send, joint))

    def _send(self, joint: str, stamp_ns: int, effort: float) -> None:
        if self._collector == threading.get_ident():
            with self._lock:
                self._answers[joint] = stamp_ns, effort
            return
        with held(self._lock) as is_held:
            if is_held:
                self._answers.pop(joint, None)
                self._publish((joint,), stamp_ns, (effort,))

    def _publish_answers(self) -> None:
        """Publish what was collected, in the order of the sinks."""
        by_stamp: dict[int, dict[str, float]] = {}
        for joint in self._joints:
            if joint in self._answers:
                stamp_ns, effort = self._answers[joint]
                by_stamp.setdefault(stamp_ns, {})[joint] = effort
        for stamp_ns, efforts in by_stamp.items():
            self._publish(tuple(efforts), stamp_ns, list(efforts.values()))
        self._answers.clear()

    def _publish(self, joints: tuple[str, ...], stamp_ns: int, efforts: Sequence[float]) -> None:
        template = self._templates.get(joints)
        if template is None:
            template = COMMAND_INTERFACES[JOINT_STATE_INTERFACE].template(joints, self._sender)
            self._templates[joints] = template
        if self._publisher is not None:
            self._publisher.publish(template.encode(stamp_ns, effort=efforts))


def sender_of(node: Node, is_alone: bool) -> str:
    """Return what distinguishes a node's commands from those of all others."""
    name = str(node.get_fully_qualified_name())
    if is_alone:
        return name
    process = f"{socket.gethostname()} {os.getpid()} {time.monotonic_ns()}"
    return f"{name}#{sha256(process.encode()).hexdigest()[:6]}"


def node_of(sender: str) -> str:
    """Return the full name of the node that a sender is."""
    return sender.partition("#")[0]


def unsolicited_stamp(stamp_ns: int) -> int:
    """Return a stamp next to one that was answered, of a command that answers no state.

    A bridge in lock-step passes it over, so that a simulation that was paused goes on as if
    nothing had been; a robot, or a bridge in realtime, acts on it.
    """
    return stamp_ns + 1 if (stamp_ns + 1) % NANOSECONDS else stamp_ns - 1


class Commands:
    """One joint's commands, from the thread of the executor and from its supervisor's.

    They never overtake each other, each is whole, and after :meth:`cut` neither thread sends
    anything before :meth:`restore`, whatever the other was about to send.
    """

    def __init__(self, sink: Sink) -> None:
        self.publisher, self.subscribers, self._send = sink
        self._lock = threading.Lock()
        self._stamp_ns: int | None = None  # of the last answer; None once the joint is left
        self._is_cut = self._is_zero = False
        self.cuts = 0
        """How often the joint was cut and restored; an effort from before is sent no more."""

    def send(self, stamp_ns: int, effort: float, cuts: int) -> None:
        with self._lock:
            if not self._is_cut and cuts == self.cuts:
                self._stamp_ns = stamp_ns
                self._send(stamp_ns, effort)

    def leave(self) -> bool:
        """Publish a zero if there is a command to replace; the last one until the next state."""
        with self._lock:
            stamp_ns = self._stamp_ns
            if stamp_ns is not None and not self._is_zero:
                self._send(stamp_ns, 0.0)
            self._stamp_ns = None
            return stamp_ns is not None

    def fall_back(self, effort: float, is_due: Callable[[], bool]) -> None:
        with held(self._lock) as is_held:
            if is_held and self._stamp_ns is not None and not self._is_cut and is_due():
                self._send(unsolicited_stamp(self._stamp_ns), effort)

    def cut(self) -> None:
        """Publish a zero, after a command that is under way, and nothing else."""
        if self._is_zero:
            return
        self._is_cut = True
        with held(self._lock) as is_held:
            if is_held:
                if self._stamp_ns is not None:
                    self._send(unsolicited_stamp(self._stamp_ns), 0.0)
                self._is_zero = True

    def restore(self) -> None:
        self.cuts += 1  # what was begun until now is from before
        self._is_cut = self._is_zero = False

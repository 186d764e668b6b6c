"""Commands of a controller: its efforts as the message that the hardware side understands."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from hashlib import sha256
from typing import Protocol

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.middleware import NEWEST_COMMAND, OFFERED, overridable

_JOINT_STATE_TOPIC = "joint_commands"
_LOCK_WITHIN = 0.2  # [s]; whoever holds it longer is stuck in the middleware, as we would be


class CommandTopic(Protocol):
    """Where commands go, as far as a controller asks; a ``Publisher`` is one."""

    @property
    def topic_name(self) -> str:
        """Full name of the topic."""

    def get_subscription_count(self) -> int:
        """Return how many hear what is sent."""

    def wait_for_all_acked(self, timeout: Duration) -> bool:
        """Wait until all who acknowledge anything have done so, and tell whether they have."""


class CommandSink(Protocol):
    """Takes one joint's efforts."""

    @property
    def publisher(self) -> CommandTopic:
        """Where they go."""

    def send(self, stamp_ns: int, effort: float) -> None:
        """Publish an effort."""


def _joint_state_publisher(node: Node) -> Publisher:
    return node.create_publisher(
        JointState, _JOINT_STATE_TOPIC, OFFERED, qos_overriding_options=overridable()
    )


class JointStateCommands:
    """One name and one effort in a JointState, stamped with the state that it answers.

    The convention of Isaac Sim and of ``topic_based_ros2_control``. Efforts have no frame: in its
    place stands who sends them.
    """

    def __init__(self, node: Node, joint: str, sender: str) -> None:
        self.publisher = _joint_state_publisher(node)
        self._template = JointStateTemplate([joint], sender, effort=True)

    def send(self, stamp_ns: int, effort: float) -> None:
        """Publish an effort in [N m]."""
        self.publisher.publish(self._template.encode(stamp_ns, effort=(effort,)))


class Float64MultiArrayCommands:
    """An array of one, for the forward and effort group controllers of ros2_control."""

    def __init__(self, node: Node, joint: str, sender: str) -> None:
        self.publisher = node.create_publisher(
            Float64MultiArray, "~/commands", NEWEST_COMMAND, qos_overriding_options=overridable()
        )
        self._message = Float64MultiArray(data=[0.0])

    def send(self, stamp_ns: int, effort: float) -> None:
        """Publish an effort in [N m]; the message has no stamp."""
        self._message.data[0] = effort
        self.publisher.publish(self._message)


class Float64Commands:
    """A bare number, for Gazebo's joint force topics."""

    def __init__(self, node: Node, joint: str, sender: str) -> None:
        self.publisher = node.create_publisher(
            Float64, "~/command", NEWEST_COMMAND, qos_overriding_options=overridable()
        )
        self._message = Float64()

    def send(self, stamp_ns: int, effort: float) -> None:
        """Publish an effort in [N m]; the message has no stamp."""
        self._message.data = effort
        self.publisher.publish(self._message)


class SharedCommands:
    """One publisher for the controllers of a process, which answer a state in one message.

    What a controller gives while a state is handed round goes out with the answers of the others;
    what it gives at any other time, or from another thread, goes out at once, and takes the place
    of an answer that still waits for the others.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher: Publisher | None = None
        self._sender = ""
        self._joints: list[str] = []
        self._templates: dict[tuple[str, ...], JointStateTemplate] = {}
        self._answers: dict[str, tuple[int, float]] = {}
        self._collector: int | None = None  # the thread that hands a state round
        self._lock = threading.Lock()

    def sink(self, controller: Node, joint: str, sender: str) -> CommandSink:
        """Return the sink of one controller; its own where it publishes on another topic."""
        topic = controller.resolve_topic_name(_JOINT_STATE_TOPIC)
        if topic != self._node.resolve_topic_name(_JOINT_STATE_TOPIC):
            return JointStateCommands(controller, joint, sender)
        if self._publisher is None:
            self._publisher = _joint_state_publisher(self._node)
            self._sender = self._node.get_fully_qualified_name() + sender.removeprefix(
                node_of(sender)
            )
        self._joints.append(joint)
        return _SharedSink(self, self._publisher, joint)

    @contextlib.contextmanager
    def collecting(self) -> Iterator[None]:
        """Publish what controllers give on this thread at the end, in one message."""
        self._collector = threading.get_ident()
        try:
            yield
        finally:
            self._collector = None
            with self._lock:
                self._publish_answers()

    def give(self, joint: str, stamp_ns: int, effort: float) -> None:
        """Take one joint's effort."""
        if self._collector == threading.get_ident():
            with self._lock:
                self._answers[joint] = stamp_ns, effort
        elif self._lock.acquire(timeout=_LOCK_WITHIN):
            try:
                self._answers.pop(joint, None)
                self._publish((joint,), stamp_ns, (effort,))
            finally:
                self._lock.release()

    def _publish_answers(self) -> None:
        """Publish what was collected, in the order of the sinks, whoever answered first."""
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
            template = JointStateTemplate(joints, self._sender, effort=True)
            self._templates[joints] = template
        if self._publisher is not None:
            self._publisher.publish(template.encode(stamp_ns, effort=efforts))


class _SharedSink:
    """One joint's part in shared commands."""

    def __init__(self, commands: SharedCommands, publisher: CommandTopic, joint: str) -> None:
        self.publisher = publisher
        self._commands, self._joint = commands, joint

    def send(self, stamp_ns: int, effort: float) -> None:
        self._commands.give(self._joint, stamp_ns, effort)


def sender_of(node: Node, is_alone: bool) -> str:
    """Return what tells a node's commands from those of all others."""
    name = str(node.get_fully_qualified_name())
    if is_alone:
        return name
    process = f"{socket.gethostname()} {os.getpid()} {time.monotonic_ns()}"
    return f"{name}#{sha256(process.encode()).hexdigest()[:6]}"


def node_of(sender: str) -> str:
    """Return the full name of the node that a sender is."""
    return sender.partition("#")[0]


def unsolicited_stamp(stamp_ns: int) -> int:
    """Return a stamp beside one that was answered, of a command that answers no state.

    A bridge in lock-step passes it over, so that a simulation that was paused goes on as if
    nothing had been; a robot, or a bridge in realtime, acts on it.
    """
    return stamp_ns + 1 if (stamp_ns + 1) % NANOSECONDS else stamp_ns - 1


class Commands:
    """One joint's commands, from the thread of the executor and from its supervisor's.

    They never overtake each other: what one of them gives is whole, and after :meth:`shut`
    nothing is given by either, whatever the other was about to give.
    """

    def __init__(self, sink: CommandSink) -> None:
        self.publisher = sink.publisher
        self._sink = sink
        self._lock = threading.Lock()
        self._stamp_ns: int | None = None  # of the last answer; None once the joint is left
        self._is_held = self._is_shut = False

    def send(self, stamp_ns: int, effort: float) -> None:
        """Publish the effort that answers a state."""
        with self._lock:
            if not (self._is_held or self._is_shut):
                self._stamp_ns = stamp_ns
                self._sink.send(stamp_ns, effort)

    def leave(self, stamp_ns: int) -> None:
        """Publish a zero, the last command until the next state is answered."""
        with self._lock:
            self._stamp_ns = None
            if not (self._is_held or self._is_shut):
                self._sink.send(stamp_ns, 0.0)

    def fall_back(self, effort: float, is_due: Callable[[], bool]) -> None:
        """Publish an effort that answers no state."""
        if not self._lock.acquire(timeout=_LOCK_WITHIN):
            return
        try:
            if self._stamp_ns is not None and not (self._is_held or self._is_shut) and is_due():
                self._sink.send(unsolicited_stamp(self._stamp_ns), effort)
        finally:
            self._lock.release()

    def hold(self) -> None:
        """Publish a zero, and nothing else before :meth:`go_on`."""
        self._is_held = True
        self._zero()

    def go_on(self) -> None:
        """Publish again what is given."""
        self._is_held = False

    def shut(self) -> None:
        """Publish a zero, and nothing else any more."""
        if not self._is_shut:
            self._is_shut = True
            self._zero()

    def _zero(self) -> None:
        """Give no effort where there may be one; a command that is under way comes before."""
        if not self._lock.acquire(timeout=_LOCK_WITHIN):
            return
        try:
            if self._stamp_ns is not None:
                self._sink.send(unsolicited_stamp(self._stamp_ns), 0.0)
        finally:
            self._lock.release()


Sinks = Mapping[str, Callable[[Node, str, str], CommandSink]]
"""By the names of ``command_interface``: what makes a sink of a node, its joint and its sender."""

JOINT_STATE = "joint_state"

SINKS: Sinks = {
    JOINT_STATE: JointStateCommands,
    "float64_multi_array": Float64MultiArrayCommands,
    "float64": Float64Commands,
}
"""The sinks of a controller that has its commands for itself."""

"""Merged commands as the message that the hardware side understands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from hpid_ros.base.errors import SettingError
from hpid_ros.merging import Merged
from hpid_ros.nodes.ros.middleware import NEWEST_COMMAND, overridable
from hpid_ros.nodes.ros.rclpy_internals import MatchCounter
from hpid_ros.wire import DynamicJointStateTemplate, JointStateTemplate, MultiArrayTemplate


class Template(Protocol):
    """A message that is serialised but for its stamp and its efforts."""

    def encode(self, stamp_ns: int, *, effort: Sequence[float]) -> bytes:
        """Return the serialised message."""


@dataclass(frozen=True)
class Interface:
    """A message for the efforts of several joints."""

    topic: str  # where it goes, where nothing else is said
    message: Callable[[], Any]  # returns its type, or raises SettingError
    # makes a template of joint names and a sender
    template: Callable[[Sequence[str], str], Template]


def _dynamic_joint_state() -> Any:
    try:
        from control_msgs.msg import DynamicJointState
    except ImportError as error:
        raise SettingError(
            "command_interface dynamic_joint_state needs the package control_msgs, which is not "
            f"there ({error}); float64_multi_array and joint_state need nothing more"
        ) from None
    return DynamicJointState


ARRAY = "float64_multi_array"
"""The interface of ros2_control's group controllers."""

INTERFACES = {
    ARRAY: Interface(
        "~/commands", lambda: Float64MultiArray, lambda names, _: MultiArrayTemplate(len(names))
    ),
    "joint_state": Interface(
        "joint_command",
        lambda: JointState,
        lambda names, sender: JointStateTemplate(names, sender, effort=True),
    ),
    "dynamic_joint_state": Interface(
        "dynamic_joint_commands", _dynamic_joint_state, DynamicJointStateTemplate
    ),
}
"""By the names that the parameter ``command_interface`` may have."""


class GroupOutput:
    """Publishes merged commands, always of the size that was agreed on last.

    One that is guarded publishes nothing from the moment in which the middleware has matched a
    subscription that nobody has looked at yet: it may be a controller with other joints.
    """

    def __init__(
        self,
        node: Node,
        interface: str,
        topic: str,
        sender: str,
        is_guarded: bool,
        matched: Callable[[], None],
    ) -> None:
        self._interface, self._sender = INTERFACES[interface], sender
        self._template: Template | None = None
        self._count = 0
        self._last_ns = 0
        self.has_sent = False
        self.withheld = 0
        self.publisher = node.create_publisher(
            self._interface.message(),
            topic or self._interface.topic,
            NEWEST_COMMAND,
            qos_overriding_options=overridable(),
            event_callbacks=PublisherEventCallbacks(matched=lambda _: matched()),
        )
        self._counter = MatchCounter(self.publisher) if is_guarded else None
        self._settled = 0

    @property
    def matches(self) -> int:
        """How many subscriptions it has ever been matched with; 0 if it is not guarded."""
        return self._counter() if self._counter else 0

    @property
    def is_settled(self) -> bool:
        """Whether all subscriptions have been looked at."""
        return self.matches == self._settled

    def settle(self, matches: int) -> None:
        """Note that so many subscriptions have been looked at, of all that there have been."""
        self._settled = matches

    def agree(self, joints: Sequence[str]) -> None:
        """Send these joints from now on, in this order."""
        self._template = self._interface.template(joints, self._sender)
        self._count = len(joints)

    def send(self, merged: Merged) -> None:
        """Publish a merged command, unless somebody has come who has not been looked at."""
        if self._template is None:
            return
        raw = self._template.encode(merged.stamp_ns, effort=merged.efforts)
        if self.is_settled:  # asked last: nothing holds whoever comes between this and the next
            self.publisher.publish(raw)
            self._last_ns = merged.stamp_ns
            self.has_sent = True
        else:
            self.withheld += 1

    def zero(self) -> None:
        """Publish a zero for every joint, if anything has been published before."""
        if self.has_sent:
            self.send(Merged(self._last_ns, (0.0,) * self._count))

    def destroy(self) -> None:
        """Let the middleware forget the publisher."""
        if self._counter:
            self._counter.destroy()

    def forget(self) -> None:
        """Begin anew: there is nothing that a zero would have to end."""
        self.has_sent = False

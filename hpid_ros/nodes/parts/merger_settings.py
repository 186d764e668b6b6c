"""The parameters and the output of a merger."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from hpid_ros.base.errors import SettingError
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.reports import DynamicJointStateTemplate, MultiArrayTemplate
from hpid_ros.nodes.core.middleware import NEWEST_COMMAND, overridable
from hpid_ros.nodes.core.process import read_choice, read_number, read_only
from hpid_ros.nodes.core.rclpy_internals import MatchCounter, given_parameters
from hpid_ros.nodes.parts.merger import (
    LARGEST_EFFORT,
    LONGEST_TIMEOUT,
    Merged,
    MergerSettings,
    joints_of,
)


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
        """Start again: there is nothing that a zero would have to end."""
        self.has_sent = False


_LEAST_TIMEOUT = 1e-3  # [s]
_LONGEST_FADE_IN = 100.0  # [s]
_LEAST_SHARE = 0.01


@dataclass(frozen=True)
class MergerParameters:
    """What the parameters say."""

    joints: tuple[str, ...]  # the order that was given; empty to take the controller's
    controller: str  # full name of the controller that gets the commands
    manager: str  # full name of that controller's manager
    interface: str  # message of the merged commands
    straggler_wait: float  # see MergerSettings
    fade_in_time: float  # [s] likewise
    timeout: float  # [s] of joints that have none of their own
    timeouts: dict[str, float]  # [s] by joint
    fallbacks: dict[str, float]  # [N m] or [N], by joint

    def settings(self, order: Sequence[str]) -> MergerSettings:
        """Return the settings of a merger."""
        joints = joints_of(order, self.timeout, self.timeouts, self.fallbacks)
        return MergerSettings(joints, self.straggler_wait, self.fade_in_time)


def read_parameters(node: Node, joints: Sequence[str]) -> MergerParameters:
    """Declare the parameters of a merger and return what they say."""
    given = read_only(
        node,
        "joints",
        Parameter.Type.STRING_ARRAY,
        "Order of the merged command; left out it is that of the controller's own parameter",
    )
    controller = _full_name(
        node,
        str(
            read_only(
                node,
                "controller",
                "",
                "Group controller of ros2_control that gets the commands on its topic commands; "
                "it is asked for its joints, and nothing is sent while it is not active",
            )
        ),
    )
    manager = str(
        read_only(
            node,
            "controller_manager",
            "",
            "Manager of that controller; controller_manager in its namespace if empty",
        )
    )
    order = tuple(given or joints)
    if controller and order == tuple(joints):  # "-p joints:=..." is for every node of the process
        order = ()
    parameters = MergerParameters(
        joints=order,
        controller=controller,
        manager=_full_name(node, manager) or f"{controller.rpartition('/')[0]}/controller_manager",
        interface=read_choice(
            node,
            "command_interface",
            ARRAY,
            f"Message of the merged commands: {', '.join(INTERFACES)}",
            INTERFACES,
        ),
        straggler_wait=read_number(
            node,
            "straggler_wait",
            0.5,
            "How long answers wait for those to the same state, as part of the states' period",
            (_LEAST_SHARE, 1.0),
        ),
        fade_in_time=read_number(
            node,
            "fade_in_time",
            0.1,
            "A joint that comes back is faded in from its fallback for so long [s]; 0 jumps",
            (0.0, _LONGEST_FADE_IN),
        ),
        timeout=_timeout(node, "command_timeout", "A joint is silent after so long [s]"),
        timeouts={
            joint: _timeout(node, name, f"{joint} is silent after so long [s]")
            for name, joint in _given_below(node, "command_timeouts")
        },
        fallbacks={
            joint: read_number(
                node,
                name,
                0.0,
                f"Effort of {joint} while it is silent [N m or N]",
                (-LARGEST_EFFORT, LARGEST_EFFORT),
            )
            for name, joint in _given_below(node, "fallback_efforts")
        },
    )
    _require_usable(parameters)
    return parameters


def _require_usable(parameters: MergerParameters) -> None:
    if parameters.controller and parameters.interface != ARRAY:
        raise SettingError(
            f"controller is for command_interface {ARRAY}, not for {parameters.interface}"
        )
    if parameters.joints:
        parameters.settings(parameters.joints)
    elif not parameters.controller:
        raise SettingError(
            "the parameter joints must name the joints in their order, or controller a group "
            "controller that has them; both are empty"
        )


def _timeout(node: Node, name: str, description: str) -> float:
    return read_number(node, name, 0.1, description, (_LEAST_TIMEOUT, LONGEST_TIMEOUT))


def _given_below(node: Node, group: str) -> list[tuple[str, str]]:
    """Return the parameters of a group that were given, with the joints that they are for."""
    prefix = f"{group}."
    names = sorted(name for name in given_parameters(node) if name.startswith(prefix))
    return [(name, name.removeprefix(prefix)) for name in names]


def _full_name(node: Node, name: str) -> str:
    """Return a node's full name; one without a slash is in this node's namespace."""
    if not name or name.startswith("/"):
        return name.rstrip("/")
    return f"{node.get_namespace().rstrip('/')}/{name}"

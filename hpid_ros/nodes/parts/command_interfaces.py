"""The command interfaces: in which message an effort goes to a driver, where, at which scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple, Protocol

from rclpy.node import Node
from rclpy.qos import QoSProfile

from hpid_ros.base.errors import SettingError
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.reports import (
    DynamicJointStateTemplate,
    Float64Template,
    MultiArrayTemplate,
)
from hpid_ros.nodes.core.middleware import NEWEST_COMMAND, OFFERED

COMMANDS = "joint_commands"


class Template(Protocol):
    """A message that is serialised but for its stamp and its numbers."""

    def encode(self, stamp_ns: int, *, effort: Sequence[float]) -> bytes: ...


def _same(node: Node, joint: str) -> float:
    return 1.0


class CommandInterface(NamedTuple):
    """A message for the efforts of one joint, of several, or of either."""

    message: str  # its type, as PACKAGE/msg/NAME
    template: Callable[[Sequence[str], str], Template]  # by joint names and sender
    controller_topic: str = ""  # where a controller sends it; empty where none does
    merger_topic: str = ""  # where a merger sends it by default; empty where none does
    controller_qos: QoSProfile = NEWEST_COMMAND  # with which a controller offers it
    # by node and joint: what the message carries for an effort of 1 N m or 1 N, with its sign
    scale: Callable[[Node, str], float] = _same


JOINT_STATE_INTERFACE = "joint_state"
ARRAY = "float64_multi_array"
"""The interface of ros2_control's group controllers."""

COMMAND_INTERFACES: Mapping[str, CommandInterface] = {
    # Stamped with the state that is answered: the convention of Isaac Sim and of
    # topic_based_ros2_control. Efforts have no frame: in its place stands who sends them.
    JOINT_STATE_INTERFACE: CommandInterface(
        "sensor_msgs/msg/JointState",
        lambda names, sender: JointStateTemplate(names, sender, effort=True),
        controller_topic=COMMANDS,
        merger_topic="joint_command",
        controller_qos=OFFERED,
    ),
    # Without a stamp, for the effort group controllers of ros2_control.
    ARRAY: CommandInterface(
        "std_msgs/msg/Float64MultiArray",
        lambda names, sender: MultiArrayTemplate(len(names)),
        controller_topic="~/commands",
        merger_topic="~/commands",
    ),
    # Without a stamp, for Gazebo's joint force topics.
    "float64": CommandInterface(
        "std_msgs/msg/Float64",
        lambda names, sender: Float64Template(),
        controller_topic="~/command",
    ),
    "dynamic_joint_state": CommandInterface(
        "control_msgs/msg/DynamicJointState",
        DynamicJointStateTemplate,
        merger_topic="dynamic_joint_commands",
    ),
}
"""By the names that the parameter ``command_interface`` of controllers and of mergers may have."""

OF_CONTROLLERS = tuple(name for name, each in COMMAND_INTERFACES.items() if each.controller_topic)
OF_MERGERS = tuple(name for name, each in COMMAND_INTERFACES.items() if each.merger_topic)


def message_type(name: str) -> Any:
    """Return the type of an interface's message."""
    package, _, kind = COMMAND_INTERFACES[name].message.partition("/msg/")
    try:
        return getattr(import_module(f"{package}.msg"), kind)
    except ImportError as error:
        raise SettingError(
            f"command_interface {name} needs the package {package}, which is not there "
            f"({error}); {ARRAY} and {JOINT_STATE_INTERFACE} need nothing more"
        ) from None

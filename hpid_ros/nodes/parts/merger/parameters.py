"""The parameters of a merger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError
from hpid_ros.merging import MergerSettings
from hpid_ros.merging.settings import LARGEST_EFFORT, LONGEST_TIMEOUT, joints_of
from hpid_ros.nodes.parts.merger.output import ARRAY, INTERFACES
from hpid_ros.nodes.ros.parameters import read_choice, read_number, read_only
from hpid_ros.nodes.ros.rclpy_internals import given_parameters

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
    fallbacks: dict[str, float]  # [N m] by joint or [N]

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

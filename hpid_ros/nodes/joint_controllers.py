"""All joints of a configuration in one process, still one node for each joint."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError, require_known
from hpid_ros.base.names import controller_name, require_node_names
from hpid_ros.base.records import Record, names_of, quantity
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.control.parameter_files import parameters_from, parameters_in_file
from hpid_ros.control.settings import Value
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.core.waiting import Waiting
from hpid_ros.nodes.joint_command_merger import JointCommandMerger
from hpid_ros.nodes.joint_controller import JointController
from hpid_ros.nodes.parts.command_interfaces import JOINT_STATE_INTERFACE
from hpid_ros.nodes.parts.joint_topics import SINKS, SharedTopics, Sinks

MERGED = "merged"
"""Name of the command interface of controllers whose commands are merged in their process."""


@dataclass(frozen=True)
class CompositionParameters(Record):
    """Which joints are controlled in this process, and what they have in common."""

    joints: tuple[str, ...] | None = quantity(
        "Joints to control; each gets the node JOINT_controller, with its parameters", default=None
    )
    controllers_file: str = quantity(
        "File of ros2_control's own controllers, joint_trajectory_controller with gains or "
        "pid_controller: their PIDs are the defaults of the nodes, their joints those of joints",
        default="",
    )
    merge: bool = quantity(
        "Publish one message for all joints, as joint_command_merger, with its parameters",
        default=False,
    )
    share_messages: bool = quantity(
        "Read each state once for all joints, which begin together, and answer it with one "
        "message; whoever counts subscribers or publishers sees one",
        default=False,
    )


def make_nodes() -> list[executor.ClosingNode]:
    """Make one controller for each joint of the parameter ``joints``, and a merger if wished."""
    composition = executor.ClosingNode("joint_controllers")
    asked = read(composition, CompositionParameters)
    loops = _loops_of(composition, asked.controllers_file) if asked.controllers_file else {}
    joints = list(asked.joints or loops)
    if loops:
        require_known(f"joint of {asked.controllers_file}", joints, loops)
    if not joints or len(set(joints)) != len(joints):
        raise SettingError(f"the parameter joints must name each joint once, not {joints}")
    require_node_names(joints, SettingError)
    waiting = Waiting(composition)  # six joints that wait for the same are one line
    merger = None
    if asked.merge:
        merger = JointCommandMerger(joints=joints, is_composed=True, waiting=waiting)
    sinks: Sinks = SINKS
    shared = SharedTopics(composition) if asked.share_messages else None
    if shared is not None:
        sinks = {**SINKS, JOINT_STATE_INTERFACE: shared.sink}
    if merger is not None:
        sinks = {MERGED: merger.sink}
    controllers = [
        JointController(
            controller_name(joint),
            sinks,
            shared,
            waiting,
            loops.get(joint, {}),
            parameter_overrides=[
                Parameter("joint", value=joint),
                *([] if merger is None else [Parameter("command_interface", value=MERGED)]),
            ],
        )
        for joint in joints
    ]
    # The merger is left last: it sends what the controllers leave their joints with.
    return [composition, *controllers, *([] if merger is None else [merger])]


def _loops_of(node: executor.ClosingNode, file: str) -> dict[str, dict[str, Value]]:
    """Return what a file says of each joint's loop; log what of ros2_control's is not taken."""
    path = Path(file)
    document = load_yaml(path, SettingError)
    for line in parameters_from(document, file).remarks:
        node.get_logger().warning(line)
    return {str(each["joint"]): each for each in parameters_in_file(document, file).values()}


USAGE = Usage(
    "joint_controllers",
    "Controls joints in one process, each with a node JOINT_controller of its own, whose "
    "parameters, topics and services joint_controller --help tells; with merge also a node "
    "joint_command_merger, as its --help tells.",
    "-p joints:=[JOINT, ...] --params-file FILE",
    names_of(CompositionParameters),
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(make_nodes, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())

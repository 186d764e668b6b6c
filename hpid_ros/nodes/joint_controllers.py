"""All joints of a configuration in one process, still one node for each joint."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rclpy.parameter import Parameter
from rclpy.validate_node_name import validate_node_name

from hpid_ros.base.errors import SettingError
from hpid_ros.base.names import controller_name
from hpid_ros.nodes.joint_controller import JointController
from hpid_ros.nodes.ros import executor
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.nodes.ros.usage import Usage


class Composition(executor.ClosingNode):
    """Says which joints are controlled in this process."""

    def __init__(self) -> None:
        super().__init__("joint_controllers")
        self.joints: Sequence[str] = (
            read_only(
                self,
                "joints",
                Parameter.Type.STRING_ARRAY,
                "Joints to control; each gets the node JOINT_controller, with its parameters",
            )
            or ()
        )


def make_nodes() -> list[executor.ClosingNode]:
    """Make one controller for each joint of the parameter ``joints``.

    Raises:
        SettingError: The parameter names no joint, or one twice.
        InvalidNodeNameException: A joint's name has a character that a node's may not have.
    """
    composition = Composition()
    joints = list(composition.joints)
    for joint in joints:
        validate_node_name(controller_name(joint))
    if not joints or len(set(joints)) != len(joints):
        raise SettingError(f"the parameter joints must name each joint once, not {joints}")
    controllers = [
        JointController(
            controller_name(joint),
            parameter_overrides=[Parameter("joint", Parameter.Type.STRING, joint)],
        )
        for joint in joints
    ]
    return [composition, *controllers]


USAGE = Usage(
    "joint_controllers",
    "Controls joints in one process, each with a node JOINT_controller of its own, whose "
    "parameters, topics and services joint_controller --help tells.",
    "-p joints:=[JOINT, ...] --params-file FILE",
    ["joints"],
)


def main(args: Sequence[str] | None = None) -> int:
    """Run the controllers."""
    return executor.run(make_nodes, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())

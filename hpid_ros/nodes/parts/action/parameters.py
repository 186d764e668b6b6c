"""The parameters of a group of joints that follows goals."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.resources import find_resource
from hpid_ros.goals import (
    FIXED_PARAMETERS,
    GOAL_PARAMETERS,
    GroupSettings,
    JointFacts,
    joint_parameters,
    require_joints,
)
from hpid_ros.nodes.ros.parameters import declare, read_only
from hpid_ros.robot.description import RobotDescription


class GroupParameters:
    """Makes of a node's parameters the settings of its group."""

    def __init__(self, node: Node) -> None:
        self._node = node
        names = Parameter.Type.STRING_ARRAY
        self.joints = tuple(
            read_only(node, "joints", names, "Joints that follow goals, in the order of feedback")
            or ()
        )
        require_joints(self.joints)
        wrapping = read_only(
            node, "angle_wraparound", names, "Joints whose controllers have angle_wraparound"
        )
        counting = read_only(node, "multi_turn", names, "Joints whose controllers have multi_turn")
        self.state_topics = tuple(
            read_only(node, "state_topics", names, "Topics that hold the states of the joints")
            or ("joint_states",)
        )
        if len(set(self.state_topics)) < len(self.state_topics) or "" in self.state_topics:
            raise SettingError(
                f"the parameter state_topics must name each topic once, not "
                f"{list(self.state_topics)}"
            )
        source = read_only(
            node,
            "robot_description",
            "",
            "URDF of the robot, XML text or path: positions in which joints stop, and which of "
            "them turn without end",
        )
        self._facts = joint_facts(self.joints, str(source), wrapping or (), counting or ())
        specs = (*GOAL_PARAMETERS, *chain(*map(joint_parameters, self.joints)))
        self._names = [spec.name for spec in (*FIXED_PARAMETERS, *specs)]
        declare(node, FIXED_PARAMETERS, read_only=[spec.name for spec in FIXED_PARAMETERS])
        declare(node, specs)
        self.settings()

    def settings(self, changes: Sequence[Parameter] = ()) -> GroupSettings:
        """Return the settings that would be in force after a change."""
        values = {name: self._node.get_parameter(name).value for name in self._names}
        values.update({each.name: each.value for each in changes if each.name in values})
        return GroupSettings.from_parameters(self.joints, self._facts, values)

    def verdict(self, changes: Sequence[Parameter]) -> SetParametersResult:
        """Say whether a change can be put in force."""
        try:
            self.settings(changes)
        except HpidError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def joint_facts(
    joints: Sequence[str], source: str, wrapping: Sequence[str], counting: Sequence[str]
) -> dict[str, JointFacts]:
    """Return what is known of joints."""
    require_joints(joints, wrapping, counting)
    facts = {joint: JointFacts() for joint in joints}
    if source:
        path = source if source.lstrip().startswith("<") else str(find_resource(source))
        for joint in RobotDescription.load(path).select(joints):
            is_endless = joint.type == "continuous"
            facts[joint.name] = JointFacts(
                joint.lower,
                joint.upper,
                is_endless,
                takes_shorter_way=is_endless and joint.name not in counting,
                unit="m" if joint.type == "prismatic" else "rad",
            )
    for name in wrapping:
        facts[name] = facts[name]._replace(is_endless=True, takes_shorter_way=True)
    return facts

"""Writes the SROS 2 policy of the node set: ``python tools/make_policy.py [JOINT ...] > FILE``.

Without joints it writes ``config/sros2/policy.xml``, for the simulated robot. docs/security.md
says how to use it. Format: ROS 2 Access Control Policies, version 0.2.0 (design.ros2.org).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from xml.etree import ElementTree

from hpid_ros.base.names import ALL_JOINTS_CLAIM, claim_topic, controller_name
from hpid_ros.base.resources import find_resource, share_folder
from hpid_ros.robot.description import RobotDescription

_PARAMETERS = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)
_LIFECYCLE = (
    "change_state",
    "get_state",
    "get_available_states",
    "get_available_transitions",
    "get_transition_graph",
)
_BRIDGES = ("pybullet_bridge", "mujoco_bridge")
_BRIDGE_SERVICES = (
    "pause",
    "step",
    "reset",
    "grip",
    # of simulation_interfaces, where that is installed
    "get_simulator_features",
    "get_simulation_state",
    "set_simulation_state",
    "reset_simulation",
    "step_simulation",
)
_POSES = ("odom", "base_pose_ground_truth", "wheel_slip", "ee_pose", "brick_poses", "grip_events")
_MERGER = "joint_command_merger"
_MERGED = ("~/commands", "joint_command", "dynamic_joint_commands", "/effort_controller/commands")
ACTION_SERVER = "joint_trajectory_controller"
_RECORDED = ("joint_trajectory", "joint_commands", "joint_states", *_POSES)


def policy(joints: Iterable[str]) -> ElementTree.Element:
    """Return the policy: one enclave for each process, and one for whoever may retune.

    Args:
        joints: The driven joints.
    """
    joints = list(joints)
    root = ElementTree.Element("policy", version="0.2.0")
    enclaves = ElementTree.SubElement(root, "enclaves")
    controllers = [controller_name(joint) for joint in joints]
    for name, joint in zip(controllers, joints, strict=True):
        profile = _profile(enclaves, name, name)
        _allow(
            profile,
            publish=(
                "joint_commands",
                "~/commands",
                "~/command",
                "~/reference",
                "~/terms",
                "~/estimate",
                "~/transition_event",
                "/diagnostics",
                *_claims(joint),
            ),
            subscribe=(
                "joint_states",
                "joint_trajectory",
                "~/setpoint",
                "~/relay",
                *_claims(joint),
            ),
            reply=(f"~/{service}" for service in _LIFECYCLE),
        )
    claims = [claim_topic(commands, ALL_JOINTS_CLAIM) for commands in _MERGED]
    _allow(
        _profile(enclaves, "merger", _MERGER),  # as in config/ros2_control
        publish=(*_MERGED, "~/transition_event", "/diagnostics", *claims),
        subscribe=("joint_commands", "/controller_manager/activity", "/diagnostics", *claims),
        reply=(f"~/{service}" for service in _LIFECYCLE),
        request=("/effort_controller/get_parameters",),
    )
    for profile in _profiles(enclaves, "robot", _BRIDGES):
        _allow(
            profile,
            publish=("joint_states", "robot_description", "clock", *_POSES, "/diagnostics"),
            subscribe=("joint_commands", "~/wrench"),
            reply=(f"~/{service}" for service in _BRIDGE_SERVICES),
        )
    profile = _profile(enclaves, "reference", "trajectory_publisher")
    _allow(profile, publish=("joint_trajectory",), subscribe=("joint_states",))
    profile = _profile(enclaves, "goals", ACTION_SERVER)
    _allow(
        profile,
        publish=("joint_trajectory", "/diagnostics"),
        subscribe=(
            "joint_states",
            "joint_trajectory",
            *(f"/{name}/reference" for name in controllers),
        ),
    )
    _allow(profile, execute=("~/follow_joint_trajectory",))
    _allow(
        _profile(enclaves, "recorder", "bag_recorder"),
        publish=("/diagnostics",),
        subscribe=_RECORDED,
    )
    profile = _profile(enclaves, "operator", "operator")
    _allow(profile, call=(f"/{ACTION_SERVER}/follow_joint_trajectory",))
    _allow(
        profile,
        publish=(
            *(f"/{name}/setpoint" for name in controllers),
            *(f"/{name}/relay" for name in controllers),
            *(f"/{name}/wrench" for name in _BRIDGES),
        ),
        subscribe=("/diagnostics", *_RECORDED),
        request=[
            f"/{name}/{each}"
            for name in (*controllers, _MERGER)
            for each in (*_PARAMETERS, *_LIFECYCLE)
        ]
        + [f"/{name}/{each}" for name in _BRIDGES for each in _BRIDGE_SERVICES],
    )
    ElementTree.indent(root)
    return root


def _claims(joint: str) -> list[str]:
    """Return where a joint is claimed, by the message of its commands."""
    topics = ("joint_commands", "~/commands", "~/command")
    return [claim_topic(commands, joint) for commands in topics]


def _profile(enclaves: ElementTree.Element, name: str, node: str) -> ElementTree.Element:
    """Add an enclave of one node, with what every node has."""
    (profile,) = _profiles(enclaves, name, [node])
    return profile


def _profiles(
    enclaves: ElementTree.Element, name: str, nodes: Iterable[str]
) -> list[ElementTree.Element]:
    """Add an enclave of nodes that stand in for each other, with what every node has."""
    enclave = ElementTree.SubElement(enclaves, "enclave", path=f"/hpid/{name}")
    parent = ElementTree.SubElement(enclave, "profiles")
    profiles = [ElementTree.SubElement(parent, "profile", ns="/", node=node) for node in nodes]
    for profile in profiles:
        _allow(
            profile,
            publish=("/rosout", "/parameter_events"),
            subscribe=("/parameter_events", "/clock"),
            reply=(*(f"~/{service}" for service in _PARAMETERS), "~/get_type_description"),
        )
    return profiles


def _allow(profile: ElementTree.Element, **rules: Iterable[str]) -> None:
    """Add rules: those of topics, of services (request, reply) and of actions (call, execute)."""
    kinds = {"publish": "topic", "subscribe": "topic", "call": "action", "execute": "action"}
    for rule, names in rules.items():
        kind = kinds.get(rule, "service")
        # What is not allowed in an enclave is denied.
        group = ElementTree.SubElement(profile, f"{kind}s", {rule: "ALLOW"})
        for name in names:
            ElementTree.SubElement(group, kind).text = name


def document(joints: Iterable[str]) -> str:
    """Return the policy as the text of a file.

    Args:
        joints: The driven joints.
    """
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<!-- Written by tools/make_policy.py. -->\n'
    return head + ElementTree.tostring(policy(joints), encoding="unicode") + "\n"


def main() -> None:
    """Write the policy of the joints that were named, or the file of the package."""
    if len(sys.argv) > 1:
        sys.stdout.write(document(sys.argv[1:]))
        return
    robot = RobotDescription.load(find_resource("urdf/mobile_manipulator.urdf"))
    file = share_folder() / "config" / "sros2" / "policy.xml"
    file.parent.mkdir(exist_ok=True)
    file.write_text(document(robot.joints), encoding="utf-8")


if __name__ == "__main__":
    main()

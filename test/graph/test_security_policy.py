"""The policy for DDS security allows what the nodes do, and nobody else to command a joint."""

import subprocess
import sys
from functools import partial
from xml.etree import ElementTree

import pytest
from harness.goals import ACTION, needs_control_msgs
from harness.graph import ros_arguments
from harness.places import ROOT
from rclpy.action import get_action_server_names_and_types_by_node

from hpid_ros.simulation.settings import ENGINES

POLICY = ROOT / "config" / "sros2" / "policy.xml"


def rules(node, rule):
    """Return the full names that a node's enclave allows."""
    (profile,) = ElementTree.parse(POLICY).iterfind(f".//profile[@node='{node}']")
    names = set()
    for group in profile:
        if group.get(rule) == "ALLOW":
            names |= {absolute(node, each.text) for each in group}
    return names


def absolute(node, name):
    return name.replace("~", f"/{node}") if name.startswith("~") else f"/{name.lstrip('/')}"


def controllers():
    """Return the nodes of joints: they tell their references."""
    nodes = [each.get("node") for each in ElementTree.parse(POLICY).iterfind(".//profile")]
    return [node for node in nodes if f"/{node}/reference" in rules(node, "publish")]


def test_the_file_is_what_the_script_writes(tmp_path):
    joints = [
        profile.get("node").removesuffix("_controller")
        for profile in ElementTree.parse(POLICY).iterfind(".//profile")
        if profile.get("node") in controllers()
    ]
    written = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "make_policy.py"), *joints],
        capture_output=True,
        text=True,
        check=True,
    )
    assert written.stdout == POLICY.read_text()
    assert len(joints) == 8


def test_only_controllers_may_command_and_only_the_robot_may_tell_states():
    nodes = [each.get("node") for each in ElementTree.parse(POLICY).iterfind(".//profile")]
    commanders = {node for node in nodes if "/joint_commands" in rules(node, "publish")}
    assert commanders == set(controllers())
    robots = [node for node in nodes if "/joint_states" in rules(node, "publish")]
    assert robots == [f"{engine}_bridge" for engine in ENGINES]
    setters = {n for n in nodes if any("set_parameters" in s for s in rules(n, "request"))}
    assert setters == {"operator"}


@pytest.mark.parametrize(
    ("node", "executable", "parameters"),
    [
        ("joint_command_merger", "joint_command_merger", {"controller": "effort_controller"}),
        ("joint_command_merger", "joint_command_merger", {"joints": "[elbow]"}),
        (
            "joint_command_merger",
            "joint_command_merger",
            {"joints": "[elbow]", "command_interface": "joint_state"},
        ),
        ("arm_joint_1_controller", "joint_controller", {"joint": "arm_joint_1"}),
        ("mujoco_bridge", "mujoco_bridge", {"fixed_base": True}),
        (
            "trajectory_publisher",
            "trajectory_publisher",
            {"reference_file": ROOT / "config" / "experiments" / "paper.yaml"},
        ),
        pytest.param(
            ACTION,
            "follow_joint_trajectory",
            {"joints": "[arm_joint_1]"},
            marks=needs_control_msgs,
        ),
    ],
)
def test_a_node_does_nothing_that_its_enclave_forbids(harness, node, executable, parameters):
    harness.processes.start(node, executable, ros_arguments(**parameters))
    graph = harness.node
    harness.wait(lambda: harness.is_there(node), what=node)
    asked = (
        ("publish", graph.get_publisher_names_and_types_by_node),
        ("subscribe", graph.get_subscriber_names_and_types_by_node),
        ("reply", graph.get_service_names_and_types_by_node),
    )
    service = f"/{node}/set_parameters"
    names = lambda find: {name for name, _ in find(node, "/")}  # noqa: E731
    harness.wait(lambda: service in names(asked[2][1]), what="its services")
    if executable == "joint_controller":
        harness.wait(lambda: "/joint_commands" in names(asked[0][1]), what="its commands")
    for rule, find in asked:
        asked_for = {name for name in names(find) if "/_action/" not in name}
        assert asked_for <= rules(node, rule), rule
    actions = partial(get_action_server_names_and_types_by_node, graph)
    harness.wait(lambda: names(actions) == rules(node, "execute"), what="its actions")

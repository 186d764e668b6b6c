"""Joints whose names other languages read as something else: YAML, ROS, shells, folders."""

import re
import subprocess
import sys

import numpy as np
import pytest
import rclpy
import yaml
from harness.examples import examples
from harness.fork_server import run_node
from harness.goals import ACTION, SUCCEEDED, Client, Joints, goal_of, needs_control_msgs
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.srv import GetParameters

from hpid_bench.experiment.compare import run_comparison
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.graph_run import GraphOptions
from hpid_bench.experiment.in_process import NoProgress
from hpid_bench.experiment.processes import parameters
from hpid_ros.base.names import controller_name
from hpid_ros.base.yaml_text import dump_yaml, inline_yaml
from hpid_ros.messages.run import read_run

JOINTS = ("left-arm 1", "1st", "a.b", "a_b", "Größe", "y")
WORDS = [  # launch_ros#410, ros2#1039, rclcpp#1983, and what else a parser has a meaning for
    "y",
    "n",
    "Y",
    "N",
    "yes",
    "no",
    "on",
    "off",
    "True",
    "null",
    "~",
    "",
    " a",
    "a: b",
    "#x",
    "inf",
    "-inf",
    ".inf",
    "nan",
    "NaN",
    "nan(1)",
    "1e5",
    "0x10",
    "010",
    "1_000",
    "1:30",
    "+1",
    "2026-11-28",
    "-",
    "?",
    "&a",
    "*a",
    "!a",
    "|",
    ">",
    "%",
    "@",
    "`",
    "[",
    "]",
    "{",
    "}",
    ",",
    "'",
    '"',
    "\\",
    "a\nb",
    "\n",
    "\t",
    "\r\n",
    " ",
    "ä",
    "\x7f",
    "\x85",
    "\u2028",
    "\ufeff",
    "---",
    "...",
    "<<",
    "=",
    "a #b",
    "a  b",
    "\U0001f600",
    "!!str 1",
    "${x}",
    "$(x)",
]
TEXTS = st.one_of(
    st.sampled_from(WORDS),
    st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")),
)


def read_by_ros(harness, *arguments):
    """Return the parameters of a node ``n`` that was given ROS arguments."""
    context = rclpy.Context()
    rclpy.init(args=["n", "--ros-args", *arguments], context=context)
    try:
        node = rclpy.create_node("n", context=context, enable_rosout=False)
        given = {name: each.value for name, each in node._parameter_overrides.items()}
        node.destroy_node()
    finally:
        context.shutdown()
    return given


@given(st.lists(TEXTS, min_size=1), st.dictionaries(TEXTS.filter(bool), TEXTS))
def test_ros_reads_from_a_parameter_file_what_was_written(
    module_harness, tmp_path_factory, texts, by_name
):
    texts += WORDS
    for at, text in enumerate(texts):
        by_name[f"text.{at}"] = text
    ranges = {name: [0.1, 0.2] for name in by_name}
    groups = [("joints", by_name), ("ranges", ranges)]
    document = {
        "/**/n": {"ros__parameters": {"texts": texts, **dict(groups)}},
        "/**/y": {"ros__parameters": ranges},
    }
    file = tmp_path_factory.mktemp("file") / "params.yaml"
    file.write_text(dump_yaml(document), encoding="utf-8")
    read = read_by_ros(module_harness, "--params-file", str(file))
    flat = {f"{group}.{name}": value for group, own in groups for name, value in own.items()}
    assert read == {"texts": texts, **flat}
    assert yaml.safe_load(file.read_text(encoding="utf-8")) == document


@given(st.lists(TEXTS, min_size=1), TEXTS)
def test_ros_reads_on_the_command_line_what_was_given(module_harness, texts, text):
    values = {"texts": texts, "text": text, "number": 1e-5, "is_on": True}
    assert read_by_ros(module_harness, *parameters(**values)) == values


@pytest.mark.parametrize("text", ["a\0b", "a\udc80"])
def test_what_no_file_can_hold_is_refused(text):
    with pytest.raises(ValueError, match="cannot be written to a file"):
        dump_yaml({"joint": text})


@examples(4)
@given(st.lists(TEXTS, min_size=1))
def test_within_a_line_too(texts):
    """As for the files that ``hpid upgrade`` and ``hpid gains`` print with comments."""
    lines = [f"    {inline_yaml(text)}: [{inline_yaml(text)}]  # x\n" for text in texts]
    assert yaml.safe_load("".join(lines)) == {text: [text] for text in texts}
    assert yaml.safe_load(f"a: {inline_yaml(texts)}") == {"a": texts}


def test_a_joint_called_y_is_told_how_to_write_it(harness):
    command = [sys.executable, "-m", "hpid_ros.nodes.joint_controller", "--ros-args"]
    command += ["-p", "joint:=y"]
    run = subprocess.run(
        command, env=harness.environment, capture_output=True, text=True, check=False
    )
    (line,) = run.stderr.splitlines()
    assert run.returncode == 2
    assert "booleans to ROS" in line
    assert """write '"y"'""" in line


def test_a_list_of_x_and_y_is_told_what_is_the_matter(harness, tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text("/**: {ros__parameters: {joints: [x, y]}}\n")
    ended = run_node("joint_controllers", ["--params-file", str(file)])
    assert ended.returncode == 2
    assert "without quotes y, n, yes, no, on and off are booleans to ROS" in ended.stderr


def write_robot(folder):
    """Write an experiment with a gantry of all these joints, and return where."""
    links = "".join(
        f'<link name="l{at}"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for at in range(len(JOINTS))
    )
    joints = "".join(
        f'<joint name="{name}" type="prismatic"><parent link="{f"l{at - 1}" if at else "base"}"/>'
        f'<child link="l{at}"/><axis xyz="{at % 2} {(at + 1) % 2} 0"/>'
        '<limit lower="-1" upper="1" effort="200" velocity="2"/></joint>'
        for at, name in enumerate(JOINTS)
    )
    (folder / "gantry.urdf").write_text(
        f'<robot name="gantry"><link name="base"/>{links}{joints}</robot>', encoding="utf-8"
    )
    gains = {"p": 2400.0, "i": 9600.0, "d": 180.0}
    document = {
        "name": "gantry",
        "robot": {"description": "gantry.urdf", "fixed_base": True},
        "simulation": {"engine": "mujoco", "physics_steps": 1},
        "control": {"rate": 500, "answer_timeout": 120.0},
        "duration": 0.1,
        "reference": {
            "kind": "minimum_jerk",
            "times": [0.0, 0.1],
            "positions": {name: [0.0, 0.1] for name in JOINTS},
        },
        "controllers": {"joints": {name: {"gains": gains, "inertia": 3.0} for name in JOINTS}},
        "compare": {"PID": {"law": "pid"}},
    }
    file = folder / "gantry.yaml"
    file.write_text(dump_yaml(document), encoding="utf-8")
    return file


def test_the_graph_answers_as_the_loops_in_this_process_do(tmp_path):
    """robot_assembler#75, gz-sim#447: hyphens, blanks, dots and digits in joints' names."""
    experiment = load_experiment(write_robot(tmp_path))
    runs = []
    for name, is_here in (("graph", False), ("here", True)):
        options = GraphOptions(processes="each")
        folder = tmp_path / name
        run_comparison(experiment, folder, NoProgress(), options=options, in_process=is_here)
        runs.append({each.joint: each for each in read_run(folder / "bags" / "PID", "run").joints})
    graph, here = runs
    assert set(graph) == set(here) == set(JOINTS)
    for joint in JOINTS:
        assert np.array_equal(graph[joint].effort, here[joint].effort)


@needs_control_msgs
def test_goals_are_followed_by_joints_of_any_name(harness, tmp_path):
    joints = Joints(harness, JOINTS)
    file = tmp_path / "action.yaml"
    # In one key: rcl loses its place behind a mapping whose key has a dot.
    section = {"ros__parameters": {f"constraints.{name}.goal": 0.05 for name in JOINTS}}
    file.write_text(dump_yaml({"/**": section}), encoding="utf-8")
    joints.start(arguments=["--params-file", str(file)])
    request = GetParameters.Request(names=["constraints.left-arm 1.goal"])
    answer = harness.call(GetParameters, f"{ACTION}/get_parameters", request)
    assert answer.values[0].double_value == 0.05
    harness.wait(lambda: harness.is_there("left_u002d_arm_u0020_1_controller"))
    assert all(harness.is_there(controller_name(joint)) for joint in JOINTS)
    client = Client(joints)
    status, _, text = client.follow(goal_of({name: [0.1] for name in JOINTS}, [0.3]))
    assert status == SUCCEEDED, text
    assert all(abs(joints.position[name] - 0.1) < 0.05 for name in JOINTS)
    client.close()


def test_a_name_forges_no_line_of_a_log(harness):
    name = "a\n[ERROR] [1.0] [robot]: on fire \x1b[31m"
    process = harness.processes.start(
        controller_name(name),
        "joint_controller",
        parameters(joint=name, state_clock="simulated", wait_for_command_subscribers=0),
    )
    harness.wait(lambda: harness.states.get_subscription_count() > 0, what="the controller")
    harness.ask_newcomer(0, 0.5, joint=name)
    harness.wait(lambda: "active: joint" in process.log.read_text(), what="its line")
    lines = process.log.read_text().splitlines()
    assert all(re.match(r"\[(INFO|WARN)\]", line) for line in lines)
    assert all(line.isprintable() for line in lines)

"""What needs control_msgs says so in one line where it is missing, and nothing else needs it."""

import re
import subprocess
import sys

import pytest

WITHOUT = "import sys; sys.modules['control_msgs'] = None; "


@pytest.mark.parametrize(
    ("node", "parameters", "said"),
    [
        ("follow_joint_trajectory", [], r"control_msgs is not installed.* ros-jazzy-control-msgs"),
        (
            "joint_command_merger",
            ["-p", "command_interface:=dynamic_joint_state"],
            r".* needs the package control_msgs",
        ),
    ],
)
def test_a_node_names_what_is_missing_in_one_line(node, parameters, said):
    arguments = ["x", "--ros-args", "-p", "joints:=[elbow]", *parameters]
    program = (
        f"{WITHOUT}from hpid_ros.nodes import {node} as node; sys.exit(node.main({arguments}))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    (line,) = ended.stderr.strip().splitlines()
    assert re.match(said, line)

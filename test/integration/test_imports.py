"""What takes long to import is imported by who needs it, and not by every node and command."""

import subprocess
import sys

import pytest
from harness.bags import small_log, write_bag

pytestmark = pytest.mark.repository

SLOW = {"matplotlib", "mujoco", "pinocchio", "pybullet", "scipy"}
NODES = (
    *("joint_controller", "joint_controllers", "single_process", "pybullet_bridge"),
    *("mujoco_bridge", "trajectory_publisher", "bag_recorder", "follow_joint_trajectory"),
)


def imported_by(program, *arguments):
    """Return the modules that a program has imported when it ends."""
    program += "; import sys; print(*sys.modules, file=sys.stderr)"
    command = [sys.executable, "-c", program, *map(str, arguments)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(ended.stderr.splitlines()[-1].split())


def test_none_of_it_is_imported_when_nodes_start():
    modules = {*(f"hpid_ros.nodes.{name}" for name in NODES), "hpid_ros.live.live_tuner"}
    imported = imported_by(f"import {', '.join(modules)}")
    assert modules <= imported
    assert not SLOW & imported


def test_the_help_waits_for_no_library():
    assert not {"numpy", "rich", "yaml", "rosbags"} & imported_by("import hpid_ros.cli.main")


def test_the_recording_of_a_robot_is_measured_without_the_simulated_one(tmp_path):
    """And without rosbags' message types, which take as long as the measuring."""
    bag = write_bag(tmp_path / "run", small_log())
    program = "import sys; from hpid_ros.cli.main import main; main(sys.argv[1:])"
    imported = imported_by(program, "metrics", bag)
    assert "numpy" in imported
    assert not (SLOW | {"rosbags", "jinja2", "joblib", "rclpy"}) & imported

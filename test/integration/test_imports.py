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


def test_none_of_it_is_imported_when_nodes_start():
    modules = [*(f"hpid_ros.nodes.{name}" for name in NODES), "hpid_ros.live.live_tuner"]
    program = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    command = [sys.executable, "-c", program]
    imported = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert set(modules) <= set(imported)
    assert not SLOW & set(imported)


def test_the_help_waits_for_no_library():
    program = "import sys, hpid_ros.cli.main; print(*sys.modules)"
    command = [sys.executable, "-c", program]
    imported = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "rich", "yaml", "rosbags"} & set(imported)


def test_the_recording_of_a_robot_is_measured_without_the_simulated_one(tmp_path):
    """And without rosbags' message types, which take as long as the measuring."""
    bag = write_bag(tmp_path / "run", small_log())
    program = (
        "import sys; from hpid_ros.cli.main import main; "
        "main(sys.argv[1:]); print(*sys.modules, file=sys.stderr)"
    )
    command = [sys.executable, "-c", program, "metrics", str(bag)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    imported = set(ended.stderr.splitlines()[-1].split())
    assert not (SLOW | {"rosbags", "jinja2", "joblib", "rclpy"}) & imported

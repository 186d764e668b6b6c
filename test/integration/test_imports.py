"""What takes long to import is imported by who needs it, and not by every node and command."""

import subprocess
import sys

import pytest

SLOW = {"matplotlib", "mujoco", "pinocchio", "pybullet", "scipy"}
NODES = (
    *("joint_controller", "joint_controllers", "single_process", "pybullet_bridge"),
    *("mujoco_bridge", "trajectory_publisher", "bag_recorder", "follow_joint_trajectory"),
)


@pytest.mark.parametrize(
    "modules",
    [["hpid_ros.cli.main"], [f"hpid_ros.nodes.{name}" for name in NODES]],
    ids=["hpid", "nodes"],
)
def test_none_of_it_is_imported_at_the_start(modules):
    program = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    command = [sys.executable, "-c", program]
    imported = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert set(modules) <= set(imported)
    assert not SLOW & set(imported)

"""What the bridge says on its console: who answers, and who does not."""

import itertools

from harness.graph import ros_arguments

from hpid_ros.base.files import share_folder
from hpid_ros.experiment.in_process import write_document

WORLD = {
    "robot": {
        "description": str(share_folder() / "urdf" / "mobile_manipulator.urdf"),
        "driven": ["arm_joint_1", "arm_joint_2"],
        "fixed_base": True,
    }
}


def test_joints_that_nobody_answers_for_are_named_once_until_somebody_does(harness, tmp_path):
    write_document(tmp_path / "world.yaml", WORLD)
    arguments = ros_arguments(
        world_file=tmp_path / "world.yaml",
        mode="realtime",
        control_rate=100.0,
        wait_for_subscribers=1,
    )
    bridge = harness.processes.start("mujoco_bridge", "mujoco_bridge", arguments)

    def said(line):
        return bridge.log.read_text().count(line)

    harness.wait(lambda: said("waiting for controllers"), what="a bridge that waits")
    controller = harness.processes.start(
        "joint_controllers",
        "joint_controllers",
        [*ros_arguments(law="pid", gains__p=1.0), "-p", "joints:=[arm_joint_1, arm_joint_2]"],
        is_renamed=False,
    )
    harness.wait(lambda: said(": running"), what="answers")
    lost = "no answer from arm_joint_1, arm_joint_2"
    answered, before = said(": running"), said(lost)  # they may have been late at first
    controller.process.kill()
    harness.wait(lambda: said(lost) > before, what="silence")
    controller = harness.processes.start(
        "again",
        "joint_controllers",
        [*ros_arguments(law="pid", gains__p=1.0), "-p", "joints:=[arm_joint_1, arm_joint_2]"],
        is_renamed=False,
    )
    harness.wait(lambda: said(": running") > answered, what="answers again")
    lines = [line.rpartition("]: ")[2] for line in bridge.log.read_text().splitlines()]
    told = [line for line in lines if line == "running" or line.startswith("no answer from")]
    assert all(one != other for one, other in itertools.pairwise(told))  # each is named once

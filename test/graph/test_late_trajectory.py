"""A latched trajectory from before a goal, whose publisher is found in the middle of it."""

import os
import signal

from harness.goals import SUCCEEDED, Client, Joints, goal_of, needs_control_msgs
from harness.graph import ros_arguments
from harness.trajectories import from_message
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.nodes.core.middleware import LATCHED

pytestmark = needs_control_msgs

REFERENCE = """
reference:
  kind: minimum_jerk
  times: [0.0, 0.5]
  positions: {shoulder: [0.0, 0.1], elbow: [0.0, 0.1]}
"""


def test_a_publisher_that_is_found_late_has_sent_nothing_new(harness, tmp_path):
    file = tmp_path / "motion.yaml"
    file.write_text(REFERENCE)
    joints = Joints(harness)
    joints.start()
    arguments = ros_arguments(reference_file=file)
    publisher = harness.processes.start("reference", "trajectory_publisher", arguments)
    joints.run(lambda: min(joints.position.values()) > 0.09, what="the first motion")
    joints.run_for(1.0)
    os.kill(publisher.process.pid, signal.SIGSTOP)  # nobody who comes now finds it
    late = joints.start_action("late")
    joints.run(lambda: "ready for goals" in late.log.read_text(), what="states at the action")
    client, heard = Client(joints, "late"), []
    harness.node.create_subscription(
        JointTrajectory, "joint_trajectory", lambda each: heard.append(from_message(each)), LATCHED
    )
    sent = client.send(goal_of({"shoulder": [0.4], "elbow": [-0.2]}, [4.0]))
    joints.run(lambda: joints.position["shoulder"] > 0.15, what="the joints to move")
    os.kill(publisher.process.pid, signal.SIGCONT)
    joints.run(lambda: (0.1, 0.1) in [each.points[-1].positions for each in heard], what="it")
    assert client.result(sent) == (SUCCEEDED, 0, "goal reached")

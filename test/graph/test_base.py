"""A bridge publishes odometry, the truth and the slip of a base."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from harness.graph import ros_arguments
from harness.places import URDF
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hpid_ros.experiment.in_process import write_document
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.middleware import LATCHED, OFFERED

WHEELS = ("wheel_left_joint", "wheel_right_joint")


class Listener:
    """Keeps the last message of each topic of a bridge."""

    def __init__(self, harness):
        self.last = {}
        for kind, topic in (
            (Odometry, "odom"),
            (Odometry, "base_pose_ground_truth"),
            (Vector3Stamped, "wheel_slip"),
            (DiagnosticArray, "/diagnostics"),
        ):

            def keep(message, topic=topic):
                self.last[topic] = message

            harness.node.create_subscription(kind, topic, keep, 10)

    def x(self, topic):
        message = self.last.get(topic)
        return None if message is None else message.pose.pose.position.x

    def figures(self):
        message = self.last.get("/diagnostics")
        return (
            {} if message is None else {each.key: each.value for each in message.status[0].values}
        )


def test_a_live_bridge_tells_odometry_truth_and_slip(harness, tmp_path):
    base = {"left_wheel": WHEELS[0], "right_wheel": WHEELS[1]}
    robot = {"description": "urdf/mobile_manipulator.urdf", "base": base}
    write_document(tmp_path / "world.yaml", {"robot": robot})
    listener = Listener(harness)
    arguments = ros_arguments(
        world_file=tmp_path / "world.yaml",
        encoder_counts=[4096] * 8,
        mode="realtime",
        control_rate=200.0,
        real_time_factor=0.5,
        command_timeout=1000.0,
        wait_for_subscribers=0,
    )
    harness.processes.start("mujoco_bridge", "mujoco_bridge", arguments)
    harness.wait(lambda: "odom" in listener.last, what="odometry")
    commands = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    push = JointStateTemplate(WHEELS, effort=True).encode(0, effort=[0.8, 0.8])

    def is_far():
        commands.publish(push)
        return (listener.x("odom") or 0.0) > 0.1

    harness.wait(is_far, what="the base to drive")
    harness.wait(
        lambda: float(listener.figures().get("driven by the wheels [m]", 0.0)) > 0.1,
        what="/diagnostics",
    )
    odom, truth = listener.last["odom"], listener.last["base_pose_ground_truth"]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_footprint")
    assert (truth.header.frame_id, truth.child_frame_id) == ("odom", "base_footprint")
    covariance = np.array(odom.pose.covariance).reshape(6, 6)
    assert (covariance == covariance.T).all()
    assert 0.0 < covariance[0, 0] < 0.1
    assert covariance[2, 2] == 1e6  # height is not measured by wheels
    assert odom.pose.pose.position.z == 0.0
    assert odom.twist.twist.linear.x > 0.0
    slip = listener.last["wheel_slip"]
    assert slip.header.frame_id == "base_footprint"
    figures = listener.figures()
    assert {"slip of the left wheel [m]", "slip of the axle, sideways, recent [m]"} <= set(figures)
    client = harness.node.create_client(Trigger, "mujoco_bridge/reset")
    harness.wait(client.service_is_ready, what="the service")
    late = []
    harness.node.create_subscription(String, "robot_description", late.append, LATCHED)
    harness.wait(lambda: late, what="the description")
    assert late[0].data == URDF.read_text()
    client.call_async(Trigger.Request())
    harness.wait(lambda: listener.x("odom") < 0.05, what="odometry to start again")

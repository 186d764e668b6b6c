"""What people reported of simulated robots: arms that fall at the start, and after a reset."""

import numpy as np
from harness.graph import ros_arguments
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from hpid_ros.experiment.in_process import write_document
from hpid_ros.messages.joint_state import decode_joint_state
from hpid_ros.nodes.core.middleware import ALL_COMMANDS

START, ASKED = -1.2, -2.4  # [rad] a horizontal arm, which falls towards 0; up from there
URDF = """<robot name="arm"><link name="base"/>
<joint name="elbow" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<origin rpy="3.14159265 0 0"/><limit lower="-3" upper="3" effort="60" velocity="6"/></joint>
<link name="arm"><inertial><origin xyz="0 0 0.3"/><mass value="2"/>
<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def test_an_arm_falls_neither_before_its_controller_comes_nor_after_a_reset(harness, tmp_path):
    """As it comes out of the box: no parameter says that the robot is simulated.

    Slowly and with a long timeout: where a busy machine stands still, arms do fall.
    """
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(URDF)
    robot = {"description": str(urdf), "fixed_base": True, "initial_positions": {"elbow": START}}
    write_document(tmp_path / "world.yaml", {"robot": robot, "control": {"rate": 250}})
    seen = []
    keep = lambda raw: seen.append(decode_joint_state(raw))  # noqa: E731
    harness.node.create_subscription(JointState, "joint_states", keep, ALL_COMMANDS, raw=True)
    bridge = harness.processes.start(
        "mujoco_bridge",
        "mujoco_bridge",
        ros_arguments(world_file=tmp_path / "world.yaml", mode="realtime", real_time_factor=0.25),
    )
    harness.wait(lambda: "waiting" in bridge.log.read_text(), what="a bridge that waits")
    controller = harness.processes.start(
        "elbow_controller",
        "joint_controller",
        ros_arguments(
            joint="elbow",
            law="pid",
            robot_description=urdf,
            state_timeout=1.0,
            **{"gains__p": 200.0, "gains__i": 400.0, "gains__d": 20.0, "control_period": 0.004},
        ),
    )
    harness.wait(lambda: len(seen) > 50, what="states")
    assert max(abs(each.position[0] - START) for each in seen) < 0.05

    setpoint = harness.node.create_publisher(
        Float64, "elbow_controller/setpoint", QoSProfile(depth=1)
    )
    harness.wait(lambda: setpoint.get_subscription_count(), what="the controller")
    setpoint.publish(Float64(data=ASKED))
    harness.wait(lambda: abs(seen[-1].position[0] - ASKED) < 0.02, what="the arm to arrive")

    for _ in range(2):
        before = len(seen)
        harness.call(Trigger, "mujoco_bridge/reset", Trigger.Request())
        harness.wait(
            lambda before=before: (
                min(each.stamp_ns for each in seen[before:] or seen) < 1e9
                and len(seen) > before + 150
            ),
            what="states after the reset",
        )
        stamps = [each.stamp_ns for each in seen[before:]]
        again = before + int(np.argmin(stamps))
        positions = np.array([each.position[0] for each in seen[again:]])
        assert positions[0] == START
        assert positions.max() < START + 0.05  # it would fall that way
        assert positions.min() > ASKED - 0.1
    log = bridge.log.read_text()
    assert "commanded twice" not in log
    assert controller.log.read_text().count("state_clock is simulated") == 1

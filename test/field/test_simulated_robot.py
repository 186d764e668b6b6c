"""What people reported of simulated robots: arms that fall at the start, and after a reset."""

import numpy as np
from harness.graph import NAME, ros_arguments
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from hpid_bench.experiment.in_process import write_document
from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.nodes.core.middleware import ALL_COMMANDS

SECOND, MS = 1_000_000_000, 1_000_000
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


def states_of(harness, frame_id):
    """Return what publishes a state of a robot that says of itself what it is."""
    template = JointStateTemplate(["elbow"], frame_id, position=True, velocity=True)
    return lambda stamp_ns, position: harness.answer(
        stamp_ns,
        lambda: harness.states.publish(
            template.encode(stamp_ns, position=[position], velocity=[0.0])
        ),
        again_after=0.05,
    )


def clock_of(harness):
    request = GetParameters.Request(names=["state_clock"])
    return harness.call(GetParameters, f"{NAME}/get_parameters", request).values[0].string_value


def test_a_simulation_that_joins_a_real_robot_takes_no_watchdog_from_it(harness):
    """A controller that goes by a simulated clock does not mind how long no state comes."""
    controller = harness.start_controller(state_clock="wall")
    states_of(harness, "")(SECOND, 0.1)
    simulated = states_of(harness, "simulated")
    for k in range(1, 4):
        simulated(SECOND + k * MS, 0.1)
    assert clock_of(harness) == "wall"
    harness.wait(
        lambda: "are another source, and state_clock stays wall" in controller.log.read_text(),
        what="the line",
    )
    assert controller.log.read_text().count("another source") == 1


def test_a_real_robot_that_follows_on_a_simulated_one_has_its_watchdog_again(harness):
    controller = harness.start_controller(state_clock="wall")
    simulated, real = states_of(harness, "simulated"), states_of(harness, "")
    simulated(SECOND, 0.1)
    assert clock_of(harness) == "simulated"
    real(SECOND + MS, 0.1)
    assert clock_of(harness) == "wall"
    simulated(SECOND + 2 * MS, 0.1)
    assert clock_of(harness) == "wall"
    assert "not those of a simulated robot any more" in controller.log.read_text()

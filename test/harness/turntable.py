"""A robot of one joint in real time, in MuJoCo, with a controller."""

import time

import numpy as np
from sensor_msgs.msg import JointState

from harness.graph import ros_arguments
from hpid_ros.messages.joint_state import decode_joint_state
from hpid_ros.nodes.core.middleware import ALL_COMMANDS

INERTIA, VISCOUS, COULOMB = 0.05, 0.2, 0.1
URDF = f"""<robot name="turntable">
  <link name="world"/>
  <link name="table"><inertial><mass value="1.0"/>
    <inertia ixx="0.05" iyy="0.05" izz="{INERTIA}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="world"/><child link="table"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="10" velocity="4"/>
    <dynamics damping="{VISCOUS}" friction="{COULOMB}"/></joint>
</robot>"""
GAINS = {"gains__p": 21.6, "gains__i": 86.0, "gains__d": 1.8}


def start_turntable(harness, folder, mode="realtime", pace=1.0, **more):
    """Start the robot and its controller, with more parameters, and wait until they run.

    At a ``pace`` below 1 a busy machine may keep whoever answers waiting that much longer.
    In ``lockstep`` it waits for a controller that is late, as on a busy machine, and the
    controller for a robot that is; at 1 kHz, so that it outruns the clock of the wall less, by
    which others judge whether anybody is silent.
    """
    rate, steps = (1000.0, 1) if mode == "lockstep" else (250.0, 2)
    urdf = folder / "turntable.urdf"
    urdf.write_text(URDF)
    harness.seen = []
    harness.node.create_subscription(
        JointState,
        "joint_states",
        lambda raw: harness.seen.append(decode_joint_state(raw)),
        ALL_COMMANDS,
        raw=True,
    )
    if mode == "lockstep" or pace != 1.0:
        more = {"state_clock": "simulated", "state_watchdog": False, **more}
    of_controller = {"joint": "turn", "law": "pid", "robot_description": urdf, **GAINS, **more}
    harness.processes.start(
        "turn_controller",
        "joint_controller",
        ros_arguments(control_period=1.0 / rate, state_timeout=1.0, **of_controller),
    )
    of_bridge = {"robot_description": urdf, "fixed_base": True, "control_rate": rate}
    of_bridge |= {"mode": mode, "real_time_factor": pace}
    harness.processes.start(
        "bridge",
        "mujoco_bridge",
        ros_arguments(physics_steps=steps, wait_for_subscribers=2, **of_bridge),
    )
    harness.wait(lambda: len(harness.seen) > 10 and harness.commands, what="the robot")


def positions(harness, duration=0.3):
    """Return where the joint is from now on, for a while."""
    states = harness.heard_from_now(duration, "joint_states", least=20)
    return np.array([each.position[0] for each in states])


def wait_for_rest(harness, within=30.0):
    """Return where the joint stands still; friction is overcome by the integral, slowly."""
    deadline = time.monotonic() + within
    while np.ptp(seen := positions(harness)) > 2e-3:
        assert time.monotonic() < deadline, f"it still moves after {within} s: {seen}"
    return seen[-1]

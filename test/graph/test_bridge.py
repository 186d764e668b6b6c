"""The bridge: odometry and slip, its console, its services, and whom it obeys."""

from __future__ import annotations

import itertools
import math

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, Vector3Stamped
from harness.graph import Told, ros_arguments
from harness.interfaces import needs
from harness.places import URDF
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from hpid_bench.experiment.in_process import write_document
from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.nodes.core.middleware import LATCHED, OFFERED, RARE
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.kinematics import Kinematics

BRIDGE = "mujoco_bridge"
ROBOT = {"description": "urdf/mobile_manipulator.urdf"}


def start(harness, folder, world, **parameters):
    """Start a bridge in real time; it waits for nobody unless told."""
    write_document(folder / "world.yaml", world)
    given = {"mode": "realtime", "control_rate": 100.0, "wait_for_subscribers": 0, **parameters}
    arguments = ros_arguments(world_file=folder / "world.yaml", **given)
    return harness.processes.start(BRIDGE, BRIDGE, arguments)


# --- a base that drives


WHEELS = ("wheel_left_joint", "wheel_right_joint")


def test_odometry_truth_and_slip_of_a_base_are_told_and_begin_again_at_a_reset(harness, tmp_path):
    last, node = {}, harness.node
    for kind, topic in (
        (Odometry, "odom"),
        (Odometry, "base_pose_ground_truth"),
        (Vector3Stamped, "wheel_slip"),
    ):
        keep = lambda message, topic=topic: last.update({topic: message})  # noqa: E731
        node.create_subscription(kind, topic, keep, 10)
    told = Told(harness, BRIDGE)
    base = {"left_wheel": WHEELS[0], "right_wheel": WHEELS[1]}
    start(
        harness,
        tmp_path,
        {"robot": {**ROBOT, "base": base}},
        encoder_counts=[4096] * 8,
        control_rate=200.0,
        real_time_factor=0.5,
        command_timeout=1000.0,
    )
    harness.wait(lambda: "odom" in last, what="odometry")
    commands = node.create_publisher(JointState, "joint_commands", OFFERED)
    push = JointStateTemplate(WHEELS, effort=True).encode(0, effort=[0.8, 0.8])

    def is_far():
        commands.publish(push)
        return last["odom"].pose.pose.position.x > 0.1

    harness.wait(is_far, what="the base to drive")
    harness.wait(
        lambda: float(told.newest().get("driven by the wheels [m]", 0.0)) > 0.1,
        what="/diagnostics",
    )
    odom, truth = last["odom"], last["base_pose_ground_truth"]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_footprint")
    assert (truth.header.frame_id, truth.child_frame_id) == ("odom", "base_footprint")
    covariance = np.array(odom.pose.covariance).reshape(6, 6)
    assert (covariance == covariance.T).all()
    assert 0.0 < covariance[0, 0] < 0.1
    assert covariance[2, 2] == 1e6  # height is not measured by wheels
    assert odom.pose.pose.position.z == 0.0
    assert odom.twist.twist.linear.x > 0.0
    assert last["wheel_slip"].header.frame_id == "base_footprint"
    slips = {"slip of the left wheel [m]", "slip of the axle, sideways, recent [m]"}
    assert slips <= told.newest().keys()
    late = []
    node.create_subscription(String, "robot_description", late.append, LATCHED)
    harness.wait(lambda: late, what="the description")
    assert late[0].data == URDF.read_text()
    harness.call(Trigger, f"{BRIDGE}/reset", Trigger.Request())
    harness.wait(lambda: last["odom"].pose.pose.position.x < 0.05, what="odometry to start again")


# --- whom it obeys


def test_joints_that_nobody_answers_for_are_named_once_until_somebody_does(harness, tmp_path):
    arm = {**ROBOT, "driven": ["arm_joint_1", "arm_joint_2"], "fixed_base": True}
    bridge = start(harness, tmp_path, {"robot": arm}, wait_for_subscribers=1)

    def said(line):
        return bridge.log.read_text().count(line)

    def start_controllers(name):
        arguments = ros_arguments(law="pid", gains__p=1.0, joints="[arm_joint_1, arm_joint_2]")
        return harness.processes.start(name, "joint_controllers", arguments, is_renamed=False)

    harness.wait(lambda: said("waiting for controllers"), what="a bridge that waits")
    controllers = start_controllers("first")
    harness.wait(lambda: said(": running"), what="answers")
    lost = "no answer from arm_joint_1, arm_joint_2"
    answered, before = said(": running"), said(lost)  # they may have been late at first
    controllers.process.kill()
    harness.wait(lambda: said(lost) > before, what="silence")
    start_controllers("again")
    harness.wait(lambda: said(": running") > answered, what="answers again")
    lines = [line.rpartition("]: ")[2] for line in bridge.log.read_text().splitlines()]
    told = [line for line in lines if line == "running" or line.startswith("no answer from")]
    assert all(one != other for one, other in itertools.pairwise(told))  # each is named once


COUNTED = (
    "commands of second senders, not obeyed",
    "commands for other joints",
    "misread commands",
)


def test_a_second_commander_of_a_joint_is_named_and_not_obeyed(harness, tmp_path, faults):
    """A forger of efforts beyond the limit, and a second controller of the same name."""
    joint, name = "arm_joint_6", "arm_joint_6_controller"
    told, efforts, node = Told(harness, BRIDGE), [], harness.node
    node.create_subscription(
        JointState,
        "joint_states",
        lambda raw: efforts.append(decode_joint_state(raw).effort[0]),
        OFFERED,
        raw=True,
    )

    def start_controller(process, **limits):
        arguments = ros_arguments(joint=joint, claim="none", gains__p=1.0, **limits)
        arguments += ["-r", f"__node:={name}"]
        return harness.processes.start(process, "joint_controller", arguments, is_renamed=False)

    start_controller("first", u_clamp_max=1.0, u_clamp_min=-1.0)
    start(
        harness,
        tmp_path,
        {"robot": {**ROBOT, "driven": [joint], "fixed_base": True}},
        command_timeout=5.0,  # a busy machine is no reason to follow another one
        wait_for_publishers=1,
        wait_for_subscribers=2,
    )
    harness.wait(lambda: len(efforts) > 20, what="the controller at work")
    forger = node.create_publisher(JointState, "joint_commands", OFFERED)
    forged = (
        JointStateTemplate([joint], effort=True).encode(1, effort=[1e9]),
        JointStateTemplate(["neck"], effort=True).encode(1, effort=[1.0]),
        JointStateTemplate([], effort=True).encode(1),
        JointStateTemplate([joint]).encode(1),
    )

    def is_named(other):
        line = f"commanded twice: {joint} by /{name} and /{other}, following /{name}"
        return told.says(message=line, level=DiagnosticStatus.ERROR)

    def is_forger_named():
        for message in forged:
            forger.publish(message)
        faults.count("commands forged", len(forged))
        return is_named("robot") and all(told.count(each) for each in COUNTED)

    harness.wait(is_forger_named, what="the forger to be named")
    second = start_controller("second", u_clamp_max=3.0, u_clamp_min=1.5)
    harness.wait(lambda: is_named(name), what="both of one name to be named")
    assert second.process.poll() is None
    assert told.newest()["changes of sender"] == "0"
    count = len(efforts)
    harness.wait(lambda: len(efforts) > count + 20, what="the bridge to go on")
    assert max(map(abs, efforts)) <= 1.0  # what the first one may command
    faults.count("second senders not obeyed", 2)


# --- its services


ARM = Kinematics(RobotDescription.load(URDF), "payload")
FOLDED = [0.0, -0.6, 1.9, 0.0, math.pi - 1.3, 0.0]


def scene(mass):
    """Return a world with a brick between the fingers, on a shelf."""
    x, y, z = ARM.pose(FOLDED).position.tolist()
    places = dict(zip(ARM.joints, FOLDED, strict=True))
    driven = {"driven": list(ARM.joints), "initial_positions": places, "fixed_base": True}
    return {
        "robot": {**ROBOT, **driven},
        "scene": {
            "bricks": {"brick": {"size": [0.06] * 3, "position": [x, y, z], "mass": mass}},
            "supports": {"shelf": {"size": [0.1, 0.1, 0.02], "position": [x, y, z - 0.04]}},
        },
    }


def test_a_person_grips_lets_go_and_begins_anew(harness, tmp_path):
    events, poses = [], []
    node = harness.node
    node.create_subscription(
        DiagnosticArray, "grip_events", lambda each: events.extend(each.status), RARE
    )
    node.create_subscription(PoseArray, "brick_poses", poses.append, RARE)
    start(harness, tmp_path, scene(0.5))
    harness.wait(lambda: poses, what="the bridge and its bricks")

    def call(name, **fields):
        kind = SetBool if fields else Trigger
        return harness.call(kind, f"{BRIDGE}/{name}", kind.Request(**fields), again=False)

    call("pause", data=True)
    call("reset")  # the arm has no controller and has begun to sink
    taken = call("grip", data=True)
    assert taken.success
    assert taken.message.startswith("brick grasped at 0.000 s")
    assert "nothing changed" in call("grip", data=True).message
    assert call("grip", data=False).message.startswith("brick released")
    harness.wait(lambda: len(events) == 2, what="both events")
    assert [(each.name, each.message) for each in events] == [
        ("brick", "grasped"),
        ("brick", "released"),
    ]
    assert float(events[0].values[0].value) < 0.005
    call("pause", data=False)
    harness.wait(lambda: poses and poses[-1].header.stamp.sec >= 1, what="the arm to sink")
    missed = call("grip", data=True)
    assert not missed.success
    assert "brick missed at" in missed.message
    assert "away, at most 0.015 m" in missed.message
    harness.wait(lambda: len(events) == 3, what="the miss")
    assert events[-1].level == b"\x01"


STOPPED, PLAYING, PAUSED, QUITTING = range(4)  # simulation_interfaces/msg/SimulationState
UNSUPPORTED, OK, FAILED, ALREADY = 0, 1, 4, 101  # simulation_interfaces/msg/Result, and one more


@needs("simulation_interfaces")
def test_a_simulation_is_held_stepped_reset_and_ended_by_the_standard(harness, tmp_path):
    from simulation_interfaces import msg, srv

    arm = {**ROBOT, "driven": ["arm_joint_1"], "fixed_base": True}
    process = start(harness, tmp_path, {"robot": arm})
    stamps = []
    harness.node.create_subscription(
        JointState,
        "joint_states",
        lambda each: stamps.append(
            each.header.stamp.sec * 100 + each.header.stamp.nanosec // 10**7
        ),
        qos_profile_sensor_data,
    )

    def call(kind, name, **fields):
        return harness.call(kind, f"mujoco_bridge/{name}", kind.Request(**fields), again=False)

    def state():
        answer = call(srv.GetSimulationState, "get_simulation_state")
        assert answer.result.result == OK
        return answer.state.state

    def turn(wanted):
        wanted = msg.SimulationState(state=wanted)
        return call(srv.SetSimulationState, "set_simulation_state", state=wanted).result

    def step(steps=1):
        return call(srv.StepSimulation, "step_simulation", steps=steps).result

    harness.wait(lambda: len(stamps) > 3, what="states")
    features = call(srv.GetSimulatorFeatures, "get_simulator_features").features.features
    assert msg.SimulatorFeatures.STEP_SIMULATION_SINGLE in features
    assert msg.SimulatorFeatures.SPAWNING not in features
    assert state() == PLAYING
    assert turn(PLAYING).result == ALREADY
    assert (step().result, step().error_message) == (FAILED, "the simulation is not paused")
    assert turn(PAUSED).result == OK
    assert state() == PAUSED

    assert turn(STOPPED).result == OK
    assert state() == STOPPED
    harness.wait(lambda: stamps[-1] == 0, what="time zero")
    for count in (1, 2, 3):
        assert step().result == OK
        harness.wait(lambda count=count: stamps[-1] == count, what="a step")
    refused = step(7)
    assert (refused.result, refused.error_message) == (UNSUPPORTED, "one step at a time, not 7")
    assert stamps[-1] == 3

    time_alone = call(srv.ResetSimulation, "reset_simulation", scope=1).result
    assert time_alone.result == UNSUPPORTED
    assert "scope 0, 3 or 255, not 1" in time_alone.error_message
    assert call(srv.ResetSimulation, "reset_simulation", scope=255).result.result == OK
    harness.wait(lambda: stamps[-1] == 0, what="time zero again")
    assert turn(9).result == UNSUPPORTED
    assert turn(PLAYING).result == OK
    harness.wait(lambda: stamps[-1] > 3, what="time to go on")
    assert turn(QUITTING).result == OK
    harness.wait(lambda: process.process.poll() is not None, what="the bridge to end")
    assert process.process.returncode == 0

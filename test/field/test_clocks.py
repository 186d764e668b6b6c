"""Stamps of other clocks: trajectories, states and commands of a time that is not the joints'."""

import pytest
from builtin_interfaces.msg import Time
from harness.goals import (
    ABORTED,
    GAINS,
    SUCCEEDED,
    Client,
    Joints,
    fill_trajectory,
    goal_of,
    needs_control_msgs,
)
from harness.graph import NAME, Told, ros_arguments
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from hpid_bench.experiment.in_process import write_document
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.middleware import LATCHED, OFFERED, RARE

MS, SECOND = 10**6, 10**9
BEGIN_NS = 100 * SECOND
STEP_NS = 5 * MS
INVALID_GOAL = -1


class Joint:
    """A joint of inertia 1 and its controller, one state after the other."""

    def __init__(self, harness, begin_ns=BEGIN_NS):
        self.harness, self.stamp_ns = harness, begin_ns
        self.position = self.velocity = self.fastest = 0.0
        self.told = Told(harness)

    def start(self, **parameters):
        values = {"certify": False, "control_period": STEP_NS * 1e-9, **GAINS, **parameters}
        return self.harness.start_controller(**values)

    def run(self, seconds=None, until=None):
        """Let states follow each other for a while, or until a condition holds."""
        end_ns = self.stamp_ns + round((seconds or 60.0) * SECOND)
        while self.stamp_ns < end_ns and not (until and until()):
            effort = self.harness.ask(self.stamp_ns, self.position, self.velocity)
            self.velocity += effort * STEP_NS * 1e-9
            self.position += self.velocity * STEP_NS * 1e-9
            self.fastest = max(self.fastest, abs(self.velocity))
            self.stamp_ns += STEP_NS
        assert until is None or until()

    def publisher(self, profile=RARE):
        """Return a publisher of trajectories that the controller listens to."""
        node = self.harness.node
        publisher = node.create_publisher(JointTrajectory, "joint_trajectory", profile)
        least = 2 if profile is LATCHED else 1
        self.run(until=lambda: publisher.get_subscription_count() >= least)
        return publisher


def trajectory(stamp_ns, position=2.0, seconds=2.0):
    message = JointTrajectory()
    fill_trajectory(message, {"elbow": [position]}, [seconds], {"elbow": [0.0]})
    message.header.stamp = Time(sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    return message


def test_a_trajectory_of_another_clock_is_refused_with_a_line_until_a_good_one_comes(harness):
    joint = Joint(harness)
    process = joint.start()
    joint.run(0.1)
    publisher = joint.publisher()
    for number, (stamp_ns, line) in enumerate(
        [
            (SECOND, "the trajectory ended at 3.000 s, in the past"),
            (1_795_900_133 * SECOND, "must start within 3600 s, not at 1795900133.000 s"),
        ],
        1,
    ):
        publisher.publish(trajectory(stamp_ns))
        joint.run(until=lambda n=number: joint.told.says(refused_references=str(n)))
        told = joint.told.newest()
        assert (told["level"], line in told["message"]) == (b"\x01", True)
    assert process.log.read_text().count("reference refused: the trajectory ended at 3.0") == 1
    assert joint.fastest < 1e-3
    publisher.publish(trajectory(joint.stamp_ns, 0.2, 0.5))
    joint.run(until=lambda: joint.told.says(level=b"\x00", refused_references="2"))
    joint.run(1.5)
    assert joint.position == pytest.approx(0.2, abs=0.01)


def test_a_controller_that_begins_takes_up_what_is_latched_though_it_has_ended(harness):
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
    publisher.publish(trajectory(SECOND, 0.3, 0.5))
    joint = Joint(harness)
    joint.start()
    joint.run(until=lambda: abs(joint.position - 0.3) < 0.01)
    joint.run(until=lambda: joint.told.says(level=b"\x00", refused_references="0"))
    publisher.publish(trajectory(SECOND, 2.0))  # and once it follows something no more
    joint.run(until=lambda: joint.told.says(level=b"\x01", refused_references="1"))
    assert joint.position < 0.4
    joint.run(until=lambda: max(abs(joint.position - 0.3), abs(joint.velocity)) < 1e-3)


@pytest.mark.parametrize(
    ("stamp_ns", "line"),
    [
        (0, "the stamps of joint_states are 0: their driver has to stamp them"),
        (BEGIN_NS, "the stamps of joint_states stand still at 100.000 s"),
    ],
)
@pytest.mark.parametrize("is_watched", [True, False])
def test_states_whose_stamps_stand_still_are_named_as_that(harness, stamp_ns, line, is_watched):
    joint = Joint(harness)
    process = joint.start(state_timeout=0.2, state_watchdog=is_watched)

    def is_named():
        harness.publish(stamp_ns, joint.position)
        return line in joint.told.newest().get("message", "")

    harness.wait(is_named, what="the report")
    assert joint.told.newest()["level"] == (b"\x02" if is_watched else b"\x01")
    assert process.log.read_text().count(line) == 1
    joint.stamp_ns = stamp_ns + STEP_NS
    joint.run(until=lambda: joint.told.says(level=b"\x00"))


def test_a_stamp_that_is_no_time_is_named_where_it_is_waited_for(harness):
    joint = Joint(harness)
    joint.start()
    state = JointState(name=["elbow"], position=[0.5], velocity=[0.0])
    state.header.stamp = Time(sec=1133099831, nanosec=1126656057)

    def is_named():
        harness.states.publish(state)
        line = "state refused: a stamp's nanoseconds must be below 1e9, not 1126656057"
        return joint.told.says(message=line, level=b"\x01")

    harness.wait(is_named, what="the report")


@needs_control_msgs
def test_a_clock_that_jumps_ahead_in_a_goal_stops_the_joints_where_they_are(harness):
    joints = Joints(harness)
    joints.start()
    client = Client(joints)
    path = {"shoulder": [1.5], "elbow": [-1.5]}
    handle = client.send(goal_of(path, [2.0], {name: [0.0] for name in path}))
    joints.run(lambda: joints.position["shoulder"] > 0.3, what="the joints to move")
    there = dict(joints.position)
    joints.ahead = 3600.0
    status, code, text = client.result(handle)
    assert (status, code) == (ABORTED, INVALID_GOAL)
    line, _, jumped = text.removesuffix(" s").rpartition(" ")
    assert line == "the clock of the states jumped ahead by"
    assert float(jumped) == pytest.approx(3600.0, abs=1.0)
    joints.run_for(2.0)
    assert joints.position == pytest.approx(there, abs=0.5)
    assert max(map(abs, joints.velocity.values())) < 0.01


@needs_control_msgs
def test_a_goal_goes_on_where_another_node_sends_what_has_ended(harness):
    joints = Joints(harness)
    joints.ahead = 1000.0
    joints.start()
    client = Client(joints)
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", RARE)
    joints.run(lambda: publisher.get_subscription_count() > 2, what="all to listen")
    path = {"shoulder": [0.5], "elbow": [-0.5]}
    handle = client.send(goal_of(path, [1.5], {name: [0.0] for name in path}))
    joints.run(lambda: joints.position["shoulder"] > 0.05, what="the joints to move")
    publisher.publish(trajectory(SECOND))
    status, _, text = client.result(handle)
    assert (status, text) == (SUCCEEDED, "goal reached")
    assert joints.position["elbow"] == pytest.approx(-0.5, abs=0.02)


@needs_control_msgs
def test_a_goal_over_states_whose_stamps_stand_still_ends_with_that_reason(harness):
    joints = Joints(harness)
    joints.start(state_timeout=0.5)
    client = Client(joints)
    path = {"shoulder": [1.5], "elbow": [-1.5]}
    handle = client.send(goal_of(path, [20.0], {name: [0.0] for name in path}))
    joints.run_for(0.2)
    joints.is_paused = True

    def has_ended():
        joints.repeat()
        return handle.ended.done()

    joints.run(has_ended, what="the result")
    assert f": the stamps of joint_states stand still at {joints.now:.3f} s" in (
        handle.ended.result().result.error_string
    )


def test_a_trajectory_from_before_a_reset_does_not_begin_long_after_it(harness):
    joint = Joint(harness)
    joint.start()
    joint.run(0.1)
    publisher = joint.publisher()
    publisher.publish(trajectory(joint.stamp_ns, 0.3, 0.5))
    joint.run(until=lambda: joint.position > 0.25)
    joint.stamp_ns = 0
    there, references = joint.position, []
    harness.node.create_subscription(JointState, f"{NAME}/reference", references.append, OFFERED)
    line = "the clock of the states went back to 0.000 s: the trajectory that starts at 10"
    joint.run(until=lambda: line in joint.told.newest().get("message", ""))
    assert joint.told.says(level=b"\x01", refused_references="1")
    assert joint.position == pytest.approx(there, abs=0.1)
    assert references[-1].header.stamp.sec < 100  # it is published on the new clock
    publisher.publish(trajectory(0, 0.0, 0.5))
    joint.run(until=lambda: joint.told.says(level=b"\x00") and abs(joint.position) < 0.01)


def test_a_command_from_before_a_reset_moves_nothing_after_it(harness, tmp_path):
    robot = {"description": "urdf/mobile_manipulator.urdf", "driven": ["arm_joint_1"]}
    write_document(tmp_path / "world.yaml", {"robot": {**robot, "fixed_base": True}})
    told, states = Told(harness, "mujoco_bridge"), []
    harness.node.create_subscription(
        JointState, "joint_states", states.append, qos_profile_sensor_data
    )
    commands = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    template = JointStateTemplate(["arm_joint_1"], effort=True)

    def call(name, kind=Trigger, **fields):
        harness.call(kind, f"mujoco_bridge/{name}", kind.Request(**fields))

    def command(stamp_ns):
        commands.publish(template.encode(stamp_ns, effort=[0.5]))

    def has_dropped():
        command(400 * MS)
        return told.count("commands from before a reset") > 0

    pace = {"mode": "realtime", "control_rate": 100.0, "wait_for_subscribers": 0}
    arguments = ros_arguments(world_file=tmp_path / "world.yaml", command_timeout=1.0, **pace)
    harness.processes.start("mujoco_bridge", "mujoco_bridge", arguments)
    harness.wait(lambda: states and states[-1].header.stamp.nanosec > 500 * MS, what="time")
    call("pause", SetBool, data=True)
    call("reset")
    harness.wait(has_dropped, what="a command to be dropped")
    states.clear()
    call("pause", SetBool, data=False)
    harness.wait(lambda: len(states) > 10, what="states")
    assert {state.effort[0] for state in states} == {0.0}
    command(states[-1].header.stamp.nanosec)  # of the new clock
    harness.wait(lambda: states[-1].effort[0] == 0.5, what="it to act")

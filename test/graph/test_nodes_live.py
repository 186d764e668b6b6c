"""What users do to running nodes: late commands, volatile publishers, bad command lines."""

import pytest
from harness.engines import ENGINE
from harness.graph import ros_arguments
from harness.places import URDF
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.motion import minimum_jerk
from hpid_ros.nodes.core.middleware import ALL_COMMANDS, LATCHED, OFFERED, RARE
from hpid_ros.nodes.parts.bridge_commanders import HeldCommands
from hpid_ros.nodes.parts.references import TrajectorySubscriptions

MS = 1_000_000


def held_after(*acts):
    """Return the commands of joint a after some acts: times of states, or answers in [ms]."""
    held = HeldCommands(["a"], 100 * MS)
    for act in acts:
        if isinstance(act, int):
            held.begin(act * MS)
        else:
            stamp, effort = act
            held.answer(stamp * MS, ["a"], [effort])
    return held.finish(), held.counts["a"]


@pytest.mark.parametrize(
    ("acts", "effort", "counts"),
    [
        ((5, (2, 1.5), 6), 1.5, {"stale": 1}),  # late, and stands until the next
        ((5, (2, 1.5), 6, (3, -2.0)), -2.0, {"stale": 2}),
        ((0, (0, 1.5), 100), 1.5, {}),
        ((0, (0, 1.5), 101), 0.0, {"unanswered": 1}),  # too old
        ((50, (50, 1.5), 0), 0.0, {}),  # a clock that goes back
        ((0, (0, float("nan"))), 0.0, {"invalid": 1}),
    ],
)
def test_which_command_a_paced_robot_acts_on(acts, effort, counts):
    found, counted = held_after(*acts)
    assert found == [effort]
    for name, number in counts.items():
        assert getattr(counted, name) == number


def test_commands_of_foreign_joints_are_counted():
    held = HeldCommands(["a", "b"], 100 * MS)
    held.begin(0)
    held.answer(0, ["a", "c"], [1.0, 1.0])
    assert (held.foreign, held.silent) == (1, ("b",))


def test_a_paced_robot_acts_on_answers_to_earlier_states(harness):
    efforts = []
    harness.node.create_subscription(
        JointState,
        "joint_states",
        lambda raw: efforts.append(decode_joint_state(raw).effort[0]),
        ALL_COMMANDS,
        raw=True,
    )
    commands = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    parameters = {"mode": "realtime", "joints": "[arm_joint_6]", "control_rate": 100.0}
    arguments = ros_arguments(fixed_base=True, wait_for_subscribers=1, **parameters)
    harness.processes.start("bridge", "mujoco_bridge", arguments)
    harness.wait(lambda: len(efforts) > 10, what="states of the bridge")
    command = JointStateTemplate(["arm_joint_6"], effort=True).encode(0, effort=[0.125])

    def acts():
        commands.publish(command)
        return efforts[-1] == 0.125

    harness.wait(acts, what="the commanded effort")
    harness.wait(lambda: efforts[-1] == 0.0, what="the command to be too old")


def test_whoever_comes_late_still_gets_the_robot_s_description(harness):
    arguments = ros_arguments(mode="realtime", fixed_base=True, wait_for_subscribers=100)
    harness.processes.start("bridge", f"{ENGINE}_bridge", arguments)
    harness.wait(lambda: harness.node.count_publishers("robot_description"), what="the bridge")
    found = []
    harness.node.create_subscription(String, "robot_description", found.append, LATCHED)
    harness.wait(lambda: found, what="the description")
    assert found[0].data == URDF.read_text()


@pytest.mark.parametrize("profile", [RARE, LATCHED], ids=["volatile", "latched"])
def test_trajectories_come_from_volatile_and_latched_publishers(harness, profile):
    harness.start_controller(law="pid", gains__p=10.0)
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", profile)
    readers = 1 if profile is RARE else 2
    harness.wait(lambda: publisher.get_subscription_count() >= readers, what="the subscriptions")
    harness.ask(0, 0.5)
    stamps = iter(range(MS, 10_000 * MS, MS))
    for goal in (1.5, 1.5, 0.5):  # the same one a second time is meant, too
        motion = minimum_jerk([0.0, 0.002], {"elbow": [0.5, goal]})
        publisher.publish(encode_joint_trajectory(motion))
        at_goal = 10.0 * (goal - 0.5)
        harness.wait(
            lambda wanted=at_goal: abs(harness.ask(next(stamps), 0.5) - wanted) < 1e-6,
            what=f"the loop to follow to {goal}",
        )


def test_what_a_latched_publisher_sends_to_both_subscriptions_is_taken_once():
    callbacks, taken = [], []

    class Node:
        def create_subscription(self, kind, topic, callback, *rest, **options):
            callbacks.append(callback)

    TrajectorySubscriptions(Node(), taken.append)
    latched, volatile = callbacks
    first, second = (JointTrajectory(joint_names=[name]) for name in ("elbow", "wrist"))
    for receive, message in (
        *((latched, first), (volatile, first)),  # both copies, in either order
        *((volatile, second), (latched, second)),
        *((latched, second), (volatile, second)),  # published once more
        (volatile, second),  # by somebody who does not latch
    ):
        receive(message)
    assert taken == [first, second, second, second]

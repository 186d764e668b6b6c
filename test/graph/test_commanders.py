"""Whoever sends a command: limits hold, and a second commander of a joint is found out."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from harness.graph import ros_arguments
from sensor_msgs.msg import JointState

from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.nodes.core.middleware import OFFERED, RARE
from hpid_ros.nodes.parts.bridge_commanders import HeldCommands
from hpid_ros.simulation.lockstep import Barrier

MS = 1_000_000
LIMITS = {"a": 2.0}


def barrier():
    return Barrier(["a"], LIMITS)


def held():
    return HeldCommands(["a"], 100 * MS, LIMITS)


@pytest.mark.parametrize("make", [barrier, held])
def test_commands_are_held_to_the_limit_of_the_joint(make):
    commands = make()
    commands.begin(MS)
    for effort, acts in ((5.0, 2.0), (-5.0, -2.0), (1.5, 1.5)):
        commands.answer(MS, ["a"], [effort])
        assert commands.finish() == [acts]
    assert commands.counts["a"].excessive == 2


@pytest.mark.parametrize("make", [barrier, held])
def test_answers_to_one_state_that_differ_are_a_conflict(make):
    commands = make()
    commands.begin(MS)
    commands.answer(MS, ["a"], [1.0])
    commands.answer(MS, ["a"], [1.0])  # asked again
    assert commands.counts["a"].conflicting == 0
    commands.answer(MS, ["a"], [-1.0])
    assert commands.counts["a"].conflicting == 1
    commands.answer(MS, ["a"], [0.0])  # the controller leaves
    assert commands.counts["a"].conflicting == 1


@pytest.mark.parametrize("make", [barrier, held])
def test_an_answer_to_the_state_before_that_differs_is_a_conflict(make):
    commands = make()
    for stamp_ns in (MS, 2 * MS):
        commands.begin(stamp_ns)
        commands.answer(stamp_ns, ["a"], [1.0])
    commands.answer(MS, ["a"], [-1.0])
    assert commands.counts["a"].conflicting == 1


def test_a_command_without_a_stamp_beside_a_controller_is_a_conflict():
    commands = held()
    commands.begin(5 * MS)
    commands.answer(5 * MS, ["a"], [1.0])
    commands.answer(0, ["a"], [1.5])
    assert commands.counts["a"].conflicting == 1


def test_commands_without_stamps_and_a_clock_that_went_back_are_none():
    commands = held()
    commands.begin(5 * MS)
    for effort in (1.0, 1.5, -1.0):
        commands.answer(0, ["a"], [effort])
    commands.answer(5 * MS, ["a"], [1.0])
    commands.begin(0)
    commands.answer(MS, ["a"], [1.5])
    assert commands.counts["a"].conflicting == 0


def silent_then_late(times):
    """Return a barrier that gave its joint up and heard answers to states that were over."""
    commands = Barrier(["a", "b"])
    commands.begin(0)
    commands.answer(0, ["b"], [1.0])
    commands.time_out()
    for k in range(1, times + 1):
        commands.begin(k)
        commands.answer(k, ["b"], [1.0])
        commands.answer(k - 1, ["a"], [1.0])
    return commands


def test_a_controller_that_answers_too_late_is_waited_for_again():
    """Nobody waits for a silent joint: without this it would have to win a race to come back."""
    commands = silent_then_late(1)
    commands.begin(10)
    assert commands.missing == ("a", "b")
    commands.answer(10, ["a"], [2.0])
    commands.answer(10, ["b"], [1.0])
    assert (commands.silent, commands.finish()) == ((), [2.0, 1.0])


def test_one_that_is_always_too_late_is_believed_ever_more_rarely():
    commands = silent_then_late(1)
    waited = 0
    for k in range(10, 1010):
        commands.begin(k)
        commands.answer(k, ["b"], [1.0])
        if commands.missing:
            waited += 1
            commands.time_out()
        commands.answer(k - 1, ["a"], [1.0])
    assert 5 < waited < 12


def test_a_forger_beside_a_controller_is_named_and_not_obeyed(harness, faults):
    """Efforts beyond the limit, for foreign joints, without names, and for a joint that is led."""
    reports, efforts = [], []
    node = harness.node
    node.create_subscription(DiagnosticArray, "/diagnostics", reports.append, RARE)
    node.create_subscription(
        JointState,
        "joint_states",
        lambda raw: efforts.append(decode_joint_state(raw).effort[0]),
        OFFERED,
        raw=True,
    )
    harness.processes.start(
        "arm_joint_6_controller",
        "joint_controller",
        ros_arguments(joint="arm_joint_6", gains__p=1.0, u_clamp_max=1.0, u_clamp_min=-1.0),
    )
    harness.processes.start(
        "mujoco_bridge",
        "mujoco_bridge",
        ros_arguments(
            mode="realtime",
            joints="[arm_joint_6]",
            control_rate=100.0,
            fixed_base=True,
            command_timeout=5.0,  # a busy machine is no reason to follow the forger
            wait_for_publishers=1,
            wait_for_subscribers=2,
        ),
    )
    harness.wait(lambda: len(efforts) > 20, what="the controller at work")
    forger = node.create_publisher(JointState, "joint_commands", OFFERED)
    forged = JointStateTemplate(["arm_joint_6"], effort=True).encode(1, effort=[1e9])
    foreign = JointStateTemplate(["neck"], effort=True).encode(1, effort=[1.0])
    nameless = JointStateTemplate([], effort=True).encode(1)

    effortless = JointStateTemplate(["arm_joint_6"]).encode(1)

    def told():
        for message in (forged, foreign, nameless, effortless):
            forger.publish(message)
        faults.count("commands forged", 4)
        return next(
            (
                status
                for report in reports
                for status in report.status
                if status.name == "/mujoco_bridge" and "commanded twice" in status.message
            ),
            None,
        )

    harness.wait(told, what="the forger to be named")
    status = told()
    assert status.level == DiagnosticStatus.ERROR
    assert status.message == (
        "commanded twice: arm_joint_6 by /arm_joint_6_controller and /robot, "
        "following /arm_joint_6_controller"
    )
    values = {each.key: each.value for each in status.values}
    assert int(values["commands of second senders, not obeyed"]) > 0
    assert int(values["commands for other joints"]) > 0
    assert int(values["misread commands"]) > 0
    assert max(map(abs, efforts)) <= 1.0  # what the controller may command; the forger would 4
    count = len(efforts)
    harness.wait(lambda: len(efforts) > count + 20, what="the bridge to go on")

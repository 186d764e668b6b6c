"""What people reported of starts, activations and clocks, tried on real controllers."""

import time

import pytest
from harness.graph import NAME, Told, change
from harness.loops import pure_loop
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.motion import minimum_jerk
from hpid_ros.nodes.core.middleware import LATCHED

MS = 1_000_000
PERIOD = 5 * MS
GAINS = {"law": "pid", "gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}


@pytest.fixture(scope="module")
def robot(module_harness):
    """Return a harness with a controller that goes by a /clock that nobody publishes."""
    module_harness.process = module_harness.start_controller(use_sim_time=True, **GAINS)
    module_harness.told = Told(module_harness)
    module_harness.stamps = iter(range(PERIOD, 10**12, PERIOD))
    return module_harness


def ask(robot, position):
    return robot.ask(next(robot.stamps), position)


def activate_again(robot):
    assert change(robot, "deactivate")
    assert change(robot, "activate")
    robot.wait(lambda: robot.states.get_subscription_count() > 0, what="it to listen")


def test_without_a_clock_a_controller_with_simulated_time_answers_states(robot):
    """The stamps of the states are its clock; it waits for no other."""
    twin = pure_loop(state_clock="simulated", **GAINS)
    for k in range(1, 50):
        stamp_ns = next(robot.stamps)
        place = 0.7 + 1e-3 * k
        assert robot.ask(stamp_ns, place) == twin.step(stamp_ns, place, 0.0)
    robot.wait(lambda: robot.told.count("samples") >= 49, what="its health")
    assert robot.set_parameters(NAME, mu=0.0) == (True, "")


@pytest.mark.parametrize("place", [-2.0, 0.0, 3.0])
def test_an_activated_controller_holds_where_the_joint_is_now(robot, place):
    """Not at zero, not where it was before, and with nothing in its integral."""
    ask(robot, 1.0)
    for _ in range(30):
        effort = ask(robot, 0.95)
    assert abs(effort) > 0.5  # it holds the joint elsewhere, with an integral
    activate_again(robot)
    assert robot.ask_newcomer(next(robot.stamps), place) == 0.0
    assert ask(robot, place) == 0.0
    assert ask(robot, place - 0.1) == pytest.approx(1.0)


def test_a_trajectory_from_before_a_deactivation_is_not_followed_after_it(robot):
    """The joint was moved by hand meanwhile: it is held there."""
    activate_again(robot)
    robot.ask_newcomer(next(robot.stamps), 0.5)
    motion = minimum_jerk([0.0, 1.0], {"elbow": [0.5, 1.5]})
    references = []
    robot.node.create_subscription(
        JointState, f"/{NAME}/reference", lambda told: references.append(told.position[0]), 100
    )
    publisher = robot.node.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
    publisher.publish(encode_joint_trajectory(motion))

    def is_under_way():
        ask(robot, 0.5)
        return references and 0.6 < references[-1] < 1.4

    robot.wait(is_under_way, what="the motion to be under way")
    activate_again(robot)
    efforts = [robot.ask_newcomer(next(robot.stamps), -0.4)]
    efforts += [ask(robot, -0.4) for _ in range(200)]
    assert efforts == [0.0] * 201
    robot.node.destroy_publisher(publisher)


def test_a_controller_that_waits_for_a_paused_simulation_begins_when_that_does(module_harness):
    """However long it takes: nothing times out, and nothing is sent before."""
    told = Told(module_harness, "wrist_controller")
    module_harness.start_controller("wrist_controller", "wrist", state_timeout=0.1, **GAINS)
    module_harness.wait(
        lambda: told.newest().get("message") == "waiting for the first state", what="a report"
    )
    begun = time.monotonic()
    sent = len(module_harness.commands)
    module_harness.wait(lambda: time.monotonic() > begun + 0.5, what="half a second to pass")
    assert len(module_harness.commands) == sent
    module_harness.commands.clear()
    assert module_harness.ask(10**15, 1.2, joint="wrist") == 0.0
    effort = module_harness.ask(10**15 + MS, 1.1, joint="wrist")
    assert effort == pytest.approx(1.0)


def test_states_that_are_too_rare_are_named_with_what_to_set(module_harness):
    """Each of them would be called lost and found again, and nobody would know why."""
    told, name, joint = Told(module_harness, "slow_controller"), "slow_controller", "slow"
    process = module_harness.start_controller(name, joint, state_clock="wall", state_timeout=0.1)
    line = "states come more slowly than control_period = 0.001 s says, and than state_timeout"
    due, period = time.monotonic(), 1.0 / 7.0

    def is_named():
        nonlocal due
        if time.monotonic() >= due:
            due += period
            module_harness.publish(time.time_ns(), 0.3, joint=joint)
        return line in told.newest().get("message", "")

    module_harness.wait(is_named, what="the warning")
    assert process.log.read_text().count(line) == 1
    assert "set both to the robot's" in told.newest()["message"]
    slower = {"control_period": period, "state_timeout": 0.5}
    assert module_harness.set_parameters(name, **slower) == (True, "")

    def is_followed():
        is_named()
        return told.newest()["message"] == "holding its position"

    module_harness.wait(is_followed, what="it to be controlled at this rate")

"""What people reported of drivers' states, sent to one real controller."""

import math

import pytest
from harness.graph import NAME, Told
from harness.loops import pure_loop
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

MS = 1_000_000
GAINS = {"law": "pid", "gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}
GAINS |= {"velocity_max": 3.0}  # as a URDF says it


class Driver:
    """A robot's driver, whose clock begins again with each test."""

    def __init__(self, harness):
        self.harness, self.told = harness, Told(harness)
        harness.start_controller(**GAINS)

    def begin(self):
        """Let the clock begin again, and so the loop."""
        self.harness.commands.clear()
        self.twin = pure_loop(state_clock="simulated", **GAINS)

    def send(self, k, names, position, velocity=(), effort=(), publisher=None):
        state = JointState(name=names, position=position, velocity=velocity, effort=effort)
        state.header.stamp.nanosec = k * MS
        (publisher or self.harness.states).publish(state)

    def ask(self, k, names, position, velocity=(), effort=()):
        """Return the effort that answers a state."""
        sent = (k, names, position, velocity, effort)
        return self.harness.answer(k * MS, lambda: self.send(*sent))

    def hold(self, samples, position, start=1):
        """Ask with states as they should be, and require what a loop answers."""
        for k in range(start, start + samples):
            effort = self.harness.ask(k * MS, position)
            assert effort == self.twin.step(k * MS, position, 0.0)
        return effort

    def count(self, key, atleast):
        """Wait until a count of /diagnostics is so large."""
        self.harness.wait(lambda: self.told.count(key) >= atleast, what=f"{key} to be told")


@pytest.fixture(scope="module")
def started(module_harness):
    return Driver(module_harness)


@pytest.fixture
def driver(started):
    started.begin()
    return started


@pytest.mark.parametrize(
    "state", [(math.nan, 0.0), (0.5, math.nan), (math.nan, math.nan), (math.inf, 0.0)]
)
def test_a_motor_without_feedback_gets_no_effort_until_it_has_some(driver, state):
    driver.hold(10, 0.5)
    for k in range(11, 15):
        assert driver.harness.ask(k * MS, *state) == driver.twin.step(k * MS, *state) == 0.0
    assert driver.hold(10, 0.4, start=15) > 0.9  # as if nothing had been


def test_velocities_that_are_always_zero_are_named_as_soon_as_the_joint_moves(driver):
    for k in range(1, 150):
        driver.harness.ask(k * MS, 1e-3 * k, 0.0)
    line = "the velocities of the states are all 0, and the joint has moved"
    driver.harness.wait(lambda: line in driver.told.newest().get("message", ""), what="the line")
    assert "velocity_source filtered" in driver.told.newest()["message"]


def test_zeros_that_a_driver_puts_in_now_and_then_move_no_effort(driver):
    """Where the joint's largest speed is known; else a jump of half a turn is believed."""
    assert driver.hold(20, 1.5) == 0.0
    for k in range(21, 60, 4):
        assert driver.harness.ask(k * MS, 0.0) == driver.twin.step(k * MS, 0.0, 0.0) == 0.0
        assert driver.hold(3, 1.5, start=k + 1) == 0.0
    believing = pure_loop(**GAINS | {"velocity_max": 1e6})
    believing.step(MS, 1.5, 0.0)
    assert believing.step(2 * MS, 0.0, 0.0) == 15.0
    driver.count("position jumps", 10)


def test_a_state_of_positions_alone_will_do(driver):
    twin, fingers = driver.twin, [0.149, 0.0, 0.149]
    for k in range(1, 30):
        place = 0.3 * math.sin(0.05 * k)
        effort = driver.ask(k, ["elbow", "tip", "bottom", "other"], [place, *fingers])
        assert effort == twin.step(k * MS, place, None)
    driver.harness.wait(
        lambda: driver.told.newest().get("velocity") == "filtered, the states have none",
        what="the origin of the velocity",
    )


def test_joints_in_any_order_and_efforts_that_are_nan_are_read_by_name(driver):
    names = ["wheel", "elbow", "tip"]
    for k in range(1, 30):
        order = [names[(k + turn) % 3] for turn in range(3)]
        states = {"wheel": 9.0, "elbow": 0.01 * k, "tip": -5.0}
        place, speed = [states[name] for name in order], [0.0] * 3
        effort = driver.ask(k, order, place, speed, [math.nan] * 3)
        assert effort == driver.twin.step(k * MS, 0.01 * k, 0.0)


@pytest.mark.parametrize(
    ("position", "velocity", "effort"),
    [([0.5], [], []), ([0.5, 0.1], [0.0], []), ([0.5, 0.1, 0.2], [], [1.0]), ([], [], [])],
)
def test_arrays_that_do_not_fit_the_names_are_refused_and_leave_no_trace(
    driver, position, velocity, effort
):
    driver.hold(10, 0.5)
    driver.send(11, ["elbow", "tip"], position, velocity, effort)
    driver.hold(10, 0.45, start=12)
    assert not [each for each in driver.harness.commands if each.stamp_ns == 11 * MS]
    driver.harness.wait(
        lambda: "of 2 names must have" in driver.told.newest().get("last fault", ""),
        what="the fault to be told",
    )


def test_states_that_are_offered_best_effort_are_heard(driver):
    """And so would reliable ones: those of the other tests are."""
    offered = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = driver.harness.node.create_publisher(JointState, "joint_states", offered)
    driver.harness.wait(publisher.get_subscription_count, what="the controller")
    for k in range(1, 10):
        sent = (k, ["elbow"], [0.1 * k], [0.0], [], publisher)
        effort = driver.harness.answer(
            k * MS, lambda sent=sent: driver.send(*sent), again_after=0.2
        )
        assert effort == driver.twin.step(k * MS, 0.1 * k, 0.0)
    driver.harness.node.destroy_publisher(publisher)


def test_a_driver_that_repeats_a_state_gets_the_same_answer(driver):
    effort = driver.hold(10, 0.5)
    driver.twin.step(11 * MS, 0.4, 0.0)
    effort = driver.harness.ask(11 * MS, 0.4)
    answered = len(driver.harness.commands)
    for _ in range(5):
        driver.harness.publish(11 * MS, 0.4)
    driver.harness.wait(lambda: len(driver.harness.commands) >= answered + 5, what="the answers")
    again = driver.harness.commands[answered:]
    assert {each.effort[0] for each in again} == {effort}
    driver.hold(5, 0.4, start=12)


def test_the_controller_is_still_the_one_that_was_started(driver):
    """None of that has ended it, or let it think that it is another."""
    driver.hold(5, 0.2)
    assert driver.told.newest()["lifecycle"] == "active"
    assert driver.harness.is_there(NAME)

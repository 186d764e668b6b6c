"""What people reported of drivers' states, sent to one real controller."""

import math

import pytest
from harness.graph import NAME, Told, change
from harness.loops import pure_loop
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

MS = 1_000_000
GAINS = {"law": "pid", "gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}
GAINS |= {"velocity_max": 3.0}  # as a URDF says it


class Driver:
    """A robot's driver, and the loop that the controller should be."""

    def __init__(self, harness):
        self.harness, self.told = harness, Told(harness)
        harness.start_controller(**GAINS)
        self.stamp_ns = 0

    def begin(self):
        """Let the controller begin again."""
        assert change(self.harness, "deactivate")
        assert change(self.harness, "activate")
        self.harness.wait(self.harness.states.get_subscription_count, what="it to listen")
        self.harness.commands.clear()
        self.stamp_ns += 1000 * MS
        self.twin = pure_loop(state_clock="simulated", **GAINS)
        stamp_ns = self.next()
        self.harness.ask_newcomer(stamp_ns, 0.5)
        self.twin.step(stamp_ns, 0.5, 0.0)

    def next(self):
        """Return the stamp of the next state."""
        self.stamp_ns += MS
        return self.stamp_ns

    def send(self, names, position, velocity=(), effort=(), publisher=None):
        """Publish a state with the present stamp."""
        state = JointState(name=names, position=position, velocity=velocity, effort=effort)
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(self.stamp_ns, 10**9)
        (publisher or self.harness.states).publish(state)

    def ask(self, names, position, velocity=(), effort=()):
        """Return the effort that answers the next state, and its stamp."""
        stamp_ns, sent = self.next(), (names, position, velocity, effort)
        return self.harness.answer(stamp_ns, lambda: self.send(*sent)), stamp_ns

    def hold(self, samples, position, velocity=0.0):
        """Ask with states, and require what a loop answers; return the last effort."""
        for _ in range(samples):
            stamp_ns = self.next()
            effort = self.harness.ask(stamp_ns, position, velocity)
            assert effort == self.twin.step(stamp_ns, position, velocity)
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


def test_a_motor_without_feedback_gets_no_effort_until_it_has_some(driver):
    for state in ((math.nan, 0.0), (0.5, math.nan), (math.nan, math.nan), (math.inf, 0.0)):
        driver.hold(5, 0.5)
        assert driver.hold(4, *state) == 0.0
        assert driver.hold(5, 0.49) > 0.09  # as if nothing had been


def test_velocities_that_are_always_zero_are_named_as_soon_as_the_joint_moves(driver):
    for k in range(150):
        driver.harness.ask(driver.next(), 0.5 + 1e-3 * k, 0.0)
    line = "the velocities of the states are all 0, and the joint has moved"
    driver.harness.wait(lambda: line in driver.told.newest().get("message", ""), what="the line")
    assert "velocity_source filtered" in driver.told.newest()["message"]


def test_zeros_that_a_driver_puts_in_now_and_then_move_no_effort(driver):
    """Where the joint's largest speed is known; else a jump of half a turn is believed."""
    assert driver.hold(20, 0.5) == 0.0
    for _ in range(10):
        assert driver.hold(1, 0.0) == 0.0
        assert driver.hold(3, 0.5) == 0.0
    driver.count("position jumps", 1)
    believing = pure_loop(**GAINS | {"velocity_max": 1e6})
    believing.step(MS, 1.5, 0.0)
    assert believing.step(2 * MS, 0.0, 0.0) == 15.0


def test_a_state_of_positions_alone_will_do(driver):
    fingers = [0.149, 0.0, 0.149]
    for k in range(1, 30):
        place = 0.5 + 0.3 * math.sin(0.05 * k)
        effort, stamp_ns = driver.ask(["elbow", "tip", "bottom", "other"], [place, *fingers])
        assert effort == driver.twin.step(stamp_ns, place, None)
    driver.harness.wait(
        lambda: driver.told.newest().get("velocity") == "filtered, the states have none",
        what="the origin of the velocity",
    )


def test_joints_in_any_order_and_efforts_that_are_nan_are_read_by_name(driver):
    names = ["wheel", "elbow", "tip"]
    for k in range(1, 30):
        order = [names[(k + turn) % 3] for turn in range(3)]
        states = {"wheel": 9.0, "elbow": 0.5 + 0.01 * k, "tip": -5.0}
        effort, stamp_ns = driver.ask(
            order, [states[name] for name in order], [0.0] * 3, [math.nan] * 3
        )
        assert effort == driver.twin.step(stamp_ns, states["elbow"], 0.0)


def test_arrays_that_do_not_fit_the_names_are_refused_and_leave_no_trace(driver):
    for position, velocity, effort in (
        ([0.5], [], []),
        ([0.5, 0.1], [0.0], []),
        ([0.5, 0.1, 0.2], [], [1.0]),
        ([], [], []),
    ):
        driver.hold(5, 0.5)
        stamp_ns = driver.next()
        driver.send(["elbow", "tip"], position, velocity, effort)
        driver.hold(5, 0.49)
        assert stamp_ns not in {each.stamp_ns for each in driver.harness.commands}
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
        stamp_ns, place = driver.next(), 0.5 + 0.01 * k
        sent = (["elbow"], [place], [0.0], [], publisher)
        effort = driver.harness.answer(
            stamp_ns, lambda sent=sent: driver.send(*sent), again_after=0.2
        )
        assert effort == driver.twin.step(stamp_ns, place, 0.0)
    driver.harness.node.destroy_publisher(publisher)


def test_a_driver_that_repeats_a_state_gets_the_same_answer(driver):
    driver.hold(10, 0.5)
    effort = driver.hold(1, 0.4)
    answered = len(driver.harness.commands)
    for _ in range(5):
        driver.harness.publish(driver.stamp_ns, 0.4)
    driver.harness.wait(lambda: len(driver.harness.commands) >= answered + 5, what="the answers")
    assert {each.effort[0] for each in driver.harness.commands[answered:]} == {effort}
    driver.hold(5, 0.4)


def test_the_controller_is_still_the_one_that_was_started(driver):
    """None of that has ended it, or let it think that it is another."""
    driver.hold(5, 0.2)
    driver.harness.wait(lambda: driver.told.says(lifecycle="active"), what="it to be active")
    assert driver.harness.is_there(NAME)

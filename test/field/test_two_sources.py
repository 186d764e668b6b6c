"""States of one joint from two nodes: named, the fallback, and a takeover when one has ended.

automaticaddison/yahboom_rosmaster#4, xArm-Developer/xarm_ros#185, DFKI-NI/mir_robot#114 and
frankarobotics/franka_ros#230: ``joint_state_publisher`` next to a driver, on one topic.
"""

import math
import random
import time

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness.examples import examples
from harness.graph import Told
from harness.groups import MS, moving, started
from harness.loops import pure_loop
from hypothesis import assume, given
from hypothesis import strategies as st
from sensor_msgs.msg import JointState

from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.sources import SourceWatch, source_bounds
from hpid_ros.messages.joint_state import JointPart, JointStateTemplate
from hpid_ros.nodes.core.middleware import OFFERED
from hpid_ros.nodes.parts.goals import GoalError, ResultCode

SECOND = 1_000_000_000
FALLBACK = 0.75
GAINS = {"law": "pid", "gains__p": 100.0, "gains__i": 100.0, "gains__d": 20.0}


def stream(rate, position, begin=0.0, end=3.0, clock=0.0, lag=0.0):
    """Return the states of one source: when each comes, its stamp in [ns], its position."""
    return [
        (at + lag, round((at + clock) * SECOND), position(at))
        for at in (begin + k / rate for k in range(int((end - begin) * rate)))
    ]


def watched(*streams, **bounds):
    """Return when two sources were recognised, None if never, and when it was one again."""
    watch = SourceWatch(source_bounds(**{"timeout": 0.1, "is_simulated": False, **bounds}))
    begun = ended = None
    for at, stamp_ns, position in sorted(state for each in streams for state in each):
        was_split = watch.is_split
        if watch.take(stamp_ns, position):
            begun = at if begun is None else begun
        elif was_split:
            ended = at
    return begun, ended


@given(
    rates=st.tuples(st.sampled_from([50, 100, 500, 1000]), st.sampled_from([10, 50, 200, 1000])),
    apart=st.floats(0.05, 3.0),
    speed=st.floats(-0.3, 0.3),
    clock=st.sampled_from([0.0, 1e-3, -1e-3, 100.0, -100.0]),
    lag=st.floats(0.0, 0.01),
)
def test_two_sources_are_recognised_with_the_second_state_of_the_other(
    rates, apart, speed, clock, lag
):
    assume(apart + 0.5 * min(speed, 0.0) > 0.05)  # they do not meet meanwhile
    driver = stream(rates[0], lambda at: apart + speed * (at - 1.0))
    zeros = stream(rates[1], lambda at: 0.0, begin=1.0, end=1.5, clock=clock, lag=lag)
    begun, ended = watched(driver, zeros)
    assert 0.0 < begun - 1.0 - lag <= 1.0 / rates[1] + 2.0 / min(rates) + 1e-9
    assert 1.5 < ended < 2.5


@pytest.mark.parametrize("apart", [0.006, 0.03, 1.0])
@pytest.mark.parametrize("is_first", [True, False])
def test_one_stamp_with_two_positions_is_no_repeat(apart, is_first):
    """The field's case: both sources take their stamps from the simulation's clock."""
    driver = stream(200, lambda at: apart)
    zeros = stream(200, lambda at: 0.0, begin=1.0, lag=-1e-4 if is_first else 1e-4)
    begun, _ = watched(driver, zeros)
    assert begun - 1.0 < 0.02


def noisy(rate, deviation, path=math.sin):
    chance = random.Random(3)
    return stream(rate, lambda at: path(at) + chance.gauss(0.0, deviation), end=20.0)


ONE_SOURCE = {
    "noise": noisy(1000, 0.005),
    "a motion, few states": noisy(20, 1e-3, lambda at: 3.0 * math.sin(5.0 * at)),
    "a wheel that wraps": stream(100, lambda at: math.remainder(10.0 * at, math.tau), end=20.0),
    "an encoder at its edge": noisy(
        100, 1e-3, lambda at: math.copysign(math.pi, math.sin(40.0 * at))
    ),
    "flicker of an encoder": stream(100, lambda at: 0.01 * (round(7e3 * at**1.5) % 2), end=20.0),
    "each state resent": sorted(2 * stream(100, math.sin)),
    "a latched state that comes late": [*stream(100, math.sin), (1.005, 0, 0.0)],
    "stamps of a slow clock": [
        (at, stamp // (20 * MS) * 20 * MS, q) for at, stamp, q in stream(200, math.sin)
    ],
    "stamps that stand still": [(at, 0, q) for at, _, q in stream(200, math.sin)],
    "a zero that was set": stream(500, lambda at: math.sin(at) + (at > 1.0)),
    "one wrong state": stream(500, lambda at: math.sin(at) + (abs(at - 1.0) < 1e-3)),
    "a clock that was set": stream(500, math.sin) + stream(500, math.sin, 3.0, 6.0, clock=-50.0),
    "states that get lost": [each for k, each in enumerate(noisy(1000, 1e-3)) if k % 7 % 3],
}


@pytest.mark.parametrize("name", ONE_SOURCE)
def test_what_one_source_may_do_is_not_two(name):
    assert watched(ONE_SOURCE[name]) == (None, None)


def test_a_simulation_that_is_reset_again_and_again_is_one_source():
    episode = stream(100, math.sin, end=0.3)
    assert (
        watched(*[[(k + at, *s) for at, *s in episode] for k in range(9)], is_simulated=True)[0]
        is None
    )


def driven(loop, streams, load=-5.0):
    """Let a joint of inertia 1 under a load follow its loop; return when it was given what."""
    position = velocity = effort = 0.0
    answers = []
    for at, stamp_ns, shown in sorted(streams, key=lambda each: each[0]):
        place = position if shown is None else shown
        effort = loop.step(stamp_ns, place, velocity if shown is None else math.nan)
        if shown is None:
            velocity += 2e-3 * (effort + load)
            position += 2e-3 * velocity
        answers.append((at, effort, loop.state.mode))
    return answers


@examples(0.2)
@given(st.sampled_from([0.0, 1e-3, 7.0]), st.sampled_from([10, 100, 500]))
def test_a_loop_gives_the_fallback_until_one_source_has_ended_and_takes_over(clock, rate):
    """The other source has no velocities at that: NaN in their place."""
    loop = pure_loop(Setpoint(1.0), fallback_effort=FALLBACK, **GAINS)
    driver = stream(500, lambda at: None, end=8.0)
    zeros = stream(rate, lambda at: 0.0, begin=3.0, end=3.5, clock=clock, lag=-1e-4)
    answers = driven(loop, driver + zeros)
    during = [each for each in answers if each[2] is LoopMode.CONFLICT]
    assert 3.0 <= during[0][0] < 3.0 + 1.0 / rate + 0.01
    assert {effort for _, effort, _ in during} == {FALLBACK}
    assert loop.counts.conflicts == 1
    after = [each for each in answers if each[0] > during[-1][0]]
    assert after[0][0] < 4.3
    assert answers[-1][2] is LoopMode.FOLLOWING
    assert loop.error == pytest.approx(0.0, abs=0.05)


def test_two_sources_never_make_a_simulated_joint_begin_again_and_again():
    """Each stamp that goes back resets a loop of a simulated clock; its integral is lost."""
    loop = pure_loop(Setpoint(1.0), state_clock="simulated", fallback_effort=FALLBACK, **GAINS)
    one = stream(500, lambda at: None, end=2.0)
    other = stream(500, lambda at: 0.1, begin=1.0, end=2.0, clock=-0.5, lag=1e-3)
    answers = driven(loop, one + other)
    assert {effort for at, effort, _ in answers if at > 1.05} == {FALLBACK}
    assert loop.counts.resets <= 3


def test_a_goal_is_aborted_none_is_taken_and_the_joints_hold_when_one_source_is_left():
    group = started()
    group.run(0.5)
    assert group.follower.is_active
    outcomes = []
    for _ in range(5):
        group.step()
        false = [JointPart(1, 2.0, None)]
        outcomes.append(group.follower.take_state(group.stamp_ns, false))
    (aborted,) = [each for each in outcomes if each is not None] or group.results
    result = getattr(aborted, "result", aborted)
    assert result.code is ResultCode.INVALID_GOAL
    assert "states of elbow come from two sources: one says" in result.text
    with pytest.raises(GoalError, match="states of elbow come from two sources"):
        group.begin(moving())
    group.run(1.5)
    assert group.follower.conflict == ""
    assert group.told[-1].names == ("shoulder", "elbow")
    group.begin(moving())


@pytest.mark.parametrize("has_own_stamps", [False, True])
def test_a_controller_names_both_nodes_at_once_and_gives_the_fallback(harness, has_own_stamps):
    """A joint's driver, and a node that publishes zeros; then that ends."""
    # They come four times as often: on a busy machine less than half of them would be a warning.
    timing = {"state_timeout": 0.5, "state_clock": "wall", "control_period": 0.02}
    harness.start_controller(fallback_effort=FALLBACK, **timing, **GAINS)
    told = Told(harness)
    other = harness.node.create_publisher(JointState, "joint_states", OFFERED)
    zeros = JointStateTemplate(["wheel", "elbow"], position=True)
    due = time.monotonic()

    def live(with_other):
        nonlocal due
        due = max(due + 0.005, time.monotonic() - 0.05)
        while (left := due - time.monotonic()) > 0.0:
            harness.executor.spin_once(timeout_sec=left)
        now_ns = time.time_ns()
        if with_other:
            stamp_ns = now_ns - 2 * MS if has_own_stamps else now_ns
            other.publish(zeros.encode(stamp_ns, position=[0.0, 0.0]))
        harness.publish(now_ns, 0.3)

    def is_ok():
        live(with_other=False)
        return told.newest().get("level") == DiagnosticStatus.OK

    def is_named():
        live(with_other=True)
        message = told.newest().get("message", "")
        return "states of elbow come from two sources: one says" in message

    harness.wait(is_ok, what="the joint to be held")
    harness.wait(is_named, what="the conflict to be told")
    newest = told.newest()
    assert newest["level"] == DiagnosticStatus.ERROR
    assert "on /joint_states publish: /robot" in newest["message"]
    assert newest["state conflicts"] == "1"

    def falls_back():
        live(with_other=True)
        return {each.effort for each in harness.commands[-20:]} == {(FALLBACK,)}

    harness.wait(falls_back, what="the fallback effort and no other")
    left = "the takeover when one source is left"
    harness.wait(is_ok, within=15.0, what=left, found=told.newest)
    assert told.newest()["takeovers"] == "1"

"""What interrupts a joint loop, in any order: the effort goes on from what was in force."""

import math

import pytest
from harness.loops import pure_loop
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.control.reference import Setpoint
from hpid_ros.control.supervision import SupervisedLoop, Watchdog

MS = 1_000_000
TIMEOUT = 0.05
PARAMETERS = {
    "gains__p": 20.0,
    "gains__d": 2.0,
    "law": "pid",
    "state_timeout": TIMEOUT,
    "u_clamp_max": 8.0,
    "u_clamp_min": -8.0,
}


class Joint:
    """A joint at rest with a wall clock, and the two threads that look at the silence."""

    def __init__(self, **parameters):
        self.told, self.cuts = [], 0
        loop = pure_loop(**PARAMETERS | parameters)
        self.joint = SupervisedLoop(loop, lambda *told: self.told.append(told), self._cut)
        self.joint.watchdog.timeout = TIMEOUT
        self.now = self.stamp = 10**9
        self.in_force = 0.0

    def _cut(self):
        self.cuts += 1

    def states(self, count=1, position=0.3, answer=None):
        """States come every millisecond; return the last effort."""
        for _ in range(count):
            self.now += MS
            self.stamp = self.now
            self.joint.note_past_timeout(self.now)
            self.in_force = self.joint.answer(self.stamp, position, 0.0, self.now, answer)
        return self.in_force

    def wait(self, seconds, *, looks=(), gives=False):
        """No state comes; the executor looks at these times, the supervisor all the time."""
        begin = self.now
        for each in looks:
            self.joint.look(begin + round(each * 1e9))
        self.now = begin + round(seconds * 1e9)
        if gives and self.joint.watchdog.is_silent(self.now):
            self.in_force = self.joint.timeout_effort
        return self.now


def settled(**parameters):
    joint = Joint(**parameters)
    joint.joint.loop.follow(Setpoint(0.5))
    joint.states(1000)
    assert joint.in_force == pytest.approx(4.0, abs=0.01)  # 20 N m/rad times 0.2 rad
    return joint


def test_states_in_time_are_no_silence():
    joint = settled()
    for _ in range(20):
        joint.wait(0.9 * TIMEOUT, looks=[0.5 * TIMEOUT], gives=True)
        joint.states()
    assert joint.told == []
    assert joint.joint.loop.counts.silences == 0


@pytest.mark.parametrize("looks", [[], [0.06], [0.06, 0.08, 0.1]], ids=["none", "one", "three"])
def test_a_silence_is_told_once_and_the_joint_taken_over_from_the_fallback(looks):
    joint = settled(fallback_effort=1.5)
    joint.wait(0.12, looks=looks, gives=True)
    assert joint.in_force == 1.5
    assert joint.states() == pytest.approx(1.5, abs=0.05)
    assert [effort for _, effort in joint.told] == [1.5]
    assert joint.joint.loop.counts.silences == 1


def test_a_freeze_that_froze_the_supervisor_too_ends_with_the_effort_in_force():
    joint = settled(fallback_effort=1.5)
    joint.wait(1.5)
    assert joint.states() == pytest.approx(4.0, abs=0.05)
    assert joint.told == []  # no effort was given
    assert joint.joint.loop.counts.silences == 1
    assert joint.joint.loop.counts.takeovers == 1


def test_an_effort_given_just_before_a_state_is_what_the_loop_takes_over_from():
    joint = settled(fallback_effort=1.5)
    joint.wait(0.06)
    joint.joint.note_past_timeout(joint.now)  # nobody has given anything yet
    assert joint.joint.watchdog.is_silent(joint.now)  # now somebody has
    after = joint.joint.answer(joint.now, 0.3, 0.0, joint.now)
    assert after == pytest.approx(1.5, abs=0.05)
    assert [effort for _, effort in joint.told] == [1.5]


def test_a_driver_that_repeats_its_last_state_is_silent():
    joint = settled(fallback_effort=1.5)
    stamp = joint.stamp
    for _ in range(100):
        joint.now += MS
        joint.joint.answer(stamp, 0.3, 0.0, joint.now)
    assert joint.joint.watchdog.is_silent(joint.now)
    joint.joint.look(joint.now)
    assert [effort for _, effort in joint.told] == [1.5]


def test_a_held_joint_goes_on_from_no_effort():
    joint = settled()
    joint.joint.note_release()
    assert joint.states() == pytest.approx(0.0, abs=0.05)
    assert joint.joint.loop.counts.takeovers == 1


def test_a_damping_stop_answers_in_the_place_of_the_loop_and_is_cut_by_a_silence():
    joint = settled(fallback_effort=1.5)
    assert joint.joint.damp(0.5)
    assert abs(joint.states(50)) < 0.01  # at rest there is nothing to damp
    assert joint.joint.timeout_effort == 0.0
    joint.wait(0.06, gives=True)
    assert joint.in_force == 0.0
    joint.joint.look(joint.now)
    assert joint.cuts == 1
    assert joint.told == []
    joint.joint.loop.release()
    joint.joint.begin()
    joint.states(100)
    assert joint.joint.loop.reference[0] == pytest.approx(0.3)  # it holds


def test_without_a_state_before_there_is_no_ramp():
    joint = Joint()
    assert not joint.joint.damp(0.5)
    assert not settled().joint.damp(0.0)


def test_another_way_to_step_the_loop_is_taken_only_where_the_loop_answers():
    joint = settled()
    assert joint.states(answer=lambda: 7.0) == 7.0
    joint.joint.damp(0.5)
    assert abs(joint.states(answer=lambda: 7.0)) < 0.01


EVENTS = st.lists(
    st.sampled_from(["states", "frozen", "silent", "silent, seen late", "held"]), max_size=12
)


@given(EVENTS, st.floats(-8.0, 8.0))
def test_whatever_interrupts_the_effort_goes_on_from_what_was_in_force(events, fallback):
    joint = settled(fallback_effort=fallback)
    for event in events:
        if event == "frozen":
            joint.wait(0.3)
        elif event == "silent":
            joint.wait(0.3, looks=[0.06, 0.2], gives=True)
        elif event == "silent, seen late":
            joint.wait(0.3, gives=True)
        elif event == "held":
            joint.joint.note_release()
            joint.in_force = 0.0
        before = joint.in_force
        after = joint.states()
        assert math.isfinite(after)
        assert after == pytest.approx(before, abs=0.1), event
        joint.states(20)


def test_a_watchdog_says_when_to_look_again():
    watchdog = Watchdog()
    assert watchdog.time_left(0) == math.inf
    assert not watchdog.is_silent(10**12)
    watchdog.timeout = 0.1
    assert watchdog.time_left(0) == 0.1  # nothing has come yet: there is no silence
    assert not watchdog.is_silent(10**12)
    watchdog.observe(1, 10**9)
    assert watchdog.time_left(10**9 + 40 * MS) == pytest.approx(0.06)
    assert watchdog.time_left(10**9 + 200 * MS) == watchdog.period == 0.025
    assert watchdog.is_silent(10**9 + 101 * MS)
    watchdog.forget()
    assert not watchdog.is_silent(10**9 + 101 * MS)

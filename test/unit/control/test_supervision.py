"""What interrupts a joint loop, in any order: the effort goes on from the active one."""

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
    **{"gains__p": 20.0, "gains__d": 2.0, "law": "pid", "state_timeout": TIMEOUT},
    **{"u_clamp_max": 8.0, "u_clamp_min": -8.0},
}


class Joint(SupervisedLoop):
    """A joint at rest with a wall clock, and the two threads that look at the timeout."""

    def __init__(self, **parameters):
        self.fallbacks, self.cuts = [], []
        super().__init__(
            pure_loop(**PARAMETERS | parameters),
            lambda duration, effort: self.fallbacks.append(effort),
            lambda: self.cuts.append(True),
        )
        self.watchdog.timeout = TIMEOUT
        self.now = 10**9
        self.active = 0.0
        self.is_stuck = False  # the executor

    def states(self, count=1, answer=None):
        """States come every millisecond; return the last effort."""
        for _ in range(count):
            self.now += MS
            self.note_past_timeout(self.now)
            self.active = self.answer(self.now, 0.3, 0.0, self.now, answer)
        return self.active

    def wait(self, seconds, *, looks=(), gives=False):
        """No state comes; the executor looks at these times, the supervisor all the time."""
        begin = self.now
        end, due = begin + round(seconds * 1e9), [begin + round(each * 1e9) for each in looks]
        while gives and self.now < end:
            left = round(self.watchdog.time_left(self.now) * 1e9)
            self.now = min(self.now + left + 1, end)
            while due and due[0] <= self.now:
                self.look(due.pop(0))
            self.supervise()
        self.now = end
        if gives:
            self.supervise()

    def supervise(self):
        """The supervisor looks now."""
        if self.watchdog.is_silent(self.now):
            self.active = self.timeout_effort
        if not self.is_stuck:
            self.watchdog.catch_up(self.now)


def settled(**parameters):
    joint = Joint(**parameters)
    joint.loop.follow(Setpoint(0.5))
    assert joint.states(1000) == pytest.approx(4.0, abs=0.01)  # 20 N m/rad times 0.2 rad
    return joint


def test_states_in_time_are_no_timeout():
    joint = settled()
    for _ in range(20):
        joint.wait(0.9 * TIMEOUT, looks=[0.5 * TIMEOUT], gives=True)
        joint.states()
    assert joint.fallbacks == []
    assert joint.loop.counts.silences == 0


@pytest.mark.parametrize("looks", [[], [0.06], [0.06, 0.08, 0.1]], ids=["none", "one", "three"])
def test_a_timeout_is_noted_once_and_the_joint_taken_over_from_the_fallback(looks):
    joint = settled(fallback_effort=1.5)
    joint.wait(0.12, looks=looks, gives=True)
    assert joint.active == 1.5
    assert joint.states() == pytest.approx(1.5, abs=0.05)
    assert joint.fallbacks == [1.5]
    assert joint.loop.counts.silences == 1


def test_a_freeze_of_the_supervisor_too_ends_with_the_active_effort():
    joint = settled(fallback_effort=1.5)
    joint.wait(1.5)
    assert joint.states() == pytest.approx(4.0, abs=0.05)
    assert joint.states() == pytest.approx(4.0, abs=0.05)
    assert joint.fallbacks == []  # no effort was given
    assert (joint.loop.counts.silences, joint.loop.counts.takeovers) == (1, 1)


def test_an_effort_given_just_before_a_state_is_what_the_loop_takes_over_from():
    joint = settled(fallback_effort=1.5)
    joint.wait(0.045, gives=True)
    joint.now += 15 * MS
    joint.note_past_timeout(joint.now)  # nobody has given anything yet
    assert joint.watchdog.is_silent(joint.now)  # now somebody has
    assert joint.answer(joint.now, 0.3, 0.0, joint.now) == pytest.approx(1.5, abs=0.05)
    assert joint.fallbacks == [1.5]


def test_a_driver_that_repeats_its_last_state_has_timed_out():
    joint = settled(fallback_effort=1.5)
    stamp = joint.now
    for _ in range(100):
        joint.now += MS
        joint.answer(stamp, 0.3, 0.0, joint.now)
    assert joint.watchdog.is_silent(joint.now)
    joint.look(joint.now)
    assert joint.fallbacks == [1.5]


def test_a_damping_stop_answers_in_place_of_the_loop_and_is_cut_by_a_timeout():
    joint = settled(fallback_effort=1.5)
    assert joint.states(answer=lambda: 7.0) == 7.0  # another way to step the loop
    assert joint.damp(0.5)
    assert abs(joint.states(50, answer=lambda: 7.0)) < 0.01  # at rest there is nothing to damp
    assert joint.timeout_effort == 0.0
    joint.wait(0.06, gives=True)
    assert joint.active == 0.0
    joint.look(joint.now)
    assert joint.cuts == [True]
    assert joint.fallbacks == []
    joint.loop.release()
    joint.begin()
    joint.states(100)
    assert joint.loop.following.position == pytest.approx(0.3)  # it holds


def test_without_a_state_before_or_a_duration_there_is_no_ramp():
    assert not Joint().damp(0.5)
    assert not settled().damp(0.0)


@given(
    st.lists(
        st.sampled_from(
            ["states", "frozen", "silent", "silent, seen late", "held", "silent, then held"]
        ),
        max_size=12,
    ),
    st.floats(-8.0, 8.0),
)
def test_whatever_interrupts_the_effort_goes_on_from_the_active_one(events, fallback):
    joint = settled(fallback_effort=fallback)
    for event in events:
        if event.startswith("silent, then"):
            joint.wait(0.1, looks=[0.06], gives=True)
            joint.now += 300 * MS
            joint.note_release(joint.now)
            joint.wait(0.0, gives=True)
            assert joint.active == fallback
        elif event == "held":
            joint.now += 300 * MS
            joint.note_release(joint.now)
            joint.active = 0.0
            assert not joint.watchdog.is_silent(joint.now)  # the states stood still, too
        elif event != "states":
            looks = [0.06, 0.2] if event == "silent" else []
            joint.wait(0.3, looks=looks, gives=event != "frozen")
        before = joint.active
        assert joint.states() == pytest.approx(before, abs=0.1), event
        joint.states(20)


@pytest.mark.parametrize("how", ["frozen", "silent", "held", "held for a moment"])
@pytest.mark.parametrize("period", [MS, 20 * MS])
def test_states_that_waited_get_the_active_effort_and_the_joint_is_taken_over_where_it_is(
    how, period
):
    """It falls while the process stands still, and the states from then come all at once."""
    joint = settled(fallback_effort=1.5)
    stopped, position = joint.now, 0.3
    length = 0.04 if "moment" in how else 1.5
    joint.wait(length, looks=[0.06] if how == "silent" else [], gives=how == "silent")
    if how.startswith("held"):
        joint.note_release(joint.now)
        joint.active = 0.0
    before, thawed = joint.active, joint.now
    for stamp in range(stopped + period, thawed, period):
        joint.now += MS // 5
        position = 0.3 - (stamp - stopped) / 1e9
        if joint.now - stamp > 15 * MS:
            assert joint.answer(stamp, position, -1.0, joint.now) == before
    joint.now += 10 * MS
    for _ in range(5):
        joint.now += MS
        effort = joint.answer(joint.now, position, 0.0, joint.now)
        assert effort == pytest.approx(before, abs=0.1)
    assert joint.loop.counts.takeovers == 1


def test_a_resumption_ends_within_a_second_whatever_comes_meanwhile():
    """As where states come more rarely than the timeout, and later than they did."""
    joint = settled(fallback_effort=1.5)
    answered, begun = joint.loop.counts.samples, joint.now
    while joint.now < begun + 2 * 10**9:
        joint.wait(0.08, looks=[0.06], gives=True)
        joint.answer(joint.now - 300 * MS, 0.3, 0.0, joint.now)
    assert joint.loop.counts.samples > answered


def test_what_was_before_an_activation_counts_no_more():
    joint = settled()
    joint.wait(0.3, looks=[0.06], gives=True)
    joint.note_release(joint.now)
    joint.loop.release()
    joint.begin()
    for _ in range(3):
        joint.now += MS
        joint.answer(joint.now - 10**12, 0.4, 0.0, joint.now)
    assert joint.loop.following.position == 0.4
    assert joint.loop.counts.samples == 1000 + 3


def test_ctrl_z_in_a_damping_stop_leaves_nothing_of_it_in_force():
    joint = settled()
    joint.damp(0.5)
    for k in range(20):
        joint.now += MS
        joint.active = joint.answer(joint.now, 0.3 + 2e-3 * k, 2.0, joint.now)
    assert joint.active < -1.0
    stopped = joint.now
    joint.now += 200 * MS
    joint.note_release(joint.now)
    assert joint.answer(stopped + 5 * MS, 0.4, 2.0, joint.now) == 0.0


@pytest.mark.parametrize("offset", [-(10**12), 10**12, 50 * MS])
def test_a_clock_that_was_set_in_a_silence_costs_a_twentieth_of_a_second(offset):
    joint = settled()
    joint.wait(1.5)
    effort = joint.active
    for k in range(1, 60):
        joint.now += MS
        joint.active = joint.answer(joint.now - offset, 0.3 + 1e-3 * k, 0.0, joint.now)
    assert joint.active != effort


def test_a_watchdog_says_when_to_look_again():
    watchdog = Watchdog()
    assert watchdog.time_left(0) == math.inf
    assert not watchdog.is_silent(10**12)
    watchdog.timeout = 0.1
    assert watchdog.time_left(0) == watchdog.period == 0.025  # nothing has come yet
    assert not watchdog.is_silent(10**12)
    watchdog.observe(1, 10**9)
    assert watchdog.time_left(10**9 + 40 * MS) == 0.025
    assert watchdog.time_left(10**9 + 90 * MS) == pytest.approx(0.01)
    assert watchdog.time_left(10**9 + 200 * MS) == 0.025
    for k in range(1, 10):
        assert not watchdog.is_silent(10**9 + 10 * k * MS)
    assert watchdog.is_silent(10**9 + 101 * MS)
    watchdog.forget()
    assert not watchdog.is_silent(10**9 + 101 * MS)


def test_a_damping_stop_damps_the_measured_velocity_and_a_step_within_the_largest_is_no_outlier():
    joint = settled(velocity_max=2.0)
    joint.damp(0.5)
    for position in (0.3, 0.4, 0.3):  # 0.1 rad may be a count, and 2 ms of the largest speed more
        joint.now += MS
        assert joint.answer(joint.now, position, 1.0, joint.now) < -1.0


@pytest.mark.parametrize(
    ("stamp_ns", "line"),
    [
        (0, "the stamps of joint_states are 0: their driver has to stamp them"),
        (1_500 * MS, "the stamps of joint_states stand still at 1.500 s"),
    ],
)
def test_stamps_stand_still_where_one_comes_again_and_again(stamp_ns, line):
    watchdog = Watchdog()
    watchdog.observe(stamp_ns, 0)
    assert watchdog.standstill(10**9, 0.1) == ""  # nothing has come since
    for k in range(1, 4):
        watchdog.observe(stamp_ns, k * MS)
    assert watchdog.standstill(4 * MS, 0.1) == ""  # not for long
    assert watchdog.standstill(200 * MS, 0.1) == line
    watchdog.observe(stamp_ns + 1, 201 * MS)
    assert watchdog.standstill(10**9, 0.1) == ""


FREEZES = st.sampled_from([0.05, 0.09, 0.2, 1.2, 3.0, 10.0])


@given(
    FREEZES,
    st.lists(st.sampled_from(["executor", "supervisor"]), max_size=8),
    st.floats(0.0, 0.09),
)
def test_states_that_wait_are_taken_before_a_timeout_is_believed(length, looks, late):
    """Whichever thread is first after a freeze, and however often, until the states are read."""
    joint = settled(fallback_effort=1.5)
    joint.wait(0.01, gives=True)
    joint.now += round(length * 1e9)
    for each in looks:
        joint.now += round(late * 1e9 / len(looks))
        joint.supervise() if each == "supervisor" else joint.look(joint.now)
    before = joint.active
    assert before == pytest.approx(4.0, abs=0.05)
    assert joint.states() == pytest.approx(before, abs=0.1)
    joint.states(20)
    assert joint.fallbacks == []


@given(FREEZES, st.booleans())
def test_a_robot_whose_states_ended_in_a_freeze_gets_the_fallback_after_it(length, is_stuck):
    joint = settled(fallback_effort=1.5)
    joint.is_stuck = is_stuck
    joint.now += round(length * 1e9)
    thawed = joint.now
    while joint.active != 1.5:
        joint.supervise()
        joint.now += round(joint.watchdog.time_left(joint.now) * 1e9) + 1
    assert joint.now - thawed <= (0.1 + 0.25 * is_stuck + TIMEOUT) * 1e9
    joint.look(joint.now)
    assert joint.fallbacks == [1.5]


def test_a_loop_that_has_fallen_behind_takes_what_waits_before_a_timeout_is_believed():
    """Its thread is the last to run again, and has much else to do."""
    joint = settled(fallback_effort=1.5)
    joint.is_stuck = True
    joint.now += 1200 * MS
    begun = joint.now
    while joint.now < begun + 300 * MS:
        joint.supervise()
        joint.now += round(joint.watchdog.time_left(joint.now) * 1e9) + 1
    assert joint.states() == pytest.approx(4.0, abs=0.1)
    assert joint.fallbacks == []


def test_a_machine_that_hardly_runs_the_process_delays_the_fallback_by_a_few_looks():
    """Each look comes late, as after a standstill; the states have ended."""
    joint = settled(fallback_effort=1.5)
    for _ in range(4):
        joint.now += 500 * MS
        assert joint.active == pytest.approx(4.0, abs=0.05)
        joint.supervise()
    assert joint.active == 1.5

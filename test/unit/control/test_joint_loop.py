"""One joint's sample: time, references, limits, anti-windup, faults, retuning."""

import itertools
import math
from functools import partial

import pytest
from harness.loops import loops_with
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import EndedError, SettingError, TrajectoryError
from hpid_ros.control import Gains
from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot

MS = 1_000_000
SECOND = 1000 * MS

settings, loop_on = loops_with(joint="j", gains=Gains(10.0, 4.0, 2.0), law="pid")


def hold(loop, count, position=0.0, velocity=0.0):
    for k in range(count):
        loop.step(k * MS, position, velocity)
    return loop


@pytest.mark.parametrize("period_ns", [MS // 4, 2 * MS, 10 * MS, 50 * MS])
def test_any_rate_holds_a_joint(period_ns):
    period, gains = period_ns * 1e-9, Gains(30.0, 20.0, 8.0)
    loop = loop_on(Setpoint(0.5), gains=gains, control_period=period, inertia=1.0)
    position = velocity = 0.0
    for k in range(10_000 * MS // period_ns):
        velocity += period * loop.step(k * period_ns, position)
        position += period * velocity
    assert position == pytest.approx(0.5, abs=0.01)
    assert loop.counts.gaps == 0


@pytest.mark.parametrize(("law", "mu"), [("pid", 0.0), ("hpid", -0.2), ("hpid", 0.2)])
def test_loop_brings_a_loaded_joint_to_its_setpoint(law, mu):
    loop = loop_on(Setpoint(0.7), law=law, mu=mu, gains=Gains(75.0, 125.0, 15.0))
    position = velocity = 0.0
    for k in range(10_000):
        velocity += 1e-3 * (loop.step(k * MS, position, velocity) - 3.0)
        position += 1e-3 * velocity
    assert position == pytest.approx(0.7, abs=2e-3)
    assert loop.law.integral == pytest.approx(3.0, abs=0.2)
    assert loop.counts.samples == 10_000


def test_velocities_that_are_zero_while_the_joint_moves_are_doubted():
    """What a driver that measures none may fill in; a quantised one shows some now and then."""
    loop, k = loop_on(velocity_source="measured"), 0
    for count, velocity, is_doubted in ((40, 0.0, False), (20, 0.0, True), (1, 1e-6, False)):
        for _ in range(count):
            k += 1
            loop.step(k * MS, 1e-3 * k, velocity)
        assert ("all 0, and the joint has moved by 0.05" in loop.estimation.warning) is is_doubted
        assert ("velocity_source filtered" in loop.estimation.warning) is is_doubted
    loop.reset()
    for k in range(5000):  # at rest, seen by a noisy encoder
        loop.step(k * MS, 0.01 * math.sin(k), 0.0)
    assert loop.estimation.warning == ""


@pytest.mark.parametrize(
    ("source", "velocity", "origin"),
    [
        ("measured", 1.0, "measured"),
        ("measured", None, "filtered, the states have none"),
        ("filtered", None, "filtered"),
        ("homogeneous_differentiator", 1.0, "homogeneous_differentiator"),
    ],
)
def test_a_loop_reports_where_its_velocity_comes_from(source, velocity, origin):
    loop = loop_on(velocity_source=source)
    loop.step(0, 0.0, velocity)
    assert (loop.estimation.origin, loop.estimation.warning) == (origin, "")


@pytest.mark.parametrize(
    "changes",
    [
        *({"velocity_filter_time_constant": tau} for tau in (0.0, 0.002, 0.02)),
        {"velocity_source": "homogeneous_differentiator", "acceleration_bound": 20.0},
        {"velocity_source": "measured"},  # by states that have none
    ],
)
def test_a_constant_velocity_is_found(changes):
    loop = loop_on(**{"velocity_source": "filtered", **changes})
    for k in range(1000):
        loop.step(k * MS, 3.0 * k * 1e-3)
    assert loop.estimation.velocity == pytest.approx(3.0, rel=1e-9)


def test_a_loop_without_a_reference_holds_its_first_position():
    loop = loop_on()
    assert loop.state.mode is LoopMode.WAITING
    assert loop.step(5 * MS, 1.25, 0.0) == 0.0
    assert loop.state.mode is LoopMode.HOLDING
    assert loop.step(6 * MS, 1.0, 0.0) == pytest.approx(10.0 * 0.25)
    assert loop.following.reference == (1.25, 0.0)


def test_a_repeated_stamp_gets_the_last_effort_and_changes_nothing():
    loop = loop_on()
    loop.step(0, 0.0, 0.0)
    effort = loop.step(MS, 0.1, 0.0)
    integral = loop.law.integral
    assert loop.step(MS, 99.0, 99.0) == effort
    assert (loop.law.integral, loop.counts.repeats, loop.counts.samples) == (integral, 1, 2)


def test_a_simulated_clock_that_goes_back_resets_loop_and_motion():
    loop = loop_on(Column("j", (Knot(0, 0.0), Knot(SECOND, 1.0))), state_clock="simulated")
    first = [loop.step(k * MS, 0.05 * k, 0.0) for k in range(10, 20)]
    again = [loop.step(k * MS - 5 * MS, 0.05 * k, 0.0) for k in range(10, 20)]
    assert again == first  # integral, velocity filter and trajectory began again
    assert loop.counts.resets == 1


@pytest.mark.parametrize(
    ("start", "position", "is_dropped"),
    [
        (0.0, 1.0, False),  # with the next state: it starts again
        (1e-9, 1.0, False),  # under way by the new clock, too
        (5.0, 0.2, True),  # from before the clock went back: nobody expects it any more
        (60.0, 0.2, True),  # and had not begun
    ],
)
def test_a_motion_that_a_simulated_clock_has_yet_to_reach_again_is_dropped(
    start, position, is_dropped
):
    motion = Column("j", (Knot(0, 0.0, 0.0), Knot(SECOND, 1.0, 0.0)), round(start * SECOND))
    loop = loop_on(motion, state_clock="simulated")
    for k in range(5900, 6100):
        loop.step(k * MS, 0.9, 0.0)
    for k in range(70_000):
        loop.step(k * MS, 0.2, 0.0)
    assert loop.following.position == pytest.approx(position)
    assert ("went back to 0.000 s" in loop.dropped) is is_dropped
    assert (loop.following.motion is None) is is_dropped


STATES = st.integers(100 * SECOND, 10**18)


@given(STATES, st.integers(-(10**11), 10**13), st.integers(1, 10**11), st.booleans())
def test_a_trajectory_is_taken_where_the_action_would_take_it_but_for_a_second(
    now_ns, ahead_ns, length_ns, carries_on
):
    """One rule: what has ended, or starts more than an hour ahead, moves nothing."""
    motion = Column("j", (Knot(length_ns, 1.0),), max(now_ns + ahead_ns, 1))
    start_ns, end_ns = motion.window_ns
    loop = loop_on(Setpoint(0.5))
    loop.step(now_ns - MS, 0.0, 0.0)
    loop.step(now_ns, 0.0, 0.0)
    is_over, is_far = end_ns + SECOND < now_ns, start_ns > now_ns + 3600 * SECOND
    try:
        loop.receive(motion, carries_on=carries_on)
    except EndedError:
        assert is_over
        assert not carries_on
    except TrajectoryError:
        assert is_far
    else:
        assert not is_far
        assert not is_over or carries_on
        return
    loop.step(now_ns + MS, 0.0, 0.0)
    assert loop.following.reference == (0.5, 0.0)


@pytest.mark.parametrize("jump", [-50, 7200])
def test_a_trajectory_of_the_clock_to_which_a_first_stamp_leads_is_taken(jump):
    """As a stop that answers a jump of the clock, before a second stamp has confirmed it."""
    loop = loop_on()
    for k in range(100):
        loop.step(100 * SECOND + k * MS, 0.0, 0.0)
    there_ns = (100 + jump) * SECOND
    stop = Column("j", (Knot(0, 0.0, 0.0), Knot(SECOND, 0.0, 0.0)), there_ns)
    with pytest.raises(TrajectoryError):
        loop.receive(stop)
    loop.step(there_ns, 0.0, 0.0)
    loop.receive(stop)


def test_what_starts_too_far_after_the_first_state_is_named_then():
    loop = loop_on()
    loop.receive(Column("j", (Knot(0, 1.0),), 10**18))
    loop.step(0, 0.2, 0.0)
    assert "must start within 3600 s" in loop.dropped
    assert loop.following.motion is None


@pytest.mark.parametrize("back", [1, 5, 10**6])
def test_single_older_states_leave_no_trace(back):
    """As of a second publisher, or out of order: effort, integral and a motion go on."""
    loop, clean = (loop_on(Column("j", (Knot(0, 0.0), Knot(SECOND, 1.0)))) for _ in range(2))
    for k in range(200):
        effort = loop.step(k * MS, 1e-3 * k, 1.0)
        assert effort == pytest.approx(clean.step(k * MS, 1e-3 * k, 1.0), rel=1e-9)
        if k > 100:
            assert loop.step((k - back) * MS - 1, 0.7, -1.0) == effort
    assert loop.counts.resets == 0


@pytest.mark.parametrize("is_first", [True, False])
def test_a_setpoint_that_comes_beside_a_takeover_is_no_step(is_first):
    loop = hold(loop_on(Setpoint(0.0)), 20)
    acts = [partial(loop.receive, Setpoint(1.0)), loop.note_unanswered]
    for act in acts if is_first else reversed(acts):
        act()
    for k in range(20, 25):
        loop.step(k * MS, 0.0, 0.0)
        assert abs(loop.following.position) < 1e-3
    for k in range(25, 600):
        loop.step(k * MS, 0.0, 0.0)
    assert loop.following.position == 1.0
    loop.receive(Setpoint(0.5))
    loop.step(600 * MS, 0.0, 0.0)
    assert loop.following.position == 0.5


def test_a_setpoint_that_was_received_before_the_first_state_is_no_step():
    loop = loop_on()
    loop.receive(Setpoint(1.0))
    loop.step(SECOND, 0.2, 0.0)
    references = [loop.following.position]
    for k in range(1, 600):
        loop.step(SECOND + k * MS, 0.2, 0.0)
        references.append(loop.following.position)
    assert references[0] == pytest.approx(0.2)
    assert max(b - a for a, b in itertools.pairwise(references)) < 0.005
    assert references[-1] == 1.0
    loop.receive(Setpoint(0.5))  # now whoever sends it knows where the joint is
    loop.step(SECOND + 600 * MS, 0.2, 0.0)
    assert loop.following.position == 0.5


def test_a_gap_restarts_the_derivative_and_leaves_the_effort_as_it_is():
    loop = loop_on(velocity_source="filtered", velocity_filter_time_constant=0.0)
    for k in range(3):
        loop.step(k * MS, 0.001 * k)
    effort = loop.law.effort
    assert loop.estimation.velocity == pytest.approx(1.0)
    assert loop.step(3 * SECOND - MS, 7.0) == effort  # its stamp may be wrong
    assert loop.step(3 * SECOND, 0.5) == pytest.approx(effort)
    assert (loop.estimation.velocity, loop.counts.gaps, loop.counts.takeovers) == (0.0, 1, 1)
    loop.step(3 * SECOND + MS, 0.501)
    assert loop.estimation.velocity == pytest.approx(1.0)


def test_the_first_sample_integrates_nothing():
    loop = loop_on(Setpoint(1.0))
    loop.step(10**18, 0.0, 0.0)
    assert loop.law.integral == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["position", "velocity"])
def test_a_state_that_is_not_finite_gets_no_effort_and_leaves_no_trace(bad, where):
    loop = hold(loop_on(Setpoint(1.0), velocity_source="measured"), 2)
    integral = loop.law.integral
    assert loop.step(2 * MS, **{"position": 0.0, "velocity": 0.0, where: bad}) == 0.0
    assert loop.state.mode is LoopMode.FAULT
    assert (loop.law.integral, loop.counts.rejected) == (integral, 1)
    assert f"{where} {bad} rad" in loop.last_fault
    advised = "velocity_source filtered does without" in loop.last_fault
    assert advised is (where == "velocity")
    assert loop.step(3 * MS, 0.0, 0.0) == pytest.approx(10.0 + integral)
    assert loop.state.mode is LoopMode.FOLLOWING


@pytest.mark.parametrize(
    ("changes", "integral"),
    [
        ({"antiwindup_strategy": "none"}, 4.0 * 2.0),  # it runs away
        ({"antiwindup_strategy": "none", "i_clamp_max": 0.3}, 0.3),
        ({"antiwindup_strategy": "conditional_integration"}, 0.0),
        # As control_toolbox: ki e + (u - u_wanted) / trk = 0 with u_wanted = kp e + I, e = 1.
        ({"tracking_time_constant": 0.05}, 1.0 - 10.0 + 4.0 * 0.05),
        (
            {"tracking_time_constant": 1e-4},
            1.0 - 10.0 + 4.0 * 1e-3,
        ),  # shorter than a period: all at once
        ({"gains": Gains(10.0, 40.0, 2.0)}, 1.0 - 10.0 + 40.0 * math.sqrt(2.0 / 40.0)),
        ({"gains": Gains(10.0, 40.0, 0.0)}, 1.0 - 10.0 + 40.0 * 10.0 / 40.0),
        # Nothing winds up, and nothing winds back.
        ({"tracking_time_constant": 0.05, "gains": Gains(10.0, 0.0, 2.0)}, 0.0),
    ],
)
def test_where_the_integral_settles_while_the_effort_is_saturated(changes, integral):
    values = {"antiwindup_strategy": "back_calculation", "u_clamp_max": 1.0, **changes}
    loop = hold(loop_on(Setpoint(1.0), **values), 2001)
    assert loop.law.integral == pytest.approx(integral, abs=0.01)
    loop.follow(Setpoint(-1.0))
    loop.step(loop.state.stamp_ns + MS, 0.0, 0.0)
    assert loop.law.integral < integral or loop.settings.gains.i == 0.0  # it comes back at once


def test_a_loop_cannot_be_retuned_to_another_joint():
    with pytest.raises(SettingError, match="cannot change from 'j' to 'k'"):
        loop_on().retune(settings(joint="k"))


@pytest.mark.parametrize(
    ("before", "after", "fastest"),
    [
        (Setpoint(0.4), Column("j", (Knot(SECOND, 1.0, 0.0),)), 0.9),
        (Column("j", (Knot(600 * MS, 1.0, 0.0),)), Column("j", (Knot(SECOND, -0.4, 0.0),)), 2.6),
        # It waits at the stop; the new one, of rest, is under way, so it is glided onto.
        (Setpoint(3.0), Column("j", (Knot(MS, 0.0), Knot(SECOND, 0.0)), 200 * MS), 4.51),
    ],
    ids=["at rest", "under way", "from a stop"],
)
def test_a_new_motion_begins_where_the_reference_is(before, after, fastest):
    loop = loop_on(position_max=1.2, position_min=-1.2, takeover_time=0.5)
    loop.step(0, 0.0, 0.0)
    loop.follow(before)
    speeds = []
    for k in range(1, 1500):
        if k == 300:
            loop.follow(after)
        here, rate = loop.following.reference
        loop.step(k * MS, here, rate)
        if k > 1:  # a setpoint is a step
            speeds.append(abs(loop.following.velocity))
            assert loop.following.position == pytest.approx(here + 1e-3 * rate, abs=5e-5)
    assert max(speeds) < fastest


@given(st.lists(st.integers(1, 40), min_size=1, max_size=30))
def test_missed_samples_are_counted_from_the_stamps(steps):
    loop, stamp_ns = loop_on(control_period=0.001), 0
    loop.step(stamp_ns, 0.0, 0.0)
    for periods in steps:
        stamp_ns += periods * MS
        loop.step(stamp_ns, 0.0, 0.0)
    assert loop.counts.missed == sum(steps) - len(steps)


def test_settings_that_no_law_can_be_made_of_change_nothing():
    loop, twin = (loop_on(Setpoint(0.5), compensation="decoupling") for _ in range(2))
    for each in (hold(loop, 20), hold(twin, 20)):
        each.step(20 * MS, 0.1, 0.3)
    with pytest.raises(SettingError, match="needs the inertia"):
        loop.retune(
            settings(
                compensation="decoupling",
                norm__effort_scale=3.0,
                velocity_filter_time_constant=0.1,
            )
        )
    assert [loop.step(k * MS, 0.1, 0.3) for k in range(21, 40)] == [
        twin.step(k * MS, 0.1, 0.3) for k in range(21, 40)
    ]


def test_a_setpoint_is_glided_onto_once_more_where_a_simulated_clock_begins_again():
    loop = hold(loop_on(Setpoint(0.5), state_clock="simulated", takeover_time=0.2), 600, 0.5)
    assert loop.following.position == 0.5
    places = []
    for k in range(300):
        loop.step(k * MS, 0.0, 0.0)
        places.append(loop.following.position)
    assert places[0] == 0.0
    assert max(b - a for a, b in itertools.pairwise(places)) < 0.006
    assert places[-1] == 0.5

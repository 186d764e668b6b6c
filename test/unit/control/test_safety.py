"""Timeouts, takeover, jumps, retuning and limits of the pure loop: no effort moves by a jump."""

import math
import random

import numpy as np
import pytest
from harness.examples import examples
from harness.loops import IN_EFFORT, OTHER_VALUES, STOPS, TURNS, loops_with
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control import LOOP_PARAMETERS, Gains, JointLoop, LoopSettings
from hpid_ros.control.assembly import make_law, make_motion_limits, soft_stop_gains
from hpid_ros.control.following import Glide, Offset
from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot

MS = 1_000_000
SECOND = 1000 * MS
RAMP = Column("j", (Knot(0, 0.0, 0.0), Knot(4 * SECOND, 2.0, 0.0)), stamp_ns=SECOND)
MOTIONS = [None, Setpoint(1.0), RAMP]
WITHOUT_VELOCITIES = ["filtered", "homogeneous_differentiator", "observer"]

settings, loop_on = loops_with(joint="j", gains=Gains(100.0, 50.0, 20.0), law="pid")


def run(loop, first_ms, last_ms, position, velocity=0.0):
    """Return the last effort of a joint at rest, or of one that passes 0 at 0 s."""
    for k in range(first_ms, last_ms):
        effort = loop.step(k * MS, position + velocity * k * 1e-3, velocity)
    return effort


def largest_change(*efforts):
    return np.abs(np.diff(efforts)).max()


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("fallback", [0.0, 4.0])
def test_after_a_timeout_the_loop_takes_over_from_where_the_joint_fell_without_a_jump(
    motion, fallback
):
    loop = loop_on(motion, fallback_effort=fallback)
    assert abs(run(loop, 1000, 2000, 0.3)) > 2.0 or motion is None
    assert loop.note_timeout() == fallback
    assert loop.state.mode is LoopMode.SILENT
    assert loop.step(2499 * MS, 0.1, 0.0) == fallback  # its stamp may be wrong
    effort = loop.step(2500 * MS, -0.4, 0.0)
    assert effort == pytest.approx(fallback)
    assert loop.following.reference == pytest.approx((-0.4, 0.0))
    assert (loop.counts.silences, loop.counts.takeovers, loop.counts.gaps) == (1, 1, 1)
    after = [loop.step((2500 + k) * MS, -0.4, 0.0) for k in range(1, 520)]
    assert largest_change(effort, *after) < 2.5  # the glide's own pace
    if motion is RAMP:  # 1.4 rad away: longer than takeover_time, or it would be too fast
        speeds = []
        for k in range(3020, 6600):
            loop.step(k * MS, -0.4, 0.0)
            speeds.append(abs(loop.following.velocity))
        assert max(speeds) < 3.0 * RAMP.pace.fastest  # it must catch up
        assert loop.following.reference == (2.0, 0.0)
    else:  # without a motion it holds where the joint is now
        assert loop.following.reference == (1.0 if motion else -0.4, 0.0)


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_freeze_that_nobody_noticed_is_a_takeover_too(motion):
    """SIGSTOP stops the watchdog with the loop: only the stamps show it."""
    loop = loop_on(motion, law="hpid", mu=-0.2)
    for k in range(1000, 1500):
        before = loop.step(k * MS, 0.1 + 1e-4 * (k - 1000), 0.1)
    assert loop.step(2999 * MS, 0.9, 0.0) == before
    effort = loop.step(3000 * MS, 0.15, 0.0)
    assert effort == pytest.approx(before)
    assert (loop.counts.takeovers, loop.counts.gaps, loop.counts.silences) == (1, 1, 0)
    after = [loop.step((3000 + k) * MS, 0.15, 0.0) for k in range(1, 400)]
    assert largest_change(effort, *after) < 3.0


def test_a_pause_of_the_control_clock_leaves_no_trace():
    loop, twin = (loop_on(RAMP, state_clock="simulated") for _ in range(2))
    for k in range(1000, 1500):
        assert loop.step(k * MS, 0.1, 0.0) == twin.step(k * MS, 0.1, 0.0)
        if k % 100 == 50:
            assert loop.note_timeout() == 0.0
            assert loop.step(k * MS, 0.1, 0.0) == twin.law.effort  # asked again: the same answer
    assert loop.counts.takeovers == 0


@pytest.mark.parametrize("clock", ["wall", "simulated"])
def test_only_a_simulated_clock_can_be_paused(clock):
    """Stamps that count samples do not show that the joint hung free meanwhile."""
    is_wall = clock == "wall"
    loop = loop_on(Setpoint(1.0), state_clock=clock, fallback_effort=1.0)
    before = run(loop, 0, 200, 0.2)
    assert loop.note_timeout() == 1.0
    assert loop.step(199 * MS, 0.2, 0.0) == (1.0 if is_wall else before)
    assert loop.step(200 * MS, 0.2, 0.0) == pytest.approx(1.0 if is_wall else before, abs=0.1)
    assert loop.counts.takeovers == is_wall
    before = loop.law.effort
    loop.note_unanswered()  # nobody gave another effort
    assert loop.step(201 * MS, 0.2, 0.0) == pytest.approx(before, abs=0.1)
    assert (loop.counts.takeovers, loop.counts.silences) == (2 * is_wall, 2)


def test_a_repeat_is_held_to_the_present_limits():
    loop = loop_on(Setpoint(1.0))
    assert run(loop, 0, 200, 0.2) > 80.0
    loop.retune(settings(u_clamp_max=5.0))
    assert loop.step(199 * MS, 0.2, 0.0) == 5.0
    loop.retune(settings(u_clamp_max=5.0, velocity_max=1.0))
    loop.step(200 * MS, 0.2, 0.9)
    loop.retune(settings(u_clamp_max=5.0, velocity_max=0.5))
    assert loop.step(200 * MS, 0.2, 0.9) == pytest.approx(-20.0 * 0.4)  # it brakes
    loop.note_timeout()
    loop.retune(settings(fallback_effort=2.0))
    assert loop.step(200 * MS, 0.2, 0.9) == 2.0


def test_a_single_position_that_no_joint_can_have_come_to_is_passed_over():
    values = {"velocity_source": "filtered", "velocity_max": 5.0}
    loop, twin = (loop_on(Setpoint(0.5), **values) for _ in range(2))
    before = 0.0
    for k in range(300):
        position = 0.2 + 1e-4 * k
        effort = twin.step(k * MS, position)
        if k == 200:
            assert loop.step(k * MS, position + 1.0) == before  # the effort stays
            assert loop.counts.jumps == 1
            assert "jumped by 1" in loop.last_fault
        else:
            before = loop.step(k * MS, position)
            assert before == pytest.approx(effort, abs=1e-3 if k < 200 else 0.1)
    assert loop.counts.takeovers == 0


def test_a_joint_that_is_elsewhere_for_good_is_taken_over_from_there():
    loop = loop_on(Setpoint(0.5), velocity_source="filtered", velocity_max=5.0)
    before = run(loop, 0, 200, 0.2)
    efforts = [loop.step((200 + k) * MS, 1.2) for k in range(300)]
    assert efforts[:2] == pytest.approx([before, before])
    assert (loop.counts.jumps, loop.counts.takeovers) == (1, 1)
    assert largest_change(*efforts) < 2.5
    run(loop, 500, 800, 1.2)
    assert loop.following.reference == (0.5, 0.0)


def test_the_damping_of_jumps_in_a_row_is_not_added_up():
    """An encoder whose zero is set again and again, on a joint that moves all the while."""
    loop = loop_on(velocity_max=5.0)
    here = run(loop, 0, 200, 0.0, 1.0)
    efforts = [loop.step(k * MS, 1e-3 * k + 2.0 * (k // 2 - 100), 1.0) for k in range(200, 240)]
    assert loop.counts.takeovers > 15
    # Each takes over at rest, at the joint's 1 rad/s: 20 N m of damping, as held before.
    assert np.max(np.abs(np.array(efforts) - here)) < 20.0 + 1.0


def test_positions_that_jump_about_are_no_positions():
    loop = loop_on(Setpoint(0.5), fallback_effort=0.5, velocity_max=5.0)
    before = run(loop, 0, 200, 0.2)
    efforts = [loop.step((200 + k) * MS, (-1.0) ** k * (2.0 + k), 0.0) for k in range(50)]
    assert efforts[0] == before
    assert set(efforts[1:]) == {0.5}
    assert loop.state.mode is LoopMode.FAULT
    assert loop.step(260 * MS, 0.2, 0.0) == pytest.approx(before, abs=0.2)  # it was short


@pytest.mark.parametrize(
    ("changes", "step", "jumps"),
    [
        ({"velocity_max": 2.0}, 0.12, 1),
        ({"velocity_max": 2.0}, 0.10, 0),
        ({}, 3.2, 1),
        ({}, 3.1, 0),
        ({"position_step_max": 0.3}, 0.35, 1),
        ({"position_step_max": 0.3, "velocity_max": 20.0}, 0.35, 0),
        ({"position_step_max": 1e6}, 50.0, 0),
    ],
)
def test_the_largest_step_is_that_of_the_velocity_limit_or_is_none(changes, step, jumps):
    loop = loop_on(**changes)
    run(loop, 0, 10, 0.0)
    loop.step(10 * MS, step, 0.0)
    assert loop.counts.jumps == jumps


@pytest.mark.parametrize(("duration", "takeovers"), [(50, 0), (150, 1)])
def test_states_that_cannot_be_used_end_in_a_takeover_only_after_the_timeout(duration, takeovers):
    loop = loop_on(Setpoint(1.0))
    before = run(loop, 0, 200, 0.2)
    for k in range(200, 200 + duration):
        assert loop.step(k * MS, math.nan) == 0.0
    assert "position nan" in loop.last_fault
    effort = loop.step((200 + duration) * MS, 0.2, 0.0)
    assert loop.counts.takeovers == takeovers
    assert effort == pytest.approx(0.0 if takeovers else before, abs=0.1)


@pytest.mark.parametrize("is_taken_over", [False, True])
@pytest.mark.parametrize("changes", [{}, {"gains__i": 0.0}, {"encoder_wrap": math.tau}])
@pytest.mark.parametrize("position", [3.1, 0.2, -3.0])
def test_a_single_stamp_from_the_future_leaves_nothing_behind(position, changes, is_taken_over):
    values = {"velocity_source": "filtered", "velocity_max": 5.0, **changes}
    loop, twin = (loop_on(Setpoint(3.0), **values) for _ in range(2))
    for each in (loop, twin):
        run(each, 0, 200, 3.1)
        if is_taken_over:
            each.supersede(1.0)
    assert loop.step(3_600_000 * MS, position) == twin.law.effort
    loop.retune(loop.settings.with_parameters({"gains.p": 100.0}))
    loop.retune(twin.settings)
    efforts = [[each.step(k * MS, 3.1) for k in range(200, 400)] for each in (loop, twin)]
    assert efforts[0] == pytest.approx(efforts[1], abs=1e-9)
    assert (loop.counts.resets, loop.counts.takeovers) == (0, is_taken_over)
    assert loop.counts.missed == 0


@pytest.mark.parametrize(
    "states", [[(math.nan, 0)], [(9.0, 0), (9.0, 200)], [(0.2, 0), (9.0, 200)]]
)
def test_a_stamp_from_the_future_is_forgotten_whatever_else_is_wrong(states):
    """The position, or that of the next state."""
    loop = loop_on(Setpoint(1.0), velocity_max=5.0)
    before = run(loop, 0, 200, 0.2)
    for position, at in states:
        loop.step((at or 3_600_000) * MS, position, 0.0)
    after = [loop.step((201 + k) * MS, 0.2, 0.0) for k in range(100)]
    assert after[0] == pytest.approx(before, abs=0.2)
    assert largest_change(*after) < 0.2
    assert (loop.counts.resets, loop.counts.takeovers) == (0, 0)


def test_a_clock_that_really_jumped_goes_on_from_there():
    loop = loop_on(Setpoint(1.0))
    before = run(loop, 0, 200, 0.2)
    assert run(loop, 90_000, 90_002, 0.2) == pytest.approx(before, abs=0.1)
    run(loop, 200, 202, 0.2)  # two were not single: now it is these that went back
    assert loop.counts.resets == 1


@pytest.mark.parametrize(("begun", "ends_at", "damping"), [(0.5, 0.5, 33.0), (1.5, 1.0, 0.0)])
@pytest.mark.parametrize("back", [0.3, 5.0, 1e6])
def test_a_wall_clock_that_is_set_back_moves_nothing(begun, ends_at, damping, back):
    """The load stays carried, a motion stops where it is, and one that is over does not begin."""
    motion = Column("j", (Knot(0, 0.0, 0.0), Knot(SECOND, 1.0, 0.0)))
    loop, start_ns, load = loop_on(motion, takeover_time=0.1), 10**16, 5.0
    position, speed, efforts = 0.0, 0.0, []
    for k in range(3000):
        time_ns = start_ns + k * MS - int(back * SECOND) * (k * 1e-3 > begun)
        efforts.append(loop.step(time_ns, position, speed))
        speed += (efforts[-1] - load) * 1e-3
        position += speed * 1e-3
    assert (loop.counts.resets, loop.counts.takeovers) == (1, 1)
    assert loop.following.reference == (pytest.approx(ends_at, abs=2e-3), 0.0)
    assert position == pytest.approx(ends_at, abs=0.05)
    assert largest_change(*efforts) < 0.5 + damping


@pytest.mark.parametrize("source", ["measured", *WITHOUT_VELOCITIES])
def test_velocities_that_nobody_uses_may_be_nan(source):
    """As those of a joint_state_broadcaster are that has none."""
    loop, twin = (loop_on(velocity_source=source, inertia=1.0) for _ in range(2))
    for k in range(200):
        efforts = loop.step(k * MS, 1e-3 * k, math.nan), twin.step(k * MS, 1e-3 * k, None)
        assert efforts[0] == efforts[1] or source == "measured"
    assert loop.counts.rejected == 200 * (source == "measured")
    if source != "measured":
        stops = [
            [stop.step((200 + k) * MS, 0.2 + 1e-3 * k, velocity) for k in range(100)]
            for stop, velocity in (
                (loop.damping_stop(0.2), math.nan),
                (twin.damping_stop(0.2), None),
            )
        ]
        assert stops[0] == stops[1]
        assert max(stops[0]) < -5.0


@pytest.mark.parametrize("absurd", [1e300, -1e18, math.inf, math.nan])
def test_absurd_numbers_leave_nothing_behind_in_the_velocity(absurd):
    loop = loop_on(velocity_source="filtered")
    run(loop, 0, 20, 0.2)
    loop.step(20 * MS, absurd)
    loop.step(21 * MS, 0.2, absurd)
    run(loop, 22, 60, 0.2)
    assert loop.estimation.velocity == 0.0
    assert loop.state.mode is LoopMode.HOLDING


def test_a_late_joiner_starts_where_the_joint_is_and_ends_on_the_motion_and_holds_its_end():
    loop = loop_on(RAMP)
    assert loop.step(3 * SECOND, 0.2, 0.0) == pytest.approx(0.0, abs=1e-9)
    run(loop, 3001, 7000, 0.2)
    assert loop.following.reference == (2.0, 0.0)
    assert loop.state.mode is LoopMode.FOLLOWING


def test_the_same_motion_sent_again_while_it_is_under_way_changes_no_bit():
    knots = (Knot(0, 0.3, 0.0, 0.0), Knot(SECOND, 1.0, 0.0, 0.0))
    again = tuple(knot._replace(time_ns=knot.time_ns - 1) for knot in knots)
    loop, twin = (loop_on(Column("j", knots)) for _ in range(2))
    for k in range(1200):
        if k == 20:
            loop.follow(Column("j", again, stamp_ns=1))
        assert loop.step(k * MS, 0.1, 0.0) == twin.step(k * MS, 0.1, 0.0)
    assert loop.following.reference == twin.following.reference


def derivatives_agree(sample, at_ns, scale):
    """Whether velocity and acceleration are the derivatives of what they are said to be of."""
    h = 1000
    before, here, after = (sample(at_ns + k * h) for k in (-1, 0, 1))
    for lower in (0, 1):
        slope = (after[lower] - before[lower]) / (2 * h * 1e-9)
        assert slope == pytest.approx(here[lower + 1], abs=2e-3 * scale)


@given(st.floats(-2.0, 2.0), st.floats(0.01, 2.0), st.floats(0.0, 1.0))
def test_a_glide_starts_at_rest_stays_between_and_its_velocity_is_its_derivative(
    position, duration, share
):
    onto = RAMP.start(SECOND, 0.0)
    end_ns = 2 * SECOND + round(duration * SECOND)
    glide = Glide(position, 2 * SECOND, end_ns, duration)

    def sample(stamp_ns):
        return glide.sample(stamp_ns, onto.sample(stamp_ns))

    assert sample(2 * SECOND)[:2] == pytest.approx((position, 0.0), abs=1e-9)
    assert sample(end_ns) == onto.sample(end_ns)
    at = 2 * SECOND + int(share * 0.98 * duration * SECOND) + 1000
    derivatives_agree(sample, at, 1.0 + 60.0 / duration**2)
    low, high = sorted((position, onto.sample(at)[0]))
    assert low - 1e-12 <= sample(at)[0] <= high + 1e-12


@given(*[st.floats(-2.0, 2.0)] * 3, st.floats(0.01, 2.0), st.floats(0.01, 0.97))
def test_an_offset_begun_again_at_any_instant_is_the_same_curve(a, b, c, duration, share):
    end_ns = SECOND + round(duration * SECOND)
    offset = Offset(a, b, c, SECOND, end_ns)
    assert offset.sample(SECOND) == pytest.approx((a, b, c), abs=1e-9)
    assert offset.sample(end_ns) == (0.0, 0.0, 0.0)
    at = SECOND + int(share * duration * SECOND)
    again = Offset(*offset.sample(at), at, end_ns)
    later = (at + end_ns) // 2
    assert again.sample(later)[:2] == pytest.approx(offset.sample(later)[:2], abs=1e-6)
    derivatives_agree(offset.sample, at, 1.0 + 60.0 / duration**2 * (1.0 + duration**2))


def test_a_damping_stop_only_takes_energy_out_and_ends_with_nothing():
    loop = loop_on(u_clamp_max=30.0, u_clamp_min=-30.0)
    run(loop, 0, 10, 0.0)
    stop = loop.damping_stop(0.2)
    for k in range(10, 260):
        velocity = math.cos(0.05 * k)
        effort = stop.step(k * MS, 0.0, velocity)
        assert effort * velocity <= 0.0
        assert abs(effort) <= 20.0 * abs(velocity) * max(0.0, 1.0 - (k - 10) / 200.0) + 1e-9
    assert effort == 0.0
    assert loop.damping_stop(0.2).step(10**12, math.nan, 0.0) == 0.0


def test_a_damping_stop_lasts_as_long_however_old_the_last_usable_state_is():
    loop = loop_on()
    run(loop, 0, 50, 0.0, 1.0)
    for k in range(50, 90):
        loop.step(k * MS, math.nan, 1.0)
    stop = loop.damping_stop(0.02)
    efforts = [stop.step(k * MS, 1e-3 * k, 1.0) for k in range(90, 112)]
    assert efforts[0] == pytest.approx(-20.0)
    assert efforts[19] < 0.0
    assert efforts[20:] == [0.0, 0.0]
    assert stop.step(111 * MS, 0.111, 1.0) == 0.0


def test_a_repeat_gets_from_a_damping_stop_what_the_state_got():
    loop = loop_on()
    run(loop, 0, 50, 0.0, 1.0)
    stop = loop.damping_stop(0.1)
    assert stop.step(49 * MS, 0.049, 1.0) == 0.0  # the law's effort does not go on
    effort = stop.step(50 * MS, 0.05, 1.0)
    assert effort < -10.0
    assert stop.step(50 * MS, 0.05, 1.0) == effort


@pytest.mark.parametrize("effort", [math.nan, math.inf, -math.inf])
def test_another_effort_that_is_no_number_is_taken_for_the_fallback(effort):
    loop = loop_on(Setpoint(0.0), fallback_effort=1.5)
    run(loop, 0, 10, 0.0)
    loop.supersede(effort)
    assert loop.law.effort == 1.5
    assert loop.step(10 * MS, 0.0, 0.0) == pytest.approx(1.5)


@pytest.mark.parametrize("discretization", ["explicit", "semi_implicit"])
def test_without_a_floor_a_joint_at_rest_on_its_target_is_no_fault(discretization):
    """The filtered velocity falls beneath all numbers, and lam^3 rises above them."""
    values = {"law": "hpid", "mu": -0.45, "velocity_source": "filtered", "norm__floor": 0.0}
    loop = loop_on(Setpoint(0.0), **values, inertia=0.5, discretization=discretization)
    run(loop, 0, 5, 0.0)
    run(loop, 5, 100, -0.01)
    held = run(loop, 100, 2000, 0.0)
    assert run(loop, 2000, 9000, 0.0) == pytest.approx(held, rel=0.1)
    assert loop.counts.rejected == 0


@pytest.mark.parametrize("discretization", ["explicit", "semi_implicit"])
def test_a_lost_state_of_a_joint_that_stands_moves_no_effort(discretization):
    values = {"gains": Gains(300.0, 0.0, 30.0), "law": "pid", "control_period": 0.01}
    loop = loop_on(Setpoint(0.1), **values, inertia=1.0, discretization=discretization)
    stamps = [0, *range(600, 700, 10), 720, 730, 790, 800]
    efforts = [loop.step(stamp * MS, 0.0, 0.0) for stamp in [*range(0, 600, 10), *stamps[1:]]]
    assert np.ptp(efforts[60:]) < 1e-9


@pytest.mark.parametrize(("least", "most", "error"), [(2.0, 10.0, 0.5), (-10.0, -2.0, -0.5)])
def test_an_error_that_leads_out_of_a_limit_is_integrated(least, most, error):
    values = {"gains": Gains(1.0, 10.0, 0.1), "u_clamp_min": least, "u_clamp_max": most}
    loop = loop_on(Setpoint(error), **values, takeover_time=0.0)
    assert abs(run(loop, 0, 1000, 0.0)) > 4.0


def test_a_lower_limit_of_the_integral_is_reached_without_a_jump():
    loop = loop_on(Setpoint(0.1), gains=Gains(40.0, 130.0, 4.0), takeover_time=0.2)
    before = run(loop, 0, 1000, 0.0)
    assert loop.law.integral > 6.0
    loop.retune(loop.settings.with_parameters({"i_clamp_max": 1.0}))
    efforts = [loop.step(k * MS, 0.0, 0.0) for k in range(1000, 1400)]
    assert largest_change(before, *efforts) < 0.1
    assert efforts[-1] == pytest.approx(5.0)


def test_another_effort_after_a_fault_stays_where_parameters_are_set():
    loop = loop_on(Setpoint(0.0))
    run(loop, 0, 10, 0.0)
    loop.step(10 * MS, math.nan)
    loop.supersede(3.0)
    loop.retune(loop.settings.with_parameters({"gains.p": 100.0}))
    assert loop.law.effort == 3.0


def test_a_jump_that_is_confirmed_after_a_retune_keeps_no_damping_in_its_integral():
    loop, twin = (loop_on(velocity_max=5.0) for _ in range(2))
    for each in (loop, twin):
        run(each, 0, 50, 0.0, 2.0)
        each.step(50 * MS, 9.0, 2.0)
    loop.retune(twin.settings)
    assert loop.step(51 * MS, 9.0, 2.0) == twin.step(51 * MS, 9.0, 2.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e12])
def test_a_setpoint_that_is_no_position_is_refused(bad):
    with pytest.raises(SettingError, match="a setpoint must be finite"):
        Setpoint(bad)


MOVING = {
    **{"law": "hpid", "mu": -0.1, "gains.p": 100.0, "gains.i": 50.0, "gains.d": 20.0},
    **{"u_clamp_max": 60.0, "u_clamp_min": -60.0, "inertia": 1.0},
}
NAMES = [name for name in LOOP_PARAMETERS if name != "joint"]
OTHERS = {**OTHER_VALUES, **IN_EFFORT, **STOPS, **TURNS}


@pytest.mark.parametrize("source", ["measured", *WITHOUT_VELOCITIES])
@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_is_retuned_in_motion_without_a_kick(name, source):
    """At 2 rad/s the effort moves by no more than the laws differ at the same error."""
    values = {"joint": "j", **MOVING, "velocity_source": source}
    if source == "observer" and name == "observer.feed_disturbance":
        pytest.skip("adds a term: test_velocity.py")
    if name == "acceleration_bound":
        values["velocity_source"] = "homogeneous_differentiator"
    start, end = Knot(0, 0.0, 2.0), Knot(4 * SECOND, 8.0, 2.0)
    loop, twin = loops = [JointLoop(LoopSettings.from_parameters(values)) for _ in range(2)]
    for each in loops:
        each.follow(Column("j", (start, end), stamp_ns=1))
    has_velocity = values["velocity_source"] == "measured"
    retuned = 600  # when the glide at the start is over
    for k in range(680):
        position = 2e-3 * k + 0.02 * math.sin(0.02 * k)
        if k == retuned:
            changed = LoopSettings.from_parameters({**values, name: OTHERS[name]})
            law, clamp = make_law(changed), changed.integral
            law.restore_integral(min(max(loop.law.integral, clamp.i_clamp_min), clamp.i_clamp_max))
            loop.retune(changed)
        speed = 2.0 + 0.4 * math.cos(0.02 * k) if has_velocity else None
        efforts = [each.step(k * MS, position, speed) for each in loops]
        if k < retuned:
            assert efforts[0] == efforts[1]
            continue
        own = law.update(loop.error, loop.following.velocity - loop.estimation.velocity, 1e-3)
        difference = abs(changed.effort.within(own) - efforts[1])
        assert abs(efforts[0] - efforts[1]) <= difference + 1e-9 + 0.02 * (k > retuned), k
        # ... and estimates of the velocity differ by no more than their filters do.
        assert abs(loop.estimation.velocity - twin.estimation.velocity) < 0.2
        if k == retuned:
            assert abs(loop.estimation.velocity - twin.estimation.velocity) * changed.gains.d < 1.0


def random_values(draw):
    """Return some parameters of a loop, of which about a third makes no valid set."""
    values = {}
    for name in draw.sample(NAMES, draw.randint(1, 7)):
        spec = LOOP_PARAMETERS[name]
        if spec.choices:
            values[name] = draw.choice([*spec.choices, *spec.choices, "nonsense"])
        else:
            low, high = max(spec.minimum, -50.0), min(spec.maximum, 50.0)
            values[name] = draw.choice([draw.uniform(low, high)] * 12 + [math.nan, 1e9])
    return values


@pytest.mark.slow
def test_ten_thousand_sets_between_samples_are_active_whole_or_not_at_all(faults):
    draw = random.Random(1)
    present = {"joint": "j", "law": "pid", "gains.p": 10.0, "gains.i": 4.0, "gains.d": 2.0}
    loop = JointLoop(LoopSettings.from_parameters(present))
    loop.follow(Setpoint(0.4))
    counts = {"valid": 0, "refused": 0}
    for k in range(10_000):
        position, velocity = 0.3 * math.sin(0.01 * k), 3.0 * math.cos(0.01 * k)
        try:
            settings_now = LoopSettings.from_parameters({**present, **random_values(draw)})
        except HpidError:
            counts["refused"] += 1
            settings_now = loop.settings
        else:
            counts["valid"] += 1
            loop.retune(settings_now)
        integral, before = loop.law.integral, loop.law.effort
        effort = loop.step(k * MS, position, velocity)
        assert loop.settings is settings_now
        low, high = settings_now.effort.u_clamp_min, settings_now.effort.u_clamp_max
        assert low <= effort <= high
        assert loop.law.terms.i == integral  # the law's own change and nothing else: p and d terms
        law = make_law(settings_now)
        law.restore_integral(integral)
        own = law.update(loop.error, loop.following.velocity - loop.estimation.velocity, 0.001)
        own += loop.feedforward.effort  # what i_clamp took from the integral fades
        if make_motion_limits(settings_now) is None:
            assert effort == min(max(own, low), high)
        elif settings_now.effort.effort_rate_max > 0.0:
            allowed = settings_now.effort.effort_rate_max * 0.001 + 1e-9
            assert abs(effort - before) <= allowed or effort in (low, high)
    assert min(counts.values()) > 1000
    for verdict, count in counts.items():
        faults.count(f"parameter sets: pure loop, {verdict}", count)


T = 1e-3
GAINS = Gains(300.0, 1000.0, 30.0)  # three poles at -10 rad/s on 1 kg m^2


def limited(**changes):
    clamp = {"u_clamp_max": 100.0, "u_clamp_min": -100.0}
    return settings(**{"gains": GAINS, **clamp, **changes})


def opened(position=0.0, **changes):
    limits = make_motion_limits(limited(**changes))
    limits.open(position)
    return limits


def test_a_sample_that_is_braked_both_ways_counts_once():
    limits = opened(position_min=0.0, position_max=0.0)
    limits.limit(3.0, 0.0, 0.0, 0.0, 0.01)
    assert limits.braked == 1


def move(command, seconds, position=0.0, velocity=0.0, load=0.0, begin_ns=0):
    """Give a joint of 1 kg m^2 the efforts of a command; return positions and velocities."""
    track = []
    for k in range(round(seconds / T)):
        effort = command(begin_ns + k * MS, position, velocity)
        velocity += T * (effort + load)
        position += T * velocity
        track.append((position, velocity))
    return np.array(track)


@examples(0.4)
@given(st.floats(-1.0, 1.0), st.floats(-3.0, 3.0), st.floats(0.0, 40.0), st.sampled_from([1, -1]))
def test_a_mass_on_the_stop_never_passes_it_by_more_than_the_stated_bound(
    position, velocity, load, side
):
    """Whatever the law wants: here all the effort there is, into the stop."""
    stops = {"position_max": 1.2, "position_min": -1.2, "velocity_max": 3.0, "inertia": 1.0}
    limits = opened(position, **stops)
    k_position, k_velocity = soft_stop_gains(limited(**stops))
    assert k_velocity >= 4.0 * k_position  # just overdamped on 1 kg m^2
    assert k_position * 3.0 + load <= 100.0  # the effort limit can brake it
    efforts = [0.0]

    def pushes(stamp_ns, q, v):
        efforts.append(limits.limit(side * 1e9, q, v, efforts[-1], T))
        return efforts[-1]

    passed = max(side * move(pushes, 4.0, position, velocity, side * load)[:, 0]) - 1.2
    # ... and the whole way up to the margin can be used
    assert -0.06 < passed <= load / (k_position * k_velocity) + 2.0 * T * 3.0


@pytest.mark.parametrize("law", ["pid", "hpid"])
def test_a_loop_sent_beyond_the_stop_holds_a_load_on_it(law):
    loop = JointLoop(limited(law=law, mu=-0.1, position_max=0.5))
    loop.follow(Column("j", (Knot(0, 0.0, 0.0), Knot(SECOND, 3.0, 0.0))))
    track = move(loop.step, 8.0, load=20.0)
    assert max(track[:, 0]) < 0.5 + 20.0 / (7.5 * 30.0) + 0.01
    assert loop.following.reference == (0.5, 0.0)
    assert track[-1, 0] == pytest.approx(0.5, abs=5e-3)
    assert abs(loop.law.integral) < 40.0  # it did not wind up against the stop


@given(
    st.floats(-0.999, 0.999), st.floats(-5.0, 5.0), st.floats(-90.0, 90.0), st.floats(-1e3, 1e3)
)
def test_effort_away_from_a_stop_is_never_reduced(position, velocity, wanted, before):
    limits = opened(position, position_max=1.0, position_min=-1.0)
    effort = limits.limit(wanted, position, velocity, before, T)
    if wanted <= 0.0 and position > -0.94 and velocity > -1.0 * 7.5 * (position + 0.94):
        assert effort <= wanted
    if wanted >= 0.0 and position < 0.94 and velocity < 7.5 * (0.94 - position):
        assert effort >= wanted


def test_far_from_stops_and_limits_nothing_is_changed_to_the_bit():
    tracks = []
    for far in ({}, {"position_max": 50.0, "position_min": -50.0, "velocity_max": 90.0}):
        loop = JointLoop(limited(**far))
        loop.follow(Setpoint(0.7))
        tracks.append(move(loop.step, 2.0))
    assert np.array_equal(*tracks)


def test_a_joint_that_begins_beyond_a_stop_is_held_and_let_in_but_not_further_out():
    loop = JointLoop(limited(position_max=1.0))
    assert np.allclose(move(loop.step, 1.0, position=1.5)[:, 0], 1.5)  # not pushed back
    assert loop.law.effort == 0.0
    loop = JointLoop(limited(position_max=1.0))
    loop.step(0, 1.5, 0.0)
    loop.follow(Setpoint(2.5))
    assert loop.step(MS, 1.5, 0.0) <= 0.0
    loop.follow(Setpoint(0.8))
    track = move(loop.step, 4.0, position=1.5, begin_ns=2 * MS)
    assert track[-1, 0] == pytest.approx(0.8, abs=0.02)
    loop.follow(Setpoint(2.5))
    again = move(loop.step, 4.0, position=0.8, begin_ns=5000 * MS)
    assert max(again[:, 0]) < 1.01  # the stop is back where it belongs


def test_a_retune_moves_no_stop_onto_the_joint():
    loop = JointLoop(limited(position_max=2.0))
    run(loop, 0, 10, 1.5)
    loop.retune(limited(position_max=1.0))
    assert loop.step(10 * MS, 1.5, 0.0) == 0.0


@examples(0.25)
@given(st.floats(0.0, 90.0), st.floats(0.5, 5.0))
def test_the_velocity_limit_is_passed_by_no_more_than_the_load_needs(load, fastest):
    limits = make_motion_limits(limited(velocity_max=fastest))
    track = move(lambda k, q, v: limits.limit(1e9, q, v, 0.0, T), 3.0, load=load)
    assert max(track[:, 1]) <= fastest + load / GAINS.d + T * (100.0 + load)
    assert track[-1, 1] > 0.9 * fastest


@given(st.lists(st.tuples(st.integers(1, 60), st.floats(-3.0, 3.0)), max_size=60))
def test_the_effort_changes_no_faster_than_its_rate(steps):
    loop = JointLoop(limited(effort_rate_max=500.0, gains=Gains(300.0, 10.0, 0.0)))
    stamp_ns, before = 0, loop.step(0, 0.0, 0.0)
    assert before == 0.0
    for periods, position in steps:
        stamp_ns += periods * MS
        effort = loop.step(stamp_ns, position, 0.0)
        if loop.state.mode is LoopMode.CONFLICT:  # positions to and fro: the fallback, at once
            assert effort == 0.0
        else:
            assert abs(effort - before) <= 500.0 * periods * T * (1.0 + 1e-9)
        before = effort


@given(st.floats(-3.0, 3.0), st.floats(-100.0, 100.0), st.floats(-1e9, 1e9), st.floats(-200, 200))
def test_the_effort_limits_hold_whatever_braking_or_rate_ask_for(q, v, wanted, before):
    limits = opened(position_max=1.0, velocity_max=2.0, effort_rate_max=10.0)
    assert -100.0 <= limits.limit(wanted, q, v, before, T) <= 100.0


EVERY_LIMIT = {
    **{"i_clamp_max": 5.0, "position_max": 1.0, "position_min": -1.0, "velocity_max": 2.0},
    **{"effort_rate_max": 1e4, "fallback_effort": 99.0},
}


@given(
    st.lists(
        st.tuples(st.integers(-(10**10), 10**19), st.floats(), st.none() | st.floats()),
        max_size=40,
    ),
    st.sampled_from(["none", "conditional_integration", "back_calculation"]),
    st.sampled_from([("pid", 0.0), ("hpid", 0.45), ("hpid", -0.45)]),
    st.sampled_from([{}, EVERY_LIMIT]),
)
def test_no_sequence_of_states_yields_an_effort_outside_the_limits(states, strategy, law, limits):
    values = {"u_clamp_max": 7.0, "u_clamp_min": -3.0, "antiwindup_strategy": strategy, **limits}
    loop = JointLoop(limited(law=law[0], mu=law[1], **values))
    loop.follow(Setpoint(0.5))
    for state in states:
        assert -3.0 <= loop.step(*state) <= 7.0
        assert math.isfinite(loop.law.integral)
        assert loop.law.integral <= values.get("i_clamp_max", math.inf)


@pytest.mark.parametrize("strategy", ["conditional_integration", "back_calculation"])
@pytest.mark.parametrize(
    "limit", [{"position_max": 0.2}, {"velocity_max": 0.05}, {"effort_rate_max": 5.0}]
)
def test_anti_windup_holds_against_every_limit(strategy, limit):
    bounded, runaway = (
        JointLoop(limited(antiwindup_strategy=each, **limit)) for each in (strategy, "none")
    )
    for loop in (bounded, runaway):
        loop.follow(Setpoint(5.0))
        for k in range(1000):  # a joint that is held by the hand
            loop.step(k * MS, 0.19, 0.049)
    assert abs(bounded.law.integral) < 0.6 * abs(runaway.law.integral)


def test_a_joint_is_taken_over_only_where_it_stays_after_a_jump():
    loop = loop_on(Setpoint(0.5), velocity_max=5.0)
    run(loop, 0, 200, 0.2)
    for k, position in enumerate((1.2, 2.4, 3.6)):
        loop.step((200 + k) * MS, position, 0.0)
    assert (loop.counts.jumps, loop.counts.takeovers) == (3, 0)


@pytest.mark.parametrize("limits", [{"velocity_max": 1.0}, {"velocity_max": 1.0, **STOPS}])
def test_what_a_limit_took_is_not_in_the_integral_after_a_takeover(limits):
    """An encoder is set anew while a joint far from its setpoint moves as fast as it may."""
    loop = loop_on(None, u_clamp_max=400.0, u_clamp_min=-400.0, **limits)
    loop.step(SECOND, 0.0, 0.0)
    loop.follow(Setpoint(1.4))
    position = velocity = off = 0.0
    for k in range(1, 4000):
        if k == 600:
            off, before = 0.3, loop.law.effort
            assert velocity == pytest.approx(1.0, abs=0.05)
        effort = loop.step(SECOND + k * MS, position + off, velocity)
        if k == 601:
            assert loop.counts.takeovers == 1
            assert abs(loop.law.integral) < abs(before) + abs(loop.law.terms.d) + 1.0
        velocity += 1e-3 * effort / 1.0
        position += 1e-3 * velocity
    assert position + off == pytest.approx(1.4, abs=0.05)


@pytest.mark.parametrize("inertia", [0.0, 1.0])
def test_the_acceleration_of_a_takeover_is_in_no_integral(inertia):
    """After 0.15 s without states, in which a trajectory came that accelerates at once."""
    loop = loop_on(
        None,
        **{"feedforward__inertia": inertia, "gains__i": 20.0},
        u_clamp_max=200.0,
        u_clamp_min=-200.0,
    )
    position = velocity = largest = 0.0
    for k in range(3000):
        if k == 200:
            points = Knot(SECOND // 2, 0.6, 0.0), Knot(SECOND, 0.6, 0.0)
            loop.receive(Column("j", points, 0))
        if 200 <= k < 350:
            continue
        effort = loop.step(SECOND + k * MS, position, velocity)
        largest = max(largest, abs(loop.error))
        velocity += 1e-3 * effort
        position += 1e-3 * velocity
    assert loop.counts.takeovers == 1
    assert largest < (0.002 if inertia else 0.06)

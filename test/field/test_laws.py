"""What people reported of PIDs, tried on the pure loop: kicks, windup, clamps, times, NaN."""

import itertools
import math

import numpy as np
import pytest
from harness.loops import Joint, drive, loops_with

from hpid_ros.control import Gains
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot

MS = 1_000_000
KP, KI, KD = 10.0, 4.0, 2.0
MEASURED = {"velocity_source": "measured"}
LAWS = [{"law": "pid"}, {"law": "hpid", "mu": -0.2}, {"law": "hpid", "mu": 0.2}]
SOURCES = ["measured", "filtered", "homogeneous_differentiator"]
STRATEGIES = ["none", "conditional_integration", "back_calculation"]

settings, loop_on = loops_with(joint="elbow", law="pid", gains=Gains(KP, KI, KD))


def held(loop, samples, position=0.0, velocity=0.0, start=0):
    """Return the efforts of a joint that stands, or says that it moves."""
    return [loop.step(k * MS, position, velocity) for k in range(start, start + samples)]


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("law", LAWS)
def test_a_setpoint_kicks_by_the_proportional_term_alone(law, source):
    loop = loop_on(Setpoint(0.0), velocity_source=source, **law)
    held(loop, 50)
    loop.follow(Setpoint(1.0))  # at norm 1 all these laws have the same gains
    efforts = held(loop, 5, start=50)
    assert efforts[0] == pytest.approx(KP)
    assert np.diff(efforts) == pytest.approx(np.full(4, KI * 1e-3), abs=1e-6)


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("place", [0.7, 3.1, -200.0])
def test_a_joint_that_begins_elsewhere_than_at_zero_begins_without_a_kick(place, source):
    loop = loop_on(velocity_source=source)
    assert held(loop, 20, place) == [0.0] * 20


def test_an_angle_that_jumps_at_half_a_turn_is_no_velocity():
    loop = loop_on(encoder_wrap=math.tau, velocity_source="filtered")
    places = [math.remainder(math.pi - 0.02 + 1e-3 * k, math.tau) for k in range(40)]
    efforts = [loop.step(k * MS, place) for k, place in enumerate(places)]
    assert min(places) < -3.0  # it did jump
    assert np.abs(np.diff(efforts)).max() < 0.5
    assert loop.counts.jumps == loop.counts.takeovers == 0


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_integral_stays_within_clamps_that_differ_and_leaves_them_at_once(strategy, side):
    clamps = {"i_clamp_max": 0.5, "i_clamp_min": -0.2}
    loop = loop_on(Setpoint(side), antiwindup_strategy=strategy, **clamps)
    held(loop, 3000)
    reached = 0.5 if side > 0.0 else -0.2
    assert loop.law.integral == pytest.approx(reached)
    loop.follow(Setpoint(-side))
    held(loop, 1, start=3000)
    assert loop.law.integral == pytest.approx(reached - side * KI * 1e-3)


def test_integral_clamps_that_nobody_gave_do_not_switch_the_integral_off():
    loop = loop_on(Setpoint(0.5), antiwindup_strategy="none")
    held(loop, 1001)
    assert loop.law.integral == pytest.approx(KI * 0.5 * 1.0)


@pytest.mark.parametrize("clamps", [(-2.0, -1.0), (1.0, 2.0), (0.0, 0.0)])
def test_without_an_integral_gain_its_clamps_are_neither_an_effort_nor_nan(clamps):
    low, high = clamps
    loop = loop_on(Setpoint(0.5), gains=Gains(KP, 0.0, KD), i_clamp_min=low, i_clamp_max=high)
    assert held(loop, 100) == pytest.approx(np.full(100, 0.5 * KP))


@pytest.mark.parametrize("strategy", STRATEGIES[1:])
def test_what_a_large_error_saturates_winds_nothing_up(strategy):
    limits = {"u_clamp_max": 5.0, "u_clamp_min": -5.0}
    loop = loop_on(Setpoint(3.0), antiwindup_strategy=strategy, **limits)
    assert held(loop, 20_000)[-1] == 5.0
    assert loop.law.integral <= 0.0
    loop.follow(Setpoint(-3.0))
    assert held(loop, 1, start=20_000) == [-5.0]


def test_a_saturated_motion_overshoots_no_more_than_one_whose_integral_has_settled():
    overshoot = {}
    for strategy in STRATEGIES:
        loop = loop_on(
            Setpoint(2.0), gains=Gains(75.0, 125.0, 15.0), antiwindup_strategy=strategy,
            u_clamp_max=4.0, u_clamp_min=-4.0, **MEASURED,
        )  # fmt: skip
        joint, highest = Joint(1.0), 0.0
        for _ in range(6000):
            drive(loop, joint, 1)
            highest = max(highest, joint.position - 2.0)
        overshoot[strategy] = highest
    assert overshoot["conditional_integration"] < 0.6 * overshoot["none"]
    assert overshoot["back_calculation"] < 0.6 * overshoot["none"]


def test_another_integral_gain_moves_no_effort():
    loop = loop_on(Setpoint(1.0))
    before, gain = held(loop, 500, 0.5)[-1], KI
    for count, another in enumerate((40.0, 0.4, 4000.0)):
        loop.retune(loop.settings.with_parameters({"gains.i": another}))
        (after,) = held(loop, 1, 0.5, start=500 + count)
        assert after - before == pytest.approx(gain * 0.5 * 1e-3)  # of the time before
        before, gain = after, another


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("bad", [(math.nan, 0.0), (0.5, math.nan), (math.inf, -math.inf)])
def test_a_nan_is_answered_and_not_remembered(law, bad):
    loop, twin = (loop_on(Setpoint(1.0), **MEASURED, **law) for _ in range(2))
    assert held(loop, 100, 0.5) == held(twin, 100, 0.5)
    assert loop.step(100 * MS, *bad) == 0.0  # fallback_effort
    assert loop.law.integral == twin.law.integral
    after, meant = held(loop, 50, 0.5, start=101), held(twin, 51, 0.5, start=100)
    assert after == pytest.approx(meant[:-1], abs=1e-9)  # as if that time had not been


@pytest.mark.parametrize("law", LAWS)
def test_no_time_at_all_gets_the_same_effort_again(law):
    loop = loop_on(Setpoint(1.0), **law)
    effort = held(loop, 100, 0.5)[-1]
    integral = loop.law.integral
    assert [loop.step(99 * MS, place, 9.0) for place in (0.5, 0.4, 0.6)] == [effort] * 3
    assert loop.law.integral == integral


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("dt_ns", [1, 10, 1000])
def test_the_shortest_time_between_states_is_no_endless_velocity(source, dt_ns):
    loop = loop_on(Setpoint(0.0), velocity_source=source)
    held(loop, 100)
    resolution = 1e-4
    effort = loop.step(99 * MS + dt_ns, resolution, 0.0)
    slow = KD * resolution / loop.settings.velocity.velocity_filter_time_constant
    assert abs(effort) <= KP * resolution + slow + 0.1


@pytest.mark.parametrize("back_ns", [1, MS, 10**12])
def test_a_time_that_goes_back_moves_no_effort(back_ns):
    loop = loop_on(Setpoint(1.0))
    effort = held(loop, 100, 0.5)[-1]
    assert loop.step(99 * MS - back_ns, 0.5, 0.0) == effort
    (after,) = held(loop, 1, 0.5, start=100)
    assert after - effort == pytest.approx(KI * 0.5 * 1e-3, abs=1e-9)


@pytest.mark.parametrize("pause", [1, 60, 3600])
def test_a_long_pause_is_not_integrated_as_one_step(pause):
    """The loop takes over with the second state; the error of the pause is not its own."""
    loop = loop_on(Setpoint(0.01))
    before = held(loop, 100)[-1]
    assert loop.state.mode.value == "following a reference"
    efforts = held(loop, 20, 0.0, start=100 + 1000 * pause)
    assert efforts[0] == before
    assert max(abs(each - before) for each in efforts) < 2e-3
    assert loop.counts.gaps == 1


def test_a_torque_controller_that_refuses_jumps_gets_none():
    """1000 N m/s is what a Franka Panda takes."""
    loop = loop_on(Setpoint(0.0), effort_rate_max=1000.0, gains=Gains(600.0, 0.0, 50.0))
    efforts = held(loop, 20)
    for target, place in itertools.product((0.1, -0.1, 0.05), (0.0, 0.02)):
        loop.follow(Setpoint(target))
        efforts += held(loop, 30, place, start=len(efforts))
    assert np.abs(np.diff(efforts)).max() <= 1.0 + 1e-9
    assert np.abs(np.diff(efforts)).max() > 0.9
    assert efforts[-1] == pytest.approx(600.0 * 0.03)


def test_a_driver_whose_velocity_is_its_limit_does_no_harm_where_velocities_are_computed():
    """As one that writes the configured speed into the states while it stands."""
    computed, believing = (
        loop_on(Setpoint(0.0), velocity_source=source) for source in ("filtered", "measured")
    )
    assert held(computed, 100, 0.0, 1.5) == [0.0] * 100
    assert held(believing, 100, 0.0, 1.5)[-1] == pytest.approx(-KD * 1.5)


def test_a_simulation_that_begins_again_begins_with_nothing_in_the_integral():
    """Wound up before, at its target afterwards: nothing moves."""
    loop = loop_on(Setpoint(0.0), gains=Gains(0.0, 10.0, 0.0), state_clock="simulated")
    assert abs(held(loop, 3000, 1.5)[-1]) > 40.0
    assert held(loop, 500, 0.0, start=1) == [0.0] * 500
    assert loop.counts.resets == 1


def test_states_of_a_robot_that_is_switched_off_wind_up_what_its_clamps_allow():
    """Frozen positions with new stamps look like a load; no controller can tell them from one."""
    loop = loop_on(Setpoint(0.3), i_clamp_max=2.0, i_clamp_min=-2.0)
    held(loop, 5000)
    assert loop.law.integral == 2.0
    loop.release()  # a deactivation
    assert held(loop, 100, 0.1, start=6000) == [0.0] * 100


def test_positions_that_are_published_faster_than_they_are_read_shake_computed_velocities():
    """Each position comes twice, with new stamps; what the driver measures is smooth."""
    ripple = {}
    for source in ("measured", "filtered"):
        loop = loop_on(velocity_source=source, control_period=0.01)
        loop.follow(Column("elbow", (Knot(0, 0.0, 1.0), Knot(10_000 * MS, 10.0, 1.0))))
        efforts = [loop.step(10 * k * MS, 0.02 * (k // 2), 1.0) for k in range(300)]
        ripple[source] = np.abs(np.diff(efforts[100:])).max()
    assert ripple["measured"] < 0.03 * KP
    assert 10.0 * ripple["measured"] < ripple["filtered"] <= 2.0 * KD * 1.0 + 0.03 * KP

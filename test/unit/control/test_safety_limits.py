"""The last word on an effort: clamps, rate, soft stops, velocity limits, anti-windup with all."""

import math

import numpy as np
import pytest
from harness.examples import examples
from harness.loops import loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control import Gains, JointLoop
from hpid_ros.control.assembly import make_motion_limits, soft_stop_gains
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot

MS = 1_000_000
T = 1e-3
GAINS = Gains(300.0, 1000.0, 30.0)  # three poles at -10 rad/s on 1 kg m^2


def settings(**changes):
    values = {"joint": "j", "gains": GAINS, "law": "pid", "u_clamp_max": 100.0}
    return loop_settings(**{"u_clamp_min": -100.0, **values, **changes})


def move(command, seconds, position=0.0, velocity=0.0, load=0.0, inertia=1.0):
    """Give a joint of one inertia the efforts of a command; return positions and velocities."""
    track = []
    for k in range(round(seconds / T)):
        effort = command(k * MS, position, velocity)
        velocity += T * (effort + load) / inertia
        position += T * velocity
        track.append((position, velocity))
    return np.array(track)


@examples(0.4)
@given(
    st.floats(-1.0, 1.0),
    st.floats(-3.0, 3.0),
    st.floats(0.0, 40.0),
    st.sampled_from([1.0, -1.0]),
)
def test_a_mass_on_the_stop_never_passes_it_by_more_than_the_stated_bound(
    position, velocity, load, side
):
    """Whatever the law wants: here all the effort there is, into the stop."""
    given_settings = settings(position_max=1.2, position_min=-1.2, velocity_max=3.0, inertia=1.0)
    limits = make_motion_limits(given_settings)
    limits.open(position)
    k_position, k_velocity = soft_stop_gains(given_settings)
    assert k_velocity >= 4.0 * k_position  # just overdamped on 1 kg m^2
    assert k_position * 3.0 + load <= 100.0  # the effort limit can brake it
    efforts = [0.0]

    def pushes(stamp_ns, q, v):
        efforts.append(limits.limit(side * 1e9, q, v, efforts[-1], T))
        return efforts[-1]

    track = move(pushes, 4.0, position, velocity, side * load)
    passed = max(side * track[:, 0]) - 1.2
    assert passed <= load / (k_position * k_velocity) + 2.0 * T * 3.0
    assert passed > -0.06  # and the whole way up to the margin can be used


@pytest.mark.parametrize("law", ["pid", "hpid"])
def test_a_loop_sent_beyond_the_stop_holds_a_load_on_it(law):
    loop = JointLoop(settings(law=law, mu=-0.1, position_max=0.5))
    loop.follow(Column("j", (Knot(0, 0.0, 0.0), Knot(1000 * MS, 3.0, 0.0))))
    track = move(loop.step, 8.0, load=20.0)
    assert max(track[:, 0]) < 0.5 + 20.0 / (7.5 * 30.0) + 0.01
    assert loop.reference == (0.5, 0.0)
    assert track[-1, 0] == pytest.approx(0.5, abs=5e-3)
    assert abs(loop.integral) < 40.0  # it did not wind up against the stop


@given(
    st.floats(-0.999, 0.999), st.floats(-5.0, 5.0), st.floats(-90.0, 90.0), st.floats(-1e3, 1e3)
)
def test_effort_away_from_a_stop_is_never_reduced(position, velocity, wanted, before):
    limits = make_motion_limits(settings(position_max=1.0, position_min=-1.0))
    limits.open(position)
    given_effort = limits.limit(wanted, position, velocity, before, T)
    if wanted <= 0.0 and position > -0.94 and velocity > -1.0 * 7.5 * (position + 0.94):
        assert given_effort <= wanted
    if wanted >= 0.0 and position < 0.94 and velocity < 7.5 * (0.94 - position):
        assert given_effort >= wanted


def test_far_from_stops_and_limits_nothing_is_changed_to_the_bit():
    free, limited = (
        JointLoop(settings(**changes))
        for changes in ({}, {"position_max": 50.0, "position_min": -50.0, "velocity_max": 90.0})
    )
    for loop in (free, limited):
        loop.follow(Setpoint(0.7))
    assert np.array_equal(move(free.step, 2.0), move(limited.step, 2.0))


def test_a_joint_that_begins_beyond_a_stop_is_held_and_let_in_but_not_further_out():
    loop = JointLoop(settings(position_max=1.0))
    track = move(loop.step, 1.0, position=1.5)
    assert np.allclose(track[:, 0], 1.5)  # not pushed back
    assert loop.effort == 0.0
    loop = JointLoop(settings(position_max=1.0))
    loop.step(0, 1.5, 0.0)
    loop.follow(Setpoint(2.5))
    assert loop.step(MS, 1.5, 0.0) <= 0.0
    loop.follow(Setpoint(0.8))
    track = move(lambda k, q, v: loop.step(k + 2 * MS, q, v), 4.0, position=1.5)
    assert track[-1, 0] == pytest.approx(0.8, abs=0.02)
    loop.follow(Setpoint(2.5))
    again = move(lambda k, q, v: loop.step(k + 5000 * MS, q, v), 4.0, position=0.8)
    assert max(again[:, 0]) < 1.01  # the stop is back where it belongs


@examples(0.25)
@given(st.floats(0.0, 90.0), st.floats(0.5, 5.0))
def test_the_velocity_limit_is_passed_by_no_more_than_the_load_needs(load, fastest):
    limits = make_motion_limits(settings(velocity_max=fastest))
    track = move(lambda k, q, v: limits.limit(1e9, q, v, 0.0, T), 3.0, load=load)
    assert max(track[:, 1]) <= fastest + load / GAINS.d + T * (100.0 + load)
    assert track[-1, 1] > 0.9 * fastest


@given(st.lists(st.tuples(st.integers(1, 60), st.floats(-3.0, 3.0)), max_size=60))
def test_the_effort_changes_no_faster_than_its_rate(steps):
    loop = JointLoop(settings(effort_rate_max=500.0, gains=Gains(300.0, 10.0, 0.0)))
    stamp_ns, before = 0, loop.step(0, 0.0, 0.0)
    assert before == 0.0
    for periods, position in steps:
        stamp_ns += periods * MS
        effort = loop.step(stamp_ns, position, 0.0)
        assert abs(effort - before) <= 500.0 * periods * T * (1.0 + 1e-9)
        before = effort


@given(
    st.lists(
        st.tuples(st.integers(-(10**9), 10**12), st.floats(), st.none() | st.floats()), max_size=40
    ),
    st.sampled_from(["none", "conditional_integration", "back_calculation"]),
)
def test_with_everything_on_no_states_yield_an_effort_beyond_the_limits(states, strategy):
    loop = JointLoop(
        settings(
            law="hpid",
            mu=-0.3,
            antiwindup_strategy=strategy,
            u_clamp_max=7.0,
            u_clamp_min=-3.0,
            i_clamp_max=5.0,
            position_max=1.0,
            position_min=-1.0,
            velocity_max=2.0,
            effort_rate_max=1e4,
            fallback_effort=99.0,
        )
    )
    loop.follow(Setpoint(0.5))
    for state in states:
        assert -3.0 <= loop.step(*state) <= 7.0
        assert math.isfinite(loop.integral)
        assert loop.integral <= 5.0


@pytest.mark.parametrize("strategy", ["conditional_integration", "back_calculation"])
@pytest.mark.parametrize(
    "limit", [{"position_max": 0.2}, {"velocity_max": 0.05}, {"effort_rate_max": 5.0}]
)
def test_anti_windup_holds_against_every_limit(strategy, limit):
    bounded = JointLoop(settings(antiwindup_strategy=strategy, **limit))
    runaway = JointLoop(settings(antiwindup_strategy="none", **limit))
    for loop in (bounded, runaway):
        loop.follow(Setpoint(5.0))
        for k in range(1000):  # a joint that is held by the hand
            loop.step(k * MS, 0.19, 0.049)
    assert abs(bounded.integral) < 0.6 * abs(runaway.integral)


def test_stops_the_wrong_way_round_are_refused():
    with pytest.raises(SettingError, match=r"position_min = 2.0 must not exceed"):
        settings(position_min=2.0, position_max=1.0)


def test_a_retune_moves_no_stop_onto_the_joint():
    loop = JointLoop(settings(position_max=2.0))
    for k in range(10):
        loop.step(k * MS, 1.5, 0.0)
    loop.retune(settings(position_max=1.0))
    assert loop.step(10 * MS, 1.5, 0.0) == 0.0


@given(st.floats(-3.0, 3.0), st.floats(-100.0, 100.0), st.floats(-1e9, 1e9), st.floats(-200, 200))
def test_the_effort_limits_hold_whatever_braking_or_rate_ask_for(q, v, wanted, before):
    given_settings = settings(position_max=1.0, velocity_max=2.0, effort_rate_max=10.0)
    limits = make_motion_limits(given_settings)
    limits.open(0.0)
    assert -100.0 <= limits.limit(wanted, q, v, before, T) <= 100.0

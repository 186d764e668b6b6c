"""One joint's sample: time, references, limits, anti-windup, faults, retuning."""

import math

import pytest
from harness.loops import loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import GainError, HpidError, NormError, SettingError
from hpid_ros.control import LOOP_PARAMETERS, Gains, JointLoop, LoopSettings
from hpid_ros.control.joint_loop import LoopState
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot

MS = 1_000_000
SECOND = 1000 * MS


def settings(**changes):
    values = {"joint": "j", "gains": Gains(10.0, 4.0, 2.0), "law": "pid"}
    return loop_settings(**{**values, **changes})


def follow_double_integrator(loop, seconds, position=0.0, velocity=0.0, load=0.0, inertia=1.0):
    """Run the loop on a joint of constant inertia at 1 kHz; return its positions."""
    positions = []
    for k in range(round(seconds * 1000)):
        effort = loop.step(k * MS, position, velocity)
        velocity += 1e-3 * (effort + load) / inertia
        position += 1e-3 * velocity
        positions.append(position)
    return positions


@pytest.mark.parametrize("law", ["pid", "hpid"])
@pytest.mark.parametrize("mu", [-0.2, 0.2])
def test_loop_brings_a_loaded_joint_to_its_setpoint(law, mu):
    loop = JointLoop(settings(law=law, mu=mu, gains=Gains(75.0, 125.0, 15.0)))
    loop.follow(Setpoint(0.7))
    positions = follow_double_integrator(loop, 20.0, load=-3.0)
    assert positions[-1] == pytest.approx(0.7, abs=1e-3)
    assert loop.integral == pytest.approx(3.0, abs=0.1)
    assert loop.counts.samples == 20_000


def test_velocities_that_are_zero_while_the_joint_moves_are_doubted():
    """What a driver that measures none may fill in; a quantised one shows some now and then."""
    loop = JointLoop(settings(velocity_source="measured"))

    def go_on(count, position, velocity):
        for _ in range(count):
            go_on.stamp_ns += MS
            position += 1e-3
            loop.step(go_on.stamp_ns, position, velocity)
        return position

    go_on.stamp_ns = 0
    position = go_on(40, 0.0, 0.0)
    assert loop.velocity_warning == ""
    position = go_on(20, position, 0.0)
    assert "all 0, and the joint has moved by 0.05" in loop.velocity_warning
    assert "velocity_source filtered" in loop.velocity_warning
    position = go_on(1, position, 1e-6)
    assert loop.velocity_warning == ""
    loop.reset()
    for k in range(5000):  # at rest, seen by a noisy encoder
        loop.step(go_on.stamp_ns + k * MS, position + 0.01 * math.sin(k), 0.0)
    assert loop.velocity_warning == ""


@pytest.mark.parametrize(
    ("source", "velocity", "origin"),
    [
        ("measured", 1.0, "measured"),
        ("measured", None, "filtered, the states have none"),
        ("filtered", None, "filtered"),
        ("homogeneous_differentiator", 1.0, "homogeneous_differentiator"),
    ],
)
def test_a_loop_tells_where_its_velocity_comes_from(source, velocity, origin):
    loop = JointLoop(settings(velocity_source=source))
    loop.step(0, 0.0, velocity)
    assert loop.velocity_origin == origin
    assert loop.velocity_warning == ""


def test_a_velocity_that_is_no_number_is_told_with_what_does_without():
    loop = JointLoop(settings(velocity_source="measured"))
    loop.step(0, 0.0, math.nan)
    assert loop.state is LoopState.FAULT
    assert "velocity nan rad/s; velocity_source filtered does without" in loop.last_fault
    loop.step(MS, math.nan, math.nan)
    assert "velocity_source" not in loop.last_fault


def test_a_loop_without_a_reference_holds_its_first_position():
    loop = JointLoop(settings())
    assert loop.state is LoopState.WAITING
    assert loop.step(5 * MS, 1.25, 0.0) == 0.0
    assert loop.state is LoopState.HOLDING
    assert loop.step(6 * MS, 1.0, 0.0) == pytest.approx(10.0 * 0.25)
    assert loop.reference == (1.25, 0.0)


def test_a_repeated_stamp_gets_the_last_effort_and_changes_nothing():
    loop = JointLoop(settings())
    loop.step(0, 0.0, 0.0)
    effort = loop.step(MS, 0.1, 0.0)
    integral = loop.integral
    assert loop.step(MS, 99.0, 99.0) == effort
    assert (loop.integral, loop.counts.repeats, loop.counts.samples) == (integral, 1, 2)


def test_a_clock_that_goes_back_resets_loop_and_motion():
    loop = JointLoop(settings())
    loop.follow(Column("j", (Knot(0, 0.0), Knot(SECOND, 1.0))))
    first = [loop.step(k * MS, 0.05 * k, 0.0) for k in range(10, 20)]
    again = [loop.step(k * MS - 5 * MS, 0.05 * k, 0.0) for k in range(10, 20)]
    assert again == first  # integral, velocity filter and trajectory began anew
    assert loop.counts.resets == 1


def test_a_gap_restarts_the_derivative_and_leaves_the_effort_as_it_is():
    loop = JointLoop(settings(velocity_source="filtered", velocity_filter_time_constant=0.0))
    for k in range(3):
        loop.step(k * MS, 0.001 * k)
    effort, rate = loop.effort, loop.velocity
    assert rate == pytest.approx(1.0)
    assert loop.step(3 * SECOND, 0.5) == pytest.approx(effort)
    assert (loop.velocity, loop.counts.gaps, loop.counts.takeovers) == (0.0, 1, 1)
    loop.step(3 * SECOND + MS, 0.501)
    assert loop.velocity == pytest.approx(1.0)


def test_the_first_sample_integrates_nothing():
    loop = JointLoop(settings())
    loop.follow(Setpoint(1.0))
    loop.step(10**18, 0.0, 0.0)
    assert loop.integral == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["position", "velocity"])
def test_a_state_that_is_not_finite_gets_no_effort_and_leaves_no_trace(bad, where):
    loop = JointLoop(settings())
    loop.follow(Setpoint(1.0))
    loop.step(0, 0.0, 0.0)
    loop.step(MS, 0.0, 0.0)
    integral = loop.integral
    state = {"position": 0.0, "velocity": 0.0, where: bad}
    assert loop.step(2 * MS, **state) == 0.0
    assert loop.state is LoopState.FAULT
    assert (loop.integral, loop.counts.rejected) == (integral, 1)
    assert loop.step(3 * MS, 0.0, 0.0) == pytest.approx(10.0 + integral)
    assert loop.state is LoopState.FOLLOWING


@given(
    st.lists(
        st.tuples(
            st.integers(-(10**10), 10**19),
            st.floats(allow_nan=True, allow_infinity=True),
            st.none() | st.floats(allow_nan=True, allow_infinity=True),
        ),
        max_size=40,
    ),
    st.sampled_from(["none", "conditional_integration", "back_calculation"]),
    st.sampled_from([("pid", 0.0), ("hpid", 0.45), ("hpid", -0.45)]),
)
def test_no_sequence_of_states_yields_an_effort_outside_the_limits(states, strategy, law):
    loop = JointLoop(
        settings(
            law=law[0], mu=law[1], antiwindup_strategy=strategy, u_clamp_min=-3.0, u_clamp_max=2.0
        )
    )
    loop.follow(Setpoint(0.5))
    for state in states:
        assert -3.0 <= loop.step(*state) <= 2.0
        assert math.isfinite(loop.integral)


def saturated_loop(strategy, **changes):
    loop = JointLoop(settings(antiwindup_strategy=strategy, u_clamp_max=1.0, **changes))
    loop.follow(Setpoint(1.0))
    for k in range(2001):
        loop.step(k * MS, 0.0, 0.0)
    return loop


def test_without_anti_windup_the_integral_runs_away():
    assert saturated_loop("none").integral == pytest.approx(4.0 * 2.0, rel=1e-3)


def test_conditional_integration_stops_while_the_error_pushes_into_the_limit():
    assert saturated_loop("conditional_integration").integral == 0.0


def test_back_calculation_settles_where_control_toolbox_does():
    """ki e + (u - u_wanted) / trk = 0 with u_wanted = kp e + I, e = 1."""
    loop = saturated_loop("back_calculation", tracking_time_constant=0.05)
    assert loop.integral == pytest.approx(1.0 - 10.0 + 4.0 * 0.05, rel=1e-6)


def test_back_calculation_without_an_integral_gain_leaves_the_integral_alone():
    loop = saturated_loop(
        "back_calculation", tracking_time_constant=0.05, gains=Gains(10.0, 0.0, 2.0)
    )
    assert loop.integral == 0.0


def test_integral_clamp_holds_and_releases():
    loop = saturated_loop("none", i_clamp_max=0.3)
    assert loop.integral == 0.3
    loop.follow(Setpoint(-1.0))
    loop.step(2001 * MS, 0.0, 0.0)
    assert loop.integral < 0.3


def test_retuning_changes_the_effort_by_no_more_than_the_laws_differ():
    loop = JointLoop(settings())
    loop.follow(Setpoint(1.0))
    for k in range(500):
        loop.step(k * MS, 0.2, 0.1)
    twin = JointLoop(settings())
    twin.follow(Setpoint(1.0))
    for k in range(500):
        twin.step(k * MS, 0.2, 0.1)
    loop.retune(settings(gains=Gains(12.0, 400.0, 2.5)))
    change = loop.step(500 * MS, 0.2, 0.1) - twin.step(500 * MS, 0.2, 0.1)
    assert change == pytest.approx(2.0 * 0.8 - 0.5 * 0.1)  # ki does not jump


def test_retuning_to_the_homogeneous_law_keeps_the_integral():
    loop = JointLoop(settings())
    loop.follow(Setpoint(1.0))
    for k in range(500):
        loop.step(k * MS, 0.0, 0.0)
    integral = loop.integral
    loop.retune(settings(law="hpid", mu=0.3))
    effort = loop.step(500 * MS, 0.0, 0.0)
    assert effort == pytest.approx(10.0 + integral)  # |e| = e_max: the multiplier is one


def test_a_loop_cannot_be_retuned_to_another_joint():
    with pytest.raises(SettingError, match="cannot change from 'j' to 'k'"):
        JointLoop(settings()).retune(settings(joint="k"))


def test_a_new_trajectory_takes_over_where_the_reference_stands():
    loop = JointLoop(settings())
    loop.follow(Setpoint(0.4))
    loop.step(0, 0.0, 0.0)
    loop.follow(Column("j", (Knot(SECOND, 1.0, 0.0),)))
    loop.step(MS, 0.1, 0.0)
    assert loop.reference[0] == pytest.approx(0.4, abs=1e-9)


def test_measured_velocity_falls_back_on_differences():
    loop = JointLoop(settings(velocity_source="measured", velocity_filter_time_constant=0.0))
    loop.step(0, 0.0, None)
    loop.step(MS, 0.002, None)
    assert loop.velocity == pytest.approx(2.0)
    loop.step(2 * MS, 0.002, 7.0)
    assert loop.velocity == 7.0


@pytest.mark.parametrize("tau", [0.0, 0.002, 0.02])
def test_filtered_velocity_converges_to_a_constant_one(tau):
    loop = JointLoop(settings(velocity_source="filtered", velocity_filter_time_constant=tau))
    for k in range(1000):
        loop.step(k * MS, 3.0 * k * 1e-3)
    assert loop.velocity == pytest.approx(3.0, rel=1e-9)


def test_parameters_survive_a_round_trip():
    values = {"joint": "j", "gains.p": 3.0, "gains.d": 1.0, "mu": -0.2, "inertia": 0.5}
    values["norm.type"] = "canonical"
    checked = LoopSettings.from_parameters(values)
    assert LoopSettings.from_parameters(checked.to_parameters()) == checked
    assert set(checked.to_parameters()) == set(LOOP_PARAMETERS)


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({"gain.p": 1.0}, SettingError, "did you mean 'gains.p'"),
        ({"mu": 0.5}, NormError, r"\(-0.5, 0.5\), not 0.5"),
        ({"mu": "much"}, SettingError, "mu must be a number, not 'much'"),
        ({"mu": True}, SettingError, "mu must be a number, not True"),
        ({"gains.p": math.nan}, SettingError, "gains.p must lie in"),
        ({"gains.i": -1.0}, SettingError, "gains.i must lie in"),
        ({"law": "PID"}, SettingError, "law must be one of hpid, pid, not 'PID'"),
        ({"u_clamp_min": 2.0, "u_clamp_max": 1.0}, SettingError, "u_clamp_min = 2.0"),
        ({"joint": ""}, SettingError, "must name the joint"),
        (
            {"gains.p": 1.0, "gains.d": 1.0, "gains.i": 3.0, "inertia": 0.5},
            GainError,
            "p d = 1 must exceed i x inertia = 1.5",
        ),
    ],
)
def test_bad_parameters_are_refused_in_one_line(values, error, message):
    with pytest.raises(error, match=message) as refusal:
        LoopSettings.from_parameters({"joint": "j", **values})
    assert isinstance(refusal.value, HpidError)
    assert isinstance(refusal.value, ValueError)
    assert "\n" not in str(refusal.value)


def test_every_parameter_has_a_description_and_a_range_that_holds_its_default():
    for spec in LOOP_PARAMETERS.values():
        assert len(spec.description) > 10
        assert spec.checked(spec.default) == spec.default
        if isinstance(spec.default, float):
            assert math.isfinite(spec.minimum)
            assert math.isfinite(spec.maximum)


@pytest.mark.parametrize("law", ["pid", "hpid"])
def test_semi_implicit_step_holds_a_joint_that_the_explicit_one_loses(law):
    """Two poles at -150 rad/s and a weak integral, sampled at 10 ms: T kd = 3."""

    def largest_late_error(discretization):
        loop = JointLoop(
            settings(
                law=law,
                mu=-0.1,
                norm__floor=1e-3,
                gains=Gains(150.0**2, 0.01 * 150.0**3, 300.0),
                inertia=1.0,
                control_period=0.01,
                discretization=discretization,
            )
        )
        loop.follow(Setpoint(0.5))
        position = velocity = 0.0
        late = 0.0
        for k in range(400):
            effort = loop.step(k * 10 * MS, position, velocity)
            for _ in range(10):
                velocity += 1e-3 * min(max(effort, -1e9), 1e9)
                position += 1e-3 * velocity
            if k > 300:
                late = max(late, abs(position - 0.5))
        return late

    assert largest_late_error("semi_implicit") < 0.01
    assert not largest_late_error("explicit") < 0.01


def test_semi_implicit_step_needs_the_inertia():
    with pytest.raises(SettingError, match="needs the inertia"):
        settings(discretization="semi_implicit")


def test_the_differentiator_is_a_velocity_source_of_the_loop():
    loop = JointLoop(
        settings(velocity_source="homogeneous_differentiator", acceleration_bound=20.0)
    )
    for k in range(1000):
        loop.step(k * MS, 0.5 * 4.0 * (k * 1e-3) ** 2)
    assert loop.velocity == pytest.approx(4.0 * 0.999, abs=0.01)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=30))
def test_missed_samples_are_counted_from_the_stamps(steps):
    loop = JointLoop(settings(control_period=0.001))
    stamp_ns = 0
    loop.step(stamp_ns, 0.0, 0.0)
    for periods in steps:
        stamp_ns += periods * 1_000_000
        loop.step(stamp_ns, 0.0, 0.0)
    assert loop.counts.missed == sum(steps) - len(steps)

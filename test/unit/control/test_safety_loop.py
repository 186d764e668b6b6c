"""Silence, takeover and retuning of the pure loop: nothing moves a joint by a jump."""

import math

import numpy as np
import pytest
from harness.loops import loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control import LOOP_PARAMETERS, Gains, JointLoop, LoopSettings
from hpid_ros.control.assembly import make_law, make_motion_limits
from hpid_ros.control.joint_loop import LoopState
from hpid_ros.control.reference import Glide, Setpoint
from hpid_ros.motion import Column, Knot

MS = 1_000_000
SECOND = 1000 * MS
RAMP = Column("j", (Knot(0, 0.0, 0.0), Knot(4 * SECOND, 2.0, 0.0)), stamp_ns=SECOND)


def settings(**changes):
    values = {"joint": "j", "gains": Gains(100.0, 50.0, 20.0), "law": "pid"}
    return loop_settings(**{**values, **changes})


def run(loop, first_ms, last_ms, position):
    for k in range(first_ms, last_ms):
        effort = loop.step(k * MS, position, 0.0)
    return effort


@pytest.mark.parametrize("motion", [None, Setpoint(1.0), RAMP])
@pytest.mark.parametrize("fallback", [0.0, 4.0])
def test_after_a_silence_the_loop_takes_over_from_where_the_joint_fell_without_a_jump(
    motion, fallback
):
    loop = JointLoop(settings(fallback_effort=fallback))
    if motion:
        loop.follow(motion)
    assert abs(run(loop, 1000, 2000, 0.3)) > 2.0 or motion is None
    assert loop.note_timeout() == fallback
    assert loop.state is LoopState.SILENT
    effort = loop.step(2500 * MS, -0.4, 0.0)
    assert effort == pytest.approx(fallback)
    assert loop.reference == pytest.approx((-0.4, 0.0))
    assert (loop.counts.silences, loop.counts.takeovers, loop.counts.gaps) == (1, 1, 1)
    after = [loop.step((2500 + k) * MS, -0.4, 0.0) for k in range(1, 520)]
    assert np.max(np.abs(np.diff([effort, *after]))) < 2.5  # the glide's own pace
    if motion is RAMP:
        assert loop.reference == pytest.approx(RAMP.start(SECOND, 0.0).sample(3019 * MS)[:2])
    elif motion:
        assert loop.reference == (1.0, 0.0)
    else:
        assert loop.reference == (-0.4, 0.0)  # it holds where the joint is now


def test_a_pause_of_the_control_clock_leaves_no_trace():
    loop, twin = (JointLoop(settings(state_clock="simulated")) for _ in range(2))
    for each in (loop, twin):
        each.follow(RAMP)
    for k in range(1000, 1500):
        assert loop.step(k * MS, 0.1, 0.0) == twin.step(k * MS, 0.1, 0.0)
        if k % 100 == 50:
            assert loop.note_timeout() == 0.0
            assert loop.step(k * MS, 0.1, 0.0) == twin.effort  # asked again: the same answer
    assert loop.counts.takeovers == 0


@pytest.mark.parametrize("motion", [None, Setpoint(1.0), RAMP])
def test_a_freeze_that_nobody_noticed_is_a_takeover_too(motion):
    """SIGSTOP stops the watchdog with the loop: only the stamps tell."""
    loop = JointLoop(settings(law="hpid", mu=-0.2))
    if motion:
        loop.follow(motion)
    for k in range(1000, 1500):
        before = loop.step(k * MS, 0.1 + 1e-4 * (k - 1000), 0.1)
    effort = loop.step(3000 * MS, 0.15, 0.0)
    assert effort == pytest.approx(before)
    assert (loop.counts.takeovers, loop.counts.gaps, loop.counts.silences) == (1, 1, 0)
    efforts = [effort, *(loop.step((3000 + k) * MS, 0.15, 0.0) for k in range(1, 400))]
    assert np.max(np.abs(np.diff(efforts))) < 3.0


@pytest.mark.parametrize("clock", ["wall", "simulated"])
def test_only_a_simulated_clock_can_be_paused(clock):
    """Stamps that count samples do not tell that the joint hung free meanwhile."""
    loop = JointLoop(settings(state_clock=clock, fallback_effort=1.0))
    loop.follow(Setpoint(1.0))
    before = run(loop, 0, 200, 0.2)
    assert loop.note_timeout() == 1.0
    assert loop.step(199 * MS, 0.2, 0.0) == (1.0 if clock == "wall" else before)
    effort = loop.step(200 * MS, 0.2, 0.0)
    if clock == "wall":
        assert effort == pytest.approx(1.0)
        assert loop.counts.takeovers == 1
    else:
        assert effort == pytest.approx(before, abs=0.1)
        assert loop.counts.takeovers == 0


def test_a_repeat_is_held_to_the_limits_of_now():
    loop = JointLoop(settings())
    loop.follow(Setpoint(1.0))
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


def test_a_timeout_cannot_be_so_long_that_nobody_is_watched_or_so_short_that_all_is_a_gap():
    with pytest.raises(SettingError, match=r"state_timeout must lie in \[1e-06, 1\], not 1000"):
        LoopSettings.from_parameters({"joint": "j", "state_timeout": 1000.0})
    with pytest.raises(SettingError, match=r"state_timeout = 0.1 s must be at least 1.5 times"):
        LoopSettings.from_parameters({"joint": "j", "control_period": 0.2})


def test_a_single_position_that_no_joint_can_have_come_to_is_passed_over():
    values = {"velocity_source": "filtered", "velocity_max": 5.0}
    loop, twin = (JointLoop(settings(**values)) for _ in range(2))
    for each in (loop, twin):
        each.follow(Setpoint(0.5))
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
    loop = JointLoop(settings(velocity_source="filtered", velocity_max=5.0))
    loop.follow(Setpoint(0.5))
    before = run(loop, 0, 200, 0.2)
    efforts = [loop.step((200 + k) * MS, 1.2) for k in range(300)]
    assert efforts[:2] == pytest.approx([before, before])
    assert (loop.counts.jumps, loop.counts.takeovers) == (1, 1)
    assert np.max(np.abs(np.diff(efforts))) < 2.5
    run(loop, 500, 800, 1.2)
    assert loop.reference == (0.5, 0.0)


def test_of_jumps_in_a_row_the_damping_is_not_added_up():
    """An encoder that is now here, now there, on a joint that moves all the while."""
    loop = JointLoop(settings(velocity_max=5.0))
    for k in range(200):
        loop.step(k * MS, 1e-3 * k, 1.0)
    here = loop.effort
    efforts = [
        loop.step(k * MS, 1e-3 * k + (2.0 if (k // 2) % 2 else 0.0), 1.0) for k in range(200, 240)
    ]
    assert loop.counts.takeovers > 15
    # Each takes over at rest, at the joint's 1 rad/s: 20 N m of damping, as held before.
    assert np.max(np.abs(np.array(efforts) - here)) < 20.0 + 1.0


@pytest.mark.parametrize("clock", ["wall", "simulated"])
def test_a_silence_in_which_nobody_gave_another_effort_ends_with_the_effort_in_force(clock):
    loop = JointLoop(settings(state_clock=clock, fallback_effort=1.0))
    loop.follow(Setpoint(1.0))
    before = run(loop, 0, 200, 0.2)
    loop.note_unanswered()
    assert loop.step(200 * MS, 0.2, 0.0) == pytest.approx(before, abs=0.1)
    # Only a simulated clock can be paused.
    assert loop.counts.takeovers == (clock == "wall")
    assert loop.counts.silences == 1


def test_positions_that_jump_about_are_no_positions():
    loop = JointLoop(settings(fallback_effort=0.5, velocity_max=5.0))
    loop.follow(Setpoint(0.5))
    before = run(loop, 0, 200, 0.2)
    efforts = [loop.step((200 + k) * MS, (-1.0) ** k * (2.0 + k), 0.0) for k in range(50)]
    assert efforts[0] == before
    assert set(efforts[1:]) == {0.5}
    assert loop.state is LoopState.FAULT
    assert loop.step(260 * MS, 0.2, 0.0) == pytest.approx(before, abs=0.2)  # it was short


def test_the_largest_step_is_that_of_the_velocity_limit_or_is_none():
    for changes, step, jumps in (
        ({"velocity_max": 2.0}, 0.12, 1),
        ({"velocity_max": 2.0}, 0.10, 0),
        ({}, 3.2, 1),
        ({}, 3.1, 0),
        ({"position_step_max": 0.3}, 0.35, 1),
        ({"position_step_max": 0.3, "velocity_max": 20.0}, 0.35, 0),
        ({"position_step_max": 1e6}, 50.0, 0),
    ):
        loop = JointLoop(settings(**changes))
        run(loop, 0, 10, 0.0)
        loop.step(10 * MS, step, 0.0)
        assert loop.counts.jumps == jumps, (changes, step)


@pytest.mark.parametrize("source", ["filtered", "homogeneous_differentiator", "observer"])
def test_a_damping_stop_needs_no_velocities_where_the_loop_needs_none(source):
    efforts = []
    for velocity in (None, math.nan):
        loop = JointLoop(settings(velocity_source=source, inertia=1.0))
        for k in range(200):
            loop.step(k * MS, 1e-3 * k, velocity)
        stop = loop.damping_stop(0.2)
        efforts.append([stop.step((200 + k) * MS, 0.2 + 1e-3 * k, velocity) for k in range(100)])
    assert efforts[0] == efforts[1]
    assert max(efforts[0]) < -5.0


MOVING = {
    **{"law": "hpid", "mu": -0.1, "gains.p": 100.0, "gains.i": 50.0, "gains.d": 20.0},
    **{"u_clamp_max": 60.0, "u_clamp_min": -60.0, "inertia": 1.0},
}
OTHERS = {
    **{"law": "pid", "norm.type": "canonical", "velocity_source": "filtered"},
    **{"antiwindup_strategy": "back_calculation", "discretization": "semi_implicit"},
    **{"state_clock": "simulated", "angle_wraparound": True},
    **{"mu": 0.1, "gains.p": 120.0, "gains.i": 60.0, "gains.d": 22.0, "norm.floor": 0.5},
    **{"norm.cap": 1.0, "norm.error_scale": 0.5, "norm.rate_weight": 0.2, "u_clamp_max": 20.0},
    **{"u_clamp_min": -20.0, "i_clamp_max": 2.0, "i_clamp_min": -2.0, "encoder_wrap": 6.3},
    **{"velocity_filter_time_constant": 0.006, "acceleration_bound": 60.0, "inertia": 1.5},
    **{"tracking_time_constant": 0.3, "position_step_max": 0.2, "effort_rate_max": 1e4},
    **{"position_max": 9.0, "position_min": -9.0, "velocity_max": 4.0, "soft_stop.margin": 0.1},
    **{"soft_stop.k_position": 5.0, "soft_stop.k_velocity": 5.0, "takeover_time": 1.0},
    **{"fallback_effort": 1.0, "state_timeout": 0.2, "control_period": 0.002},
    **{"encoder_resolution": 1e-3, "norm.effort_scale": 30.0, "multi_turn": True},
    **{"observer.bandwidth": 120.0, "observer.degree": -0.1, "observer.innovation_scale": 0.01},
    **{"observer.feed_disturbance": True, "feedforward.inertia": 0.5},
    **{"feedforward.viscous_friction": 2.0, "feedforward.coulomb_friction": 1.0},
    **{"feedforward.friction_velocity": 0.02, "feedforward.trajectory_effort": False},
}


@pytest.mark.parametrize(
    "source", ["measured", "filtered", "homogeneous_differentiator", "observer"]
)
@pytest.mark.parametrize("name", [name for name in LOOP_PARAMETERS if name != "joint"])
def test_every_parameter_is_retuned_in_motion_without_a_kick(name, source):
    """At 2 rad/s the effort moves by no more than the laws differ at the same error."""
    values = {"joint": "j", **MOVING, "velocity_source": source}
    if source == "observer" and name == "observer.feed_disturbance":
        pytest.skip("adds a term: test_observed_loop.py")
    if name == "acceleration_bound":
        values["velocity_source"] = "homogeneous_differentiator"
    start, end = Knot(0, 0.0, 2.0), Knot(4 * SECOND, 8.0, 2.0)
    loops = [JointLoop(LoopSettings.from_parameters(values)) for _ in range(2)]
    loop, twin = loops
    for each in loops:
        each.follow(Column("j", (start, end), stamp_ns=1))
    wave = [2e-3 * k + 0.02 * math.sin(0.02 * k) for k in range(1100)]
    hears = values["velocity_source"] == "measured"
    for k, position in enumerate(wave):
        if k == 1000:
            changed = LoopSettings.from_parameters({**values, name: OTHERS[name]})
            integral = loop.integral
            law, clamp = make_law(changed), changed.integral
            law.restore_integral(min(max(integral, clamp.i_clamp_min), clamp.i_clamp_max))
            loop.retune(changed)
        speed = 2.0 + 0.4 * math.cos(0.02 * k) if hears else None
        efforts = [each.step(k * MS, position, speed) for each in loops]
        if k >= 1000:
            own = law.update(loop.error, loop.reference[1] - loop.velocity, 1e-3)
            difference = abs(changed.effort.within(own) - efforts[1])
            assert abs(efforts[0] - efforts[1]) <= difference + 1e-9 + 0.02 * (k > 1000), k
            # ... and estimates of the velocity differ by no more than their filters do.
            assert abs(loop.velocity - twin.velocity) < 0.2
            if k == 1000:
                assert abs(loop.velocity - twin.velocity) * changed.gains.d < 1.0
        else:
            assert efforts[0] == efforts[1]


def test_states_that_cannot_be_used_for_long_end_in_a_takeover_and_for_short_do_not():
    for duration, takeovers in ((50, 0), (150, 1)):
        loop = JointLoop(settings())
        loop.follow(Setpoint(1.0))
        before = run(loop, 0, 200, 0.2)
        for k in range(200, 200 + duration):
            assert loop.step(k * MS, math.nan) == 0.0
        assert "position nan" in loop.last_fault
        effort = loop.step((200 + duration) * MS, 0.2, 0.0)
        assert loop.counts.takeovers == takeovers
        assert effort == pytest.approx(0.0 if takeovers else before, abs=0.1)


@pytest.mark.parametrize("position", [0.2, math.nan])
def test_a_single_stamp_from_the_future_is_a_gap_and_no_more(position):
    loop, twin = (JointLoop(settings()) for _ in range(2))
    for each in (loop, twin):
        each.follow(Setpoint(1.0))
        run(each, 0, 200, 0.2)
    loop.step(3_600_000 * MS, position, 0.0)
    efforts = [each.step(200 * MS, 0.2, 0.0) for each in (loop, twin)]
    assert efforts[0] == pytest.approx(efforts[1])  # integral and motion are as they were
    assert (loop.counts.resets, loop.counts.takeovers) == (0, 0)
    assert run(loop, 201, 400, 0.2) == pytest.approx(run(twin, 201, 400, 0.2))


def test_a_clock_that_really_jumped_goes_on_from_there():
    loop = JointLoop(settings())
    loop.follow(Setpoint(1.0))
    before = run(loop, 0, 200, 0.2)
    assert run(loop, 90_000, 90_002, 0.2) == pytest.approx(before, abs=0.1)
    loop.step(200 * MS, 0.2, 0.0)  # two were not single: now it is this one that went back
    assert loop.counts.resets == 1


def test_velocities_that_nobody_uses_may_be_nan():
    """As those of a joint_state_broadcaster are that has none."""
    for source in ("filtered", "homogeneous_differentiator", "observer"):
        loop, twin = (JointLoop(settings(velocity_source=source, inertia=1.0)) for _ in range(2))
        for k in range(50):
            effort = loop.step(k * MS, 0.01 * k, math.nan)
            assert effort == twin.step(k * MS, 0.01 * k, None)
        assert loop.counts.rejected == 0
    loop = JointLoop(settings())
    loop.step(0, 0.0, math.nan)
    assert loop.counts.rejected == 1


@pytest.mark.parametrize("absurd", [1e300, -1e18, math.inf, math.nan])
def test_absurd_numbers_leave_nothing_behind_in_the_velocity(absurd):
    loop = JointLoop(settings(velocity_source="filtered"))
    run(loop, 0, 20, 0.2)
    loop.step(20 * MS, absurd)
    loop.step(21 * MS, 0.2, absurd)
    run(loop, 22, 60, 0.2)
    assert loop.velocity == 0.0
    assert loop.state is LoopState.HOLDING


def test_a_late_joiner_starts_where_the_joint_is_and_ends_on_the_motion():
    loop = JointLoop(settings())
    loop.follow(RAMP)
    assert loop.step(3 * SECOND, 0.2, 0.0) == pytest.approx(0.0, abs=1e-9)
    run(loop, 3001, 3501, 0.2)
    assert loop.reference == pytest.approx(RAMP.start(SECOND, 0.0).sample(3500 * MS)[:2])


def test_the_same_motion_told_again_as_under_way_changes_no_bit():
    knots = (Knot(0, 0.3, 0.0, 0.0), Knot(SECOND, 1.0, 0.0, 0.0))
    told = tuple(knot._replace(time_ns=knot.time_ns - 1) for knot in knots)
    loop, twin = JointLoop(settings()), JointLoop(settings())
    for each in (loop, twin):
        each.follow(Column("j", knots))
    for k in range(1200):
        if k == 20:
            loop.follow(Column("j", told, stamp_ns=1))
        assert loop.step(k * MS, 0.1, 0.0) == twin.step(k * MS, 0.1, 0.0)
    assert loop.reference == twin.reference


@given(st.floats(-2.0, 2.0), st.floats(-3.0, 3.0), st.floats(0.01, 2.0), st.floats(0.0, 1.0))
def test_a_glide_starts_and_ends_as_it_must_and_its_velocity_is_its_derivative(
    position, velocity, duration, share
):
    onto = RAMP.start(SECOND, 0.0)
    glide = Glide(onto, 2 * SECOND, position, velocity, duration)
    assert glide.sample(2 * SECOND)[:2] == pytest.approx((position, velocity), abs=1e-9)
    assert glide.sample(glide.end_ns) == onto.sample(glide.end_ns)
    at, h = 2 * SECOND + int(share * 0.98 * duration * SECOND) + 1000, 1000
    before, here, after = (glide.sample(at + k * h) for k in (-1, 0, 1))
    for lower in (0, 1):
        slope = (after[lower] - before[lower]) / (2 * h * 1e-9)
        assert slope == pytest.approx(here[lower + 1], abs=2e-3 * (1.0 + 60.0 / duration**2))


def test_release_forgets_the_motion_and_holds_what_comes_next():
    loop = JointLoop(settings())
    loop.follow(Setpoint(1.0))
    run(loop, 0, 100, 0.0)
    loop.release()
    assert loop.step(SECOND, 0.6, 0.0) == 0.0
    assert loop.reference == (0.6, 0.0)
    assert loop.integral == 0.0


def test_a_damping_stop_only_takes_energy_out_and_ends_with_nothing():
    loop = JointLoop(settings(u_clamp_max=30.0, u_clamp_min=-30.0))
    run(loop, 0, 10, 0.0)
    stop = loop.damping_stop(0.2)
    for k in range(10, 260):
        velocity = math.cos(0.05 * k)
        effort = stop.step(k * MS, 0.0, velocity)
        assert effort * velocity <= 0.0
        assert abs(effort) <= 20.0 * abs(velocity) * max(0.0, 1.0 - (k - 9) / 200.0) + 1e-9
    assert effort == 0.0
    assert loop.damping_stop(0.2).step(10**12, math.nan, 0.0) == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e12])
def test_a_setpoint_that_is_no_position_is_refused(bad):
    with pytest.raises(SettingError, match="a setpoint must be finite"):
        Setpoint(bad)


def random_values(draw):
    """Return some parameters of a loop, of which about a third makes no valid set."""
    values = {}
    for name in draw.choice(sorted(LOOP_PARAMETERS), size=draw.integers(1, 8), replace=False):
        spec = LOOP_PARAMETERS[name]
        if name == "joint":
            continue
        if spec.choices:
            values[name] = str(draw.choice([*spec.choices, *spec.choices, "nonsense"]))
        else:
            low, high = max(spec.minimum, -50.0), min(spec.maximum, 50.0)
            values[name] = float(draw.choice([draw.uniform(low, high)] * 12 + [math.nan, 1e9]))
    return values


@pytest.mark.slow
def test_ten_thousand_sets_between_samples_are_in_force_whole_or_not_at_all(faults):
    draw = np.random.default_rng(1)
    present = {"joint": "j", "law": "pid", "gains.p": 10.0, "gains.i": 4.0, "gains.d": 2.0}
    loop = JointLoop(LoopSettings.from_parameters(present))
    loop.follow(Setpoint(0.4))
    counts = {"valid": 0, "invalid": 0}
    for k in range(10_000):
        position, velocity = 0.3 * math.sin(0.01 * k), 3.0 * math.cos(0.01 * k)
        wanted = {**present, **random_values(draw)}
        try:
            settings_now = LoopSettings.from_parameters(wanted)
        except HpidError:
            counts["invalid"] += 1
            settings_now = loop.settings
        else:
            counts["valid"] += 1
            loop.retune(settings_now)
        integral, before = loop.integral, loop.effort
        effort = loop.step(k * MS, position, velocity)
        assert loop.settings is settings_now
        low, high = settings_now.effort.u_clamp_min, settings_now.effort.u_clamp_max
        assert low <= effort <= high
        assert loop.terms.i == integral  # the law's own change and nothing else: p and d terms
        law = make_law(settings_now)
        law.restore_integral(integral)
        own = law.update(loop.error, loop.reference[1] - loop.velocity, 0.001)
        if make_motion_limits(settings_now) is None:
            assert effort == min(max(own, low), high)
        elif settings_now.effort.effort_rate_max > 0.0:
            allowed = settings_now.effort.effort_rate_max * 0.001 + 1e-9
            assert abs(effort - before) <= allowed or effort in (low, high)
    assert min(counts.values()) > 1000
    faults.count("parameter sets: pure loop, valid", counts["valid"])
    faults.count("parameter sets: pure loop, refused", counts["invalid"])


def test_a_motion_that_nobody_repeats_is_followed_to_its_end_and_then_held():
    loop = JointLoop(settings())
    loop.follow(RAMP)
    run(loop, 1000, 5200, 0.0)
    assert loop.reference == (2.0, 0.0)
    assert loop.state is LoopState.FOLLOWING

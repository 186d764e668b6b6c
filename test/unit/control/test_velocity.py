"""Velocity sources: Levant's differentiator, the observer, and a loop with an observer."""

import math
import random
from itertools import pairwise

import numpy as np
import pytest
from harness.loops import Joint, drive, loops_with
from hypothesis import assume, example, given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control import ModelTerm
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.velocity import (
    LARGEST_OBSERVER_DEGREE,
    LEAST_OBSERVER_DEGREE,
    HomogeneousDifferentiator,
    Observer,
    ObserverDesign,
)
from hpid_ros.motion import Column, Knot

MS = 1_000_000
PERIOD = 1e-3
BOUND = 10.0  # [rad/s^2]


def estimates(source, positions, period=PERIOD):
    return np.array([source.update(x, None, period * bool(k)) for k, x in enumerate(positions)])


def differentiated(positions, period=PERIOD):
    return estimates(HomogeneousDifferentiator(BOUND), positions, period)


def observer_state(loop):
    """Return position [rad], velocity [rad/s] and disturbance [N m] by the loop's observer."""
    return loop.estimation.observer_state(loop.law.model_gain)


def sine(period, duration=4.0, frequency=2.0):
    """Return times, positions and velocities of a sine that stays below the bound."""
    t = np.arange(0.0, duration, period)
    amplitude = 0.8 * BOUND / frequency**2
    return t, amplitude * np.sin(frequency * t), amplitude * frequency * np.cos(frequency * t)


@given(st.floats(-3.0, 3.0), st.floats(-100.0, 100.0), st.sampled_from([1e-3, 5e-3, 2e-2]))
def test_a_constant_velocity_is_exact_after_finite_time(velocity, offset, period):
    convergence = 4.0 * abs(velocity) / BOUND + 3.0 * period
    count = math.ceil(2.0 * convergence / period)
    positions = offset + velocity * period * np.arange(count)
    late = differentiated(positions, period)[count // 2 :]
    assert np.abs(late - velocity).max() <= 1e-11 * (1.0 + abs(offset)) / period


def test_error_falls_with_the_period_and_nothing_chatters():
    worst = []
    for period in (8e-3, 4e-3, 2e-3, 1e-3):
        t, positions, velocities = sine(period)
        found = differentiated(positions, period)
        worst.append(np.abs(found - velocities)[t > 2.0].max())
        assert worst[-1] <= BOUND * period
        assert np.abs(np.diff(found[t > 2.0])).max() <= BOUND * period
    assert np.diff(np.log(worst)) / np.log(0.5) == pytest.approx(1.0, abs=0.1)


def test_error_grows_with_the_root_of_the_noise():
    period, worst, noises = 1e-4, [], (1e-5, 1e-4, 1e-3)
    t, positions, velocities = sine(period)
    for noise in noises:
        disturbed = positions + noise * np.random.default_rng(1).uniform(-1.0, 1.0, t.size)
        worst.append(np.abs(differentiated(disturbed, period) - velocities)[t > 2.0].max())
        assert worst[-1] <= 5.0 * math.sqrt(BOUND * noise)
    orders = np.diff(np.log(worst)) / np.diff(np.log(noises))
    assert orders == pytest.approx(0.5, abs=0.2)


def test_a_repeated_instant_changes_nothing_and_reset_forgets():
    source, positions = HomogeneousDifferentiator(BOUND), np.linspace(0.0, 1.0, 50)
    first = estimates(source, positions, 0.01)
    assert source.update(7.0, 3.0, 0.0) == first[-1]
    source.reset()
    assert source.update(5.0, None, 0.01) == 0.0
    source.reset()
    assert np.array_equal(estimates(source, positions, 0.01), first)


DEGREES = st.just(0.0) | st.floats(LEAST_OBSERVER_DEGREE, LARGEST_OBSERVER_DEGREE)


def observer(bandwidth=100.0, inertia=1.0, **others):
    return Observer(ObserverDesign(inertia, bandwidth, PERIOD, **others))


@given(st.floats(20.0, 5000.0), st.floats(0.01, 10.0), st.floats(-20.0, 20.0), DEGREES)
def test_velocity_and_disturbance_of_a_double_integrator_are_found(
    bandwidth, inertia, load, degree
):
    """Exactly, in the end: under an effort that changes, and a load that does not."""
    each = observer(bandwidth, inertia, degree=degree, innovation_scale=1e-4)
    position, velocity = 0.3, -1.0
    each.update(position, None, 0.0)
    for k in range(round(4.0 * 30.0 / bandwidth / PERIOD) + 50):
        effort = 5.0 * math.sin(0.01 * k)
        each.note_applied(effort)
        acceleration = (effort + load) / inertia
        position += PERIOD * (velocity + 0.5 * PERIOD * acceleration)
        velocity += PERIOD * acceleration
        each.update(position, None, PERIOD)
    size = 1.0 + abs(load) / inertia + 5.0 / inertia + abs(position)
    assert each.velocity == pytest.approx(velocity, abs=1e-6 * size)
    assert each.effort == pytest.approx(load, abs=1e-4 * (size * inertia + 1.0))


@given(st.floats(1.0, 6000.0))
def test_at_a_constant_period_the_observers_poles_are_three_equal_ones(bandwidth):
    each = observer(bandwidth)
    t = bandwidth * PERIOD
    pole, rest = math.exp(-t), -math.expm1(-t)
    each.update(0.0, None, 0.0)
    for _ in range(3):  # from the first sample on
        expected = 1.0 - pole**3, 1.5 * rest**2 * (1.0 + pole) / t, rest**3 / t**2
        assert each._gains(0.0, PERIOD) == pytest.approx(expected, rel=1e-6)


@given(
    st.floats(1.0, 1e4),
    st.lists(st.floats(-5.0, -0.5), min_size=1, max_size=12),
    DEGREES,
    st.floats(-6.0, 0.0),
)
@example(9103.5, [-0.5], 0.0, 0.0)  # a period so far beyond the nominal one, again and again
def test_no_sequence_of_periods_and_bandwidths_makes_the_error_grow(
    bandwidth, exponents, degree, scale
):
    """In the norm of the inverse covariance, by theory never; see docs/theory.md."""
    each = observer(bandwidth, degree=degree, innovation_scale=10.0**scale)
    each.update(0.0, None, 0.0)
    each.velocity, each.disturbance = 3.0, -40.0  # the joint rests at 0
    before = math.inf
    for k in range(400):
        each.update(0.0, None, 10.0 ** exponents[k % len(exponents)])
        state = np.array(
            [each.position, each.velocity / bandwidth, each.disturbance / bandwidth**2]
        )
        assert np.all(np.isfinite(state))
        xx, xv, xw, vv, vw, ww = each._covariance
        matrix = np.array([[xx, xv, xw], [xv, vv, vw], [xw, vw, ww]])
        spread = np.sqrt(np.diag(matrix))
        matrix /= np.outer(spread, spread)
        if np.linalg.eigvalsh(matrix)[0] < 1e-8:  # its inverse is not to be had in doubles
            before = math.inf
            continue
        size = float(state / spread @ np.linalg.solve(matrix, state / spread))
        assert size <= before * (1.0 + 1e-6) + 1e-14
        before = size


@pytest.mark.parametrize("degree", [0.0, LEAST_OBSERVER_DEGREE, LARGEST_OBSERVER_DEGREE])
@pytest.mark.parametrize("bandwidth", [1.0, 1000.0, 1e4])
def test_a_long_run_of_noise_and_jitter_stays_within_what_the_noise_is(bandwidth, degree):
    chance = random.Random(1)
    each = observer(bandwidth, degree=degree)
    largest = 0.0
    for k in range(10_000):
        late = chance.random() < 0.01
        dt = 0.08 * chance.random() if late else PERIOD * chance.uniform(0.2, 3.0)
        each.update(chance.uniform(-1e-3, 1e-3), None, dt if k else 0.0)
        largest = max(largest, abs(each.position))
    assert largest < 4e-3


def test_a_negative_degree_lets_more_noise_through_than_a_positive_one():
    """Close to the truth, where the innovation is below its scale."""
    noise = np.random.default_rng(3).normal(0.0, 2e-4, 20_000).tolist()
    most, some, least = (
        np.std(estimates(observer(60.0, degree=mu, innovation_scale=2e-3), noise)[2000:])
        for mu in (-0.3, 0.0, 0.3)
    )
    assert most > 1.5 * some > 1.5 * 1.5 * least


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_what_is_taken_over_stays_where_nothing_drives_the_joint(position, velocity):
    """In balance: the effort sent is answered by something, until a sample says otherwise."""
    each = observer(inertia=0.2)
    each.note_applied(7.0)
    each.start_from(position, velocity)
    for k in range(1, 50):
        seen = each.update(position + k * PERIOD * velocity, None, PERIOD)
        assert seen == pytest.approx(velocity, abs=1e-9)
    assert each.effort == pytest.approx(-7.0)


@given(st.floats(0.02, 5.0), st.floats(0.02, 5.0))
def test_another_inertia_moves_no_estimate(before, after):
    assume(abs(before - after) > 1e-3)
    each = observer(inertia=before)
    each.note_applied(3.0)
    each.start_from(0.1, 0.4)
    each.retune(ObserverDesign(after, 200.0, PERIOD))
    each.note_applied(3.0)
    assert each.update(0.1 + 0.4 * PERIOD, None, PERIOD) == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("make", "value", "message"),
    [
        *((HomogeneousDifferentiator, x, "must be positive") for x in (0.0, -1.0)),
        *((HomogeneousDifferentiator, x, "must be positive") for x in (math.nan, math.inf)),
        (observer, 0.0, "bandwidth must be positive"),
        (lambda x: observer(inertia=x), math.nan, "inertia must be positive"),
        (lambda x: observer(innovation_scale=x), -1.0, "innovation_scale must be positive"),
        (lambda x: observer(degree=x), 0.6, r"degree must lie in \[-0.33, 0.5\], not 0.6"),
    ],
)
def test_figures_out_of_range_are_refused(make, value, message):
    with pytest.raises(SettingError, match=message):
        make(value)


INERTIA = 0.5
VALUES = {
    **{"law": "pid", "gains__p": 200.0, "gains__i": 500.0, "gains__d": 20.0},
    **{"inertia": INERTIA, "velocity_source": "observer"},
}
FIGURES = {
    **{"velocity_source": "filtered", "velocity_filter_time_constant": 0.02, "inertia": 0.7},
    **{"observer.bandwidth": 300.0, "observer.degree": 0.2, "observer.innovation_scale": 1e-5},
}


_, loop_of = loops_with(**VALUES)


def joint_of(load=0.0, inertia=INERTIA):
    return Joint(inertia, load, position=0.1)


@pytest.mark.parametrize("law", ["pid", "hpid"])
@pytest.mark.parametrize("limit", [1e6, 6.0])
@pytest.mark.parametrize("periods", [(1e-3,), (2e-3, 0.04, 1e-3)])
def test_velocity_and_load_are_found_whatever_the_limits_and_the_stamps(law, limit, periods):
    """What was sent counts, not what was wanted."""
    loop = loop_of(Setpoint(0.4), law=law, mu=-0.1, u_clamp_max=limit, u_clamp_min=-limit)
    joint = joint_of(load=-3.0)
    drive(loop, joint, 150, periods)
    for _ in range(200):
        speed = joint.velocity
        drive(loop, joint, 1, periods)
        assert observer_state(loop)[2] == pytest.approx(-3.0, abs=1e-3)
        assert loop.estimation.velocity == pytest.approx(speed, abs=1e-4)
    assert (loop.counts.saturated > 0) == (limit == 6.0)


def test_the_law_sees_the_estimated_position():
    loop = loop_of(Setpoint(0.0), gains__i=0.0, gains__d=1e-6, observer__bandwidth=50.0)
    for k in range(500):
        effort = loop.step(k * MS, 1e-3 * (-1) ** k)
    assert abs(effort) < 0.1 * 200.0 * 1e-3
    assert loop.error == pytest.approx(-observer_state(loop)[0])


@given(st.integers(1, 40), st.booleans())
def test_states_without_a_position_leave_the_estimates_right(lost, is_nan):
    """The fallback was sent meanwhile, which the observer knows."""
    loop = loop_of(Setpoint(0.4), fallback_effort=2.0, observer__bandwidth=60.0)
    joint = joint_of(load=-1.0)
    drive(loop, joint, 400)
    for _ in range(lost):
        joint.push(loop.step(joint.stamp_ns, math.nan if is_nan else 1e300))
    speed = joint.velocity
    drive(loop, joint, 1)
    assert loop.estimation.velocity == pytest.approx(speed, abs=1e-6)
    assert observer_state(loop)[2] == pytest.approx(-1.0, abs=1e-3)


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.parametrize("back", [False, True])
def test_an_observer_is_switched_and_retuned_in_motion_without_a_kick(name, back):
    """No estimate jumps: the effort moves by no more than from sample to sample before."""
    start = {name.replace(".", "__"): FIGURES[name]} if back else {}
    (loop, joint), twin = [(loop_of(Setpoint(1.0), **start), joint_of(-8.0)) for _ in range(2)]
    for each, own in ((loop, joint), twin):
        drive(each, own, 60)
    assert abs(loop.estimation.velocity) > 0.5
    other = loop_of().settings.to_parameters() if back else FIGURES
    loop.retune(loop.settings.with_parameters({name: other[name]}))
    differences = np.subtract(drive(loop, joint, 10), drive(*twin, 10))
    assert abs(differences[0]) < 0.6  # of up to 60; an estimate that began again: 10
    assert np.abs(np.diff(differences)).max() < 0.5


@pytest.mark.parametrize("last", [500, 501])
def test_what_an_observer_is_off_by_when_it_is_left_fades(last):
    """It is left, met again half way and left again: no effort steps; the measurement remains."""
    changes = {"gains__i": 0.0, "gains__d": 1e-6, "observer__bandwidth": 50.0}
    loop = loop_of(Setpoint(0.0), **changes, takeover_time=0.1)
    observed = loop.settings
    filtered = observed.with_parameters({"velocity_source": "filtered"})
    for k in range(last):
        effort = loop.step(k * MS, 1e-3 * (-1) ** k)
    measured = 1e-3 * (-1) ** k
    assert abs(effort + 200.0 * measured) > 0.1  # what a step would be
    for settings, samples in ((filtered, 40), (observed, 40)) * 2 + ((filtered, 101),):
        loop.retune(settings)
        for _ in range(samples):
            k += 1
            before, effort = effort, loop.step(k * MS, measured)
            assert abs(effort - before) < 0.02
    assert loop.error == -measured


@pytest.mark.parametrize("model", [None, ModelTerm(1.0, 2.5), ModelTerm(0.3, -4.0)])
def test_a_disturbance_is_fed_and_left_alone_again_without_a_kick(model):
    """The integral hands over what the other term gives, and takes it back."""
    changes = {"compensation": "decoupling"} if model and model.gain != 1.0 else {}
    loop = loop_of(Setpoint(0.1), observer__bandwidth=60.0, **changes)
    joint = joint_of(load=-8.0)

    def step():
        effort = loop.step(joint.stamp_ns, joint.position, None, model)
        joint.push(effort)
        return effort

    for _ in range(4000):
        effort = step()
    assert effort == pytest.approx(8.0, abs=1e-3)
    for is_on in (True, False, True):
        loop.retune(loop.settings.with_parameters({"observer.feed_disturbance": is_on}))
        assert step() == pytest.approx(effort, abs=1e-5)
        own = 8.0 - (model.effort if model else 0.0)
        assert loop.law.integral == pytest.approx(0.0 if is_on else own, abs=0.01)
        for _ in range(200):
            assert step() == pytest.approx(effort, abs=1e-3)


def test_what_was_fed_against_a_disturbance_fades_where_no_integral_may_take_it():
    loop = loop_of(Setpoint(0.1), gains__i=0.0, observer__feed_disturbance=True)
    joint = joint_of(load=-8.0)
    effort = drive(loop, joint, 3000)[-1]
    assert (effort, loop.error) == (pytest.approx(8.0, abs=1e-3), pytest.approx(0.0, abs=1e-4))
    loop.retune(loop.settings.with_parameters({"observer.feed_disturbance": False}))
    efforts = [effort, *drive(loop, joint, 3000)]
    assert max(abs(b - a) for a, b in pairwise(efforts)) < 0.05
    assert loop.law.integral == 0.0
    assert loop.error == pytest.approx(8.0 / loop.settings.gains.p, rel=1e-3)


def test_with_decoupling_only_what_the_model_does_not_know_is_a_disturbance():
    """Its gain, its effort and the reference's acceleration are known to drive the joint."""
    gain, own, load = 0.3, -4.0, 0.6
    column = Column("j", (Knot(0, 0.1, 0.0, 0.0), Knot(800 * MS, 2.0, 0.0, 0.0)), stamp_ns=1)
    loop, joint = loop_of(column, compensation="decoupling"), joint_of(inertia=gain)
    for k in range(800):
        effort = loop.step(joint.stamp_ns, joint.position, None, ModelTerm(gain, own, True))
        joint.push(effort - own + load)
        if k > 300:
            assert observer_state(loop)[2] == pytest.approx(load, abs=1e-3)
    assert joint.position > 1.5


@pytest.mark.parametrize("is_fed", [False, True])
def test_a_takeover_begins_with_the_active_effort(is_fed):
    loop, joint = loop_of(Setpoint(0.1), observer__feed_disturbance=is_fed), joint_of(load=-8.0)
    effort = drive(loop, joint, 3000)[-1]
    joint.stamp_ns += 500 * MS
    assert drive(loop, joint, 2) == pytest.approx([effort] * 2, abs=1e-5)
    assert loop.counts.takeovers == 1
    assert drive(loop, joint, 300)[-1] == pytest.approx(effort, abs=0.05)


def test_a_reset_leaves_nothing_behind():
    loop, fresh = loop_of(), loop_of()
    drive(loop, joint_of(load=5.0), 300)
    loop.reset()
    assert drive(loop, joint_of(load=-2.0), 300) == drive(fresh, joint_of(load=-2.0), 300)


def test_without_inertia_an_observer_is_the_filter_to_the_bit_and_says_so():
    values = {"inertia": 0.0, "velocity_filter_time_constant": 0.01}
    loop, twin = loop_of(**values), loop_of(**values, velocity_source="filtered")
    assert drive(loop, joint_of(), 300) == drive(twin, joint_of(), 300)
    assert observer_state(loop) is None
    assert loop.estimation.origin == "filtered, the inertia is unknown"
    assert "needs the parameter inertia" in loop.estimation.warning
    loop.retune(loop.settings.with_parameters({"inertia": INERTIA}))
    assert (loop.estimation.origin, loop.estimation.warning) == ("observer", "")
    assert observer_state(loop) is not None


@pytest.mark.parametrize(
    ("d", "bandwidth", "expected"), [(20.0, 0.0, 160.0), (10.0, 0.0, 80.0), (10.0, 33.0, 33.0)]
)
def test_an_observers_bandwidth_follows_the_gains_unless_it_is_given(d, bandwidth, expected):
    loop = loop_of(gains__d=d, observer__bandwidth=bandwidth)
    assert loop.estimation._observer.design.bandwidth == expected


def test_a_source_that_was_changed_at_a_stray_stamp_stays_changed():
    loop, joint = loop_of(), joint_of()
    drive(loop, joint, 50)
    loop.step(joint.stamp_ns + 10_000 * MS, joint.position)  # from the future
    loop.retune(loop_of(velocity_source="filtered").settings)
    drive(loop, joint, 5)
    assert loop.counts.takeovers == 0  # the stray stamp has left nothing behind
    assert observer_state(loop) is None

"""The observer: what it converges to, its gains, its noise, and that nothing makes it unstable."""

import math
import random

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control.velocity import LARGEST_DEGREE, LEAST_DEGREE, Observer, ObserverFigures

PERIOD = 1e-3
degrees = st.one_of(st.just(0.0), st.floats(LEAST_DEGREE, LARGEST_DEGREE))


def observer(bandwidth=100.0, inertia=1.0, **others):
    return Observer(ObserverFigures(inertia, bandwidth, PERIOD, **others))


def covariance(each):
    xx, xv, xw, vv, vw, ww = each._covariance
    return np.array([[xx, xv, xw], [xv, vv, vw], [xw, vw, ww]])


@given(st.floats(20.0, 5000.0), st.floats(0.01, 10.0), st.floats(-20.0, 20.0), degrees)
def test_velocity_and_disturbance_of_a_double_integrator_are_found(
    bandwidth, inertia, load, degree
):
    """Exactly, in the end: under an effort that changes, and a load that does not."""
    each = observer(bandwidth, inertia, degree=degree, innovation_scale=1e-4)
    position, velocity = 0.3, -1.0
    each.update(position, None, 0.0)
    for k in range(round(4.0 * 30.0 / bandwidth / PERIOD) + 50):
        effort = 5.0 * math.sin(0.01 * k)
        each.send(effort)
        acceleration = (effort + load) / inertia
        position += PERIOD * (velocity + 0.5 * PERIOD * acceleration)
        velocity += PERIOD * acceleration
        each.update(position, None, PERIOD)
    size = 1.0 + abs(load) / inertia + 5.0 / inertia + abs(position)
    assert each.velocity == pytest.approx(velocity, abs=1e-6 * size)
    assert each.effort == pytest.approx(load, abs=1e-4 * (size * inertia + 1.0))


@given(st.floats(1.0, 6000.0))
def test_at_a_constant_period_its_poles_are_three_equal_ones(bandwidth):
    each = observer(bandwidth)
    pole, t = math.exp(-bandwidth * PERIOD), bandwidth * PERIOD
    each.update(0.0, None, 0.0)
    for _ in range(3):  # from the first sample on
        gains = each._gains(0.0, PERIOD)
        rest = -math.expm1(-t)
        expected = 1.0 - pole**3, 1.5 * rest**2 * (1.0 + pole) / t, rest**3 / t**2
        assert gains == pytest.approx(expected, rel=1e-6)


@given(
    st.floats(1.0, 1e4),
    st.lists(st.floats(-5.0, -0.5), min_size=1, max_size=12),
    degrees,
    st.floats(-6.0, 0.0),
)
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
        matrix = covariance(each)
        spread = np.sqrt(np.diag(matrix))
        matrix /= np.outer(spread, spread)
        if np.linalg.eigvalsh(matrix)[0] < 1e-8:  # its inverse is not to be had in doubles
            before = math.inf
            continue
        size = float(state / spread @ np.linalg.solve(matrix, state / spread))
        assert size <= before * (1.0 + 1e-6) + 1e-14
        before = size


@pytest.mark.parametrize("degree", [0.0, LEAST_DEGREE, LARGEST_DEGREE])
@pytest.mark.parametrize("bandwidth", [1.0, 30.0, 1000.0, 1e4])
def test_a_long_run_of_noise_and_jitter_stays_within_what_the_noise_is(bandwidth, degree):
    chance = random.Random(1)
    each = observer(bandwidth, degree=degree)
    largest = 0.0
    for k in range(20_000):
        late = chance.random() < 0.01
        dt = 0.08 * chance.random() if late else PERIOD * chance.uniform(0.2, 3.0)
        each.update(chance.uniform(-1e-3, 1e-3), None, dt if k else 0.0)
        largest = max(largest, abs(each.position))
    assert largest < 4e-3


def test_noise_in_the_velocity_grows_as_the_bandwidth_to_the_power_of_one_and_a_half():
    """White noise on the position: std(v) = k sigma T^0.5 w^1.5, and far below differences'."""
    chance = random.Random(2)
    noise = [chance.gauss(0.0, 1e-3) for _ in range(60_000)]
    deviations = []
    for bandwidth in (40.0, 160.0):
        each = observer(bandwidth)
        seen = [each.update(x, None, PERIOD * bool(k)) for k, x in enumerate(noise)]
        deviations.append(np.std(seen[1000:]))
    assert deviations[1] / deviations[0] == pytest.approx(4.0**1.5, rel=0.12)
    assert deviations[1] < 0.1 * np.std(np.diff(noise)) / PERIOD


def test_a_negative_degree_lets_more_noise_through_than_a_positive_one():
    """Close to the truth, where the innovation is below its scale."""
    chance = random.Random(3)
    noise = [chance.gauss(0.0, 2e-4) for _ in range(20_000)]

    def deviation(degree):
        each = observer(60.0, degree=degree, innovation_scale=2e-3)
        seen = [each.update(x, None, PERIOD * bool(k)) for k, x in enumerate(noise)]
        return np.std(seen[2000:])

    assert deviation(-0.3) > 1.5 * deviation(0.0) > 1.5 * 1.5 * deviation(0.3)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_what_is_taken_over_stays_where_nothing_drives_the_joint(position, velocity):
    """In balance: the effort sent is answered by something, until a sample says otherwise."""
    each = observer(inertia=0.2)
    each.send(7.0)
    each.take_over(position, velocity)
    for k in range(1, 50):
        seen = each.update(position + k * PERIOD * velocity, None, PERIOD)
        assert seen == pytest.approx(velocity, abs=1e-9)
    assert each.effort == pytest.approx(-7.0)


@given(st.floats(0.02, 5.0), st.floats(0.02, 5.0))
def test_another_inertia_moves_no_estimate(before, after):
    assume(abs(before - after) > 1e-3)
    each = observer(inertia=before)
    each.send(3.0)
    each.take_over(0.1, 0.4)
    each.retune(ObserverFigures(after, 200.0, PERIOD))
    each.send(3.0)
    assert each.update(0.1 + 0.4 * PERIOD, None, PERIOD) == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"bandwidth": 0.0}, "bandwidth must be positive"),
        ({"inertia": math.nan}, "inertia must be positive"),
        ({"innovation_scale": -1.0}, "innovation_scale must be positive"),
        ({"degree": 0.6}, r"degree must lie in \[-0.33, 0.5\], not 0.6"),
    ],
)
def test_figures_out_of_range_are_refused(changes, said):
    with pytest.raises(SettingError, match=said):
        observer(**changes)

"""Levant's differentiator: finite time, exactness, the orders of its errors."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control.velocity import FilteredVelocity, HomogeneousDifferentiator

BOUND = 10.0  # [rad/s^2]


def estimates(source, positions, period):
    return np.array(
        [source.update(x, None, period if k else 0.0) for k, x in enumerate(positions)]
    )


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
    late = estimates(HomogeneousDifferentiator(BOUND), positions, period)[count // 2 :]
    assert np.abs(late - velocity).max() <= 1e-11 * (1.0 + abs(offset)) / period


def test_convergence_takes_a_time_that_is_linear_in_the_velocity_error():
    period, times = 1e-4, []
    for velocity in (0.5, 1.0, 2.0, 4.0):
        found = estimates(
            HomogeneousDifferentiator(BOUND), velocity * period * np.arange(20000), period
        )
        times.append(period * np.flatnonzero(np.abs(found - velocity) > 1e-8).max())
    assert np.all(np.diff(times) > 0.0)
    assert times[-1] / times[0] == pytest.approx(8.0, rel=0.05)


def test_error_falls_with_the_period():
    worst = {}
    for period in (8e-3, 4e-3, 2e-3, 1e-3):
        t, positions, velocities = sine(period)
        found = estimates(HomogeneousDifferentiator(BOUND), positions, period)
        worst[period] = np.abs(found - velocities)[t > 2.0].max()
        assert worst[period] <= BOUND * period
    orders = np.diff(np.log(list(worst.values()))) / np.log(0.5)
    assert orders == pytest.approx(1.0, abs=0.1)


def test_error_grows_with_the_root_of_the_noise():
    random = np.random.default_rng(1)
    period, worst = 1e-4, []
    t, positions, velocities = sine(period)
    noises = (1e-5, 1e-4, 1e-3)
    for noise in noises:
        disturbed = positions + noise * random.uniform(-1.0, 1.0, t.size)
        found = estimates(HomogeneousDifferentiator(BOUND), disturbed, period)
        worst.append(np.abs(found - velocities)[t > 2.0].max())
        assert worst[-1] <= 5.0 * math.sqrt(BOUND * noise)
    orders = np.diff(np.log(worst)) / np.diff(np.log(noises))
    assert orders == pytest.approx(0.5, abs=0.2)


def test_it_does_not_chatter_on_a_track_without_noise():
    _, positions, _ = sine(1e-3)
    found = estimates(HomogeneousDifferentiator(BOUND), positions, 1e-3)[2000:]
    assert np.abs(np.diff(found)).max() <= BOUND * 1e-3


def test_it_lags_less_than_a_filter_that_lets_as_much_of_an_encoder_through():
    period, step = 1e-3, 2.0 * math.pi / 4096
    t, positions, velocities = sine(period)
    counted = step * np.round(positions / step)
    late = t > 2.0
    exact = estimates(HomogeneousDifferentiator(BOUND), counted, period)
    filtered = estimates(FilteredVelocity(0.05), counted, period)
    error, filter_error = (np.abs(x - velocities)[late] for x in (exact, filtered))
    assert error.mean() < 0.5 * filter_error.mean()


def test_a_repeated_instant_changes_nothing_and_reset_forgets():
    source = HomogeneousDifferentiator(BOUND)
    first = estimates(source, np.linspace(0.0, 1.0, 50), 0.01)
    assert source.update(7.0, 3.0, 0.0) == first[-1]
    source.reset()
    assert source.update(5.0, None, 0.01) == 0.0
    source.reset()
    assert np.array_equal(estimates(source, np.linspace(0.0, 1.0, 50), 0.01), first)


@pytest.mark.parametrize("bound", [0.0, -1.0, float("nan"), float("inf")])
def test_an_impossible_bound_is_refused(bound):
    with pytest.raises(SettingError, match="acceleration bound must be positive"):
        HomogeneousDifferentiator(bound)

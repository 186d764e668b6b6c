"""The filter behind which a driver reports velocities is found, and simulated."""

import random

import numpy as np
import pytest
from harness.joints import PERIOD, sines
from scipy.signal import butter, lfilter

from hpid_bench.tuning.driver_velocity import driver_velocity
from hpid_ros.simulation.world import VelocityReport

TIME = np.arange(0.0, 8.0, PERIOD)
TRUE = sines(8.0)
KEPT = np.exp(-PERIOD / 6e-3)
FILTERS = {
    "differences": ([1.0], [1.0], 0.0),
    "low pass": ([1.0 - KEPT], [1.0, -KEPT], KEPT / (1.0 - KEPT)),
    "two poles": ([(1.0 - KEPT) ** 2], [1.0, -2.0 * KEPT, KEPT**2], 2.0 * KEPT / (1.0 - KEPT)),
    "mean": ([0.125] * 8, [1.0], 3.5),
    "Butterworth": (
        *butter(2, 25.0, fs=1.0 / PERIOD),
        np.sqrt(2.0) / (2.0 * np.pi * 25.0 * PERIOD),
    ),
    "late": ([0.0, 0.0, 1.0 - KEPT], [1.0, -KEPT], 2.0 + KEPT / (1.0 - KEPT)),
}


def measured(noise=2e-5, count=0.0, seed=1):
    position = TRUE + noise * np.random.default_rng(seed).standard_normal(len(TIME))
    return np.round(position / count) * count if count else position


def rate(position):
    return np.diff(position, prepend=position[0]) / PERIOD


@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize(("noise", "count"), [(2e-5, 1e-4), (1e-4, 0.0), (0.0, 1.5e-3)])
def test_a_filter_of_differences_is_found_and_gives_the_same_velocities(kind, noise, count):
    forward, back, samples = FILTERS[kind]
    position = measured(noise, count)
    velocity = lfilter(forward, back, rate(position))
    found = driver_velocity(TIME, position, velocity, np.hypot(noise, count / np.sqrt(12.0)))
    assert found.filter.noise is None
    assert found.lag / PERIOD == pytest.approx(samples, rel=0.1, abs=0.3)
    report = VelocityReport(found.filter, float(position[0]), random.Random(1))
    again = [report.update(at, at, PERIOD) for at in position]
    assert np.std(again - velocity) < 0.1 * np.std(velocity)


@pytest.mark.parametrize("own_noise", [2e-3, 2e-2])
def test_noise_of_a_sensor_of_its_own_is_not_that_of_the_positions(own_noise):
    chance = np.random.default_rng(2)
    velocity = lfilter([1.0 - KEPT], [1.0, -KEPT], rate(TRUE))
    velocity = velocity + own_noise * chance.standard_normal(len(TIME))
    found = driver_velocity(TIME, measured(1e-4), velocity, 1e-4)
    assert found.filter.noise == pytest.approx(own_noise, rel=0.1)
    assert found.lag / PERIOD == pytest.approx(KEPT / (1.0 - KEPT), rel=0.2)


def test_velocities_in_another_unit_are_taken_as_they_are():
    position = measured()
    found = driver_velocity(TIME, position, 9.549 * rate(position), 2e-5)
    assert sum(found.filter.forward) == pytest.approx(9.549, rel=1e-2)
    assert "times 9.55" in found.words


def test_velocities_that_are_zero_throughout_and_those_of_another_motion_are_told():
    position, none = measured(), np.zeros(len(TIME))
    assert driver_velocity(TIME, position, none, 2e-5).filter.forward == (0.0,)
    assert driver_velocity(TIME[:20], position[:20], rate(position)[:20], 2e-5) is None
    noise = np.random.default_rng(4).standard_normal(len(TIME))
    assert driver_velocity(TIME, position, noise, 2e-5) is None

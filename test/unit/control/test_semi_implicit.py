"""The law for slow sampling: backward Euler, accuracy and stability where Euler has neither."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import GainError, NormError
from hpid_ros.control import Gains, HomogeneousPid, WeightedNorm
from hpid_ros.control.homogeneous_pid import SemiImplicitHomogeneousPid

GAINS = Gains(p=300.0, i=1000.0, d=30.0)  # three poles at -10 rad/s on a unit inertia
VALUES = st.floats(-2.0, 2.0).filter(lambda x: x == 0.0 or abs(x) > 1e-9)


def loop(law, period, duration=1.0, inertia=1.0, disturbance=20.0):
    """Return times and errors of a sampled loop, its effort held between the samples."""
    error, rate, errors = 1.0, 0.0, []
    for _ in range(round(duration / period)):
        errors.append(error)
        acceleration = (disturbance - law.update(error, rate, period)) / inertia
        error += period * rate + 0.5 * period**2 * acceleration
        rate += period * acceleration
        if abs(error) > 1e6:
            break
    return period * np.arange(len(errors)), np.array(errors)


def norm_of(degree):
    return WeightedNorm(degree, 1.0, 0.1)


def semi_implicit(degree, gains=GAINS, inertia=1.0):
    return SemiImplicitHomogeneousPid(gains, norm_of(degree), 1e-4, inertia=inertia)


@given(VALUES, VALUES, st.floats(1e-4, 0.1), st.floats(0.1, 10.0))
def test_at_degree_zero_it_is_the_pid_by_backward_euler(error, rate, period, inertia):
    law = semi_implicit(0.0, inertia=inertia)
    law.restore_integral(0.7)
    effort = law.update(error, rate, period)
    # e+ = e + T de+ and de+ = de - T (p e+ + d de+) / m, the integral left to the disturbance.
    step = [[1.0, -period], [period * GAINS.p / inertia, 1.0 + period * GAINS.d / inertia]]
    after = np.linalg.solve(step, [error, rate])
    assert effort == pytest.approx(GAINS.p * after[0] + GAINS.d * after[1] + 0.7, abs=1e-9)
    assert law.integral == pytest.approx(0.7 + period * GAINS.i * after[0], abs=1e-9)


@given(st.floats(-0.4, 0.4), VALUES, VALUES)
def test_it_is_the_law_itself_for_fast_sampling(degree, error, rate):
    explicit = HomogeneousPid(GAINS, norm_of(degree), 1e-2)
    expected = explicit.update(error, rate, 1e-9)
    law = SemiImplicitHomogeneousPid(GAINS, norm_of(degree), 1e-2, inertia=1.0)
    assert law.update(error, rate, 1e-9) == pytest.approx(expected, rel=1e-3, abs=1e-3)
    assert law.integral == pytest.approx(explicit.integral, rel=1e-3, abs=1e-9)
    assert sum(law.terms) == pytest.approx(law.update(error, rate, 0.0), rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("degree", [-0.2, 0.0, 0.2])
@pytest.mark.parametrize("inertia", [1.0, 2.0])
def test_error_is_of_first_order_in_the_period(degree, inertia):
    gains = Gains(*(inertia * gain for gain in (GAINS.p, GAINS.i, GAINS.d)))
    times, truth = loop(HomogeneousPid(gains, norm_of(degree), 1e-4), 2e-5, inertia=inertia)
    worst = []
    for period in (20e-3, 10e-3, 5e-3):
        t, errors = loop(semi_implicit(degree, gains, inertia), period, inertia=inertia)
        worst.append(np.abs(errors - np.interp(t, times, truth)).max())
    assert worst[2] < 0.08
    assert worst[0] / worst[2] > 2.5
    assert worst == sorted(worst, reverse=True)


DAMPED = Gains(p=100.0, i=50.0, d=40.0)


def late_efforts(law, period):
    """Return the last errors and efforts of a long run."""
    efforts = []

    class Recorded:
        def update(self, error, rate, dt):
            efforts.append(law.update(error, rate, dt))
            return efforts[-1]

    _, errors = loop(Recorded(), period, duration=12.0)
    return errors[-20:], np.array(efforts[-20:])


@pytest.mark.parametrize("degree", [0.0, 0.2])
def test_it_settles_where_forward_euler_diverges(degree):
    period = 0.055  # T kd = 2.2
    explicit, _ = late_efforts(HomogeneousPid(DAMPED, norm_of(degree), 1e-4), period)
    implicit, _ = late_efforts(semi_implicit(degree, DAMPED), period)
    assert np.abs(explicit).max() > 1e3
    assert np.abs(implicit).max() < 0.02


@pytest.mark.parametrize(("degree", "period"), [(-0.3, 0.01), (-0.3, 0.02), (-0.2, 0.02)])
def test_it_does_not_chatter_at_rest_where_forward_euler_does(degree, period):
    """Close to the target a negative degree multiplies the gains, and T kd lam is large."""
    _, explicit = late_efforts(HomogeneousPid(DAMPED, norm_of(degree), 1e-4), period)
    errors, implicit = late_efforts(semi_implicit(degree, DAMPED), period)
    assert np.ptp(explicit) > 10.0
    assert np.ptp(implicit) < 0.01 * np.ptp(explicit)
    assert np.abs(errors).max() < 1e-3


def test_an_impossible_inertia_or_floor_is_refused():
    with pytest.raises(GainError, match="inertia must be positive"):
        semi_implicit(0.1, inertia=0.0)
    with pytest.raises(NormError, match="floor"):
        SemiImplicitHomogeneousPid(GAINS, norm_of(0.1), -1.0, inertia=1.0)

"""Hurwitz against the eigenvalues of the linear loop; certified intervals and figures."""

import math

import numpy as np
import pytest
from harness.loops import loop_settings
from hypothesis import assume, given
from hypothesis import strategies as st

from hpid_ros.base.errors import GainError, NormError, SettingError
from hpid_ros.control import CanonicalNorm, Gains, WeightedNorm
from hpid_ros.control.homogeneous_pid import is_hurwitz
from hpid_ros.stability.certificate_search import certified_degree_interval
from hpid_ros.stability.certification import verify_certificate
from hpid_ros.stability.gain_check import (
    _multipliers,
    decay_time,
    integral_ratio,
    sampling_margin,
)

pytestmark = pytest.mark.slow

POSITIVE = st.floats(0.05, 50.0)


@given(POSITIVE, POSITIVE, POSITIVE, POSITIVE)
def test_hurwitz_agrees_with_the_eigenvalues(p, i, d, inertia):
    assume(abs(p * d - inertia * i) > 1e-6 * (p * d))
    matrix = np.array([[0, 1, 0], [-p / inertia, -d / inertia, 1], [-i / inertia, 0, 0]])
    stable = bool(np.linalg.eigvals(matrix).real.max() < 0.0)
    assert is_hurwitz(Gains(p, i, d), inertia) == stable


@pytest.mark.parametrize(
    ("gains", "stable"),
    [((1.0, 0.0, 1.0), True), ((1.0, 0.0, 0.0), False), ((0.0, 0.0, 1.0), False)],
)
def test_without_integral_action_a_loop_needs_both_other_terms(gains, stable):
    assert is_hurwitz(Gains(*gains)) == stable


def weighted(degree):
    return WeightedNorm(degree, 1.0, 1.0)


@pytest.mark.parametrize(
    ("gains", "inertia", "words"),
    [
        ((5.0, 11.0, 2.0), 1.0, "p d = 10 must exceed i x inertia = 11"),
        ((5.0, 11.0, 2.0), (0.5, 1.0), "p d = 10 must exceed i x inertia = 11"),
        *(((5.0, 1.0, 2.0), each, "inertia") for each in (0.0, -1.0, math.nan, math.inf)),
        *(((5.0, 1.0, 2.0), each, "inertia") for each in ((0.0, 1.0), (2.0, 1.0))),
        ((5.0, 0.0, 2.0), 1.0, "integral action"),
    ],
)
def test_loops_that_nothing_can_certify_are_refused(gains, inertia, words):
    with pytest.raises(GainError, match=words):
        certified_degree_interval(Gains(*gains), weighted, inertia)
    with pytest.raises(SettingError, match="tolerance"):
        certified_degree_interval(Gains(5.0, 1.0, 2.0), weighted, tolerance=0.0)


@pytest.mark.parametrize(
    ("gains", "rate_weight", "lower", "upper"),
    [
        ((100.0, 100.0, 20.0), 0.1, (-0.5, -0.49), (0.49, 0.5)),  # stiff: almost everywhere
        ((5.0, 9.0, 2.0), 3.0, (-0.187, -0.05), (0.092, 0.5)),  # near Routh's limit
    ],
)
def test_gains_are_certified_as_far_as_known_and_no_further(gains, rate_weight, lower, upper):
    interval = certified_degree_interval(
        Gains(*gains), lambda degree: WeightedNorm(degree, 1.0, rate_weight)
    )
    assert lower[0] < interval.lower <= lower[1]
    assert upper[0] <= interval.upper < upper[1]
    assert [interval.contains(each) for each in (lower[0], 0.0, upper[1])] == [False, True, False]
    assert min(verify_certificate(interval.certificate)) > 0.0


def test_a_range_of_inertia_is_certified_at_its_ends_and_middle():
    def norm_of_degree(degree):
        return CanonicalNorm(degree, ((1.0, 0.1), (0.1, 0.3)))

    gains = Gains(10.0, 10.0, 5.0)
    both = certified_degree_interval(gains, norm_of_degree, (1.0, 3.0), 0.05)
    assert both.certificate.inertias == (1.0, 2.0, 3.0)
    each = [certified_degree_interval(gains, norm_of_degree, m, 0.05) for m in (1.0, 2.0, 3.0)]
    assert both.lower == max(one.lower for one in each) < -0.04
    assert both.upper == min(one.upper for one in each) > 0.04


def test_an_interval_ends_where_the_norm_does():
    """This P is monotone for the dilation of degrees below 1/3 alone."""
    shape = ((1.0, 0.97), (0.97, 1.0))
    with pytest.raises(NormError):
        CanonicalNorm(0.4, shape)
    interval = certified_degree_interval(
        Gains(30.0, 10.0, 10.0), lambda degree: CanonicalNorm(degree, shape), tolerance=0.02
    )
    assert 0.0 <= interval.upper < 0.4


def test_figures_of_a_loop():
    assert integral_ratio(Gains(5.0, 20.0, 2.0), inertia=0.5) == 1.0
    assert integral_ratio(Gains(5.0, 0.0, 2.0)) == 0.0
    assert integral_ratio(Gains(5.0, 1.0, 0.0)) == math.inf
    assert sampling_margin(Gains(1.0, 1.0, 20.0), 0.001, 5.0, inertia=0.5) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("mu", "norm", "multipliers"),
    [
        (-0.2, {"norm__floor": 0.1}, (2.0**-0.2, 0.1**-0.2)),
        (0.2, {"norm__floor": 0.1, "norm__cap": 1.5}, (0.1**0.2, 1.5**0.2)),
        (-0.2, {"norm__floor": 0.0}, (2.0**-0.2, math.inf)),
        (0.0, {"norm__floor": 0.0}, (1.0, 1.0)),
    ],
)
def test_multipliers_reach_from_the_floor_to_the_cap_or_norm_two(mu, norm, multipliers):
    assert _multipliers(loop_settings(mu=mu, **norm)) == multipliers


@given(st.floats(-0.49, 0.49), st.floats(0.1, 10.0), st.floats(0.5, 2.0), st.floats(0.01, 0.4))
def test_decay_time_is_the_integral_of_the_decay(degree, decay, start, end):
    values = np.geomspace(end, start, 4001)
    rates = 1.0 / (decay * values ** (1.0 + degree))
    expected = np.sum(0.5 * (rates[1:] + rates[:-1]) * np.diff(values))
    assert decay_time(degree, decay, start, end) == pytest.approx(expected, rel=1e-4)

"""Hurwitz against the eigenvalues of the linear loop; certified intervals and figures."""

import math

import numpy as np
import pytest
from harness.loops import loop_settings
from hypothesis import assume, given
from hypothesis import strategies as st

from hpid_ros.base.errors import GainError, NormError, SettingError
from hpid_ros.control import CanonicalNorm, Gains, LoopSettings, WeightedNorm
from hpid_ros.control.homogeneous_pid import is_hurwitz
from hpid_ros.control.norms import NORMS
from hpid_ros.control.settings import NormSettings
from hpid_ros.stability import gain_check as module
from hpid_ros.stability.certificate_search import certified_degree_interval
from hpid_ros.stability.certification import verify_certificate
from hpid_ros.stability.gain_check import (
    _multipliers,
    certified_degrees,
    decay_time,
    integral_ratio,
    kind_of,
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
    assert min(verify_certificate(interval)) > 0.0


def test_a_range_of_inertia_is_certified_at_its_ends_and_middle():
    def of(inertia):
        gains = Gains(5.0, 9.0, 2.0)  # near Routh's limit, which the inertia moves
        return certified_degree_interval(
            gains, lambda degree: WeightedNorm(degree, 1.0, 3.0), inertia, 0.05
        )

    both, least, largest = of((0.8, 1.0)), of(0.8), of(1.0)
    assert both.inertias == (0.8, 0.9, 1.0)
    assert least.lower < both.lower == largest.lower < -0.04
    assert least.upper > both.upper == largest.upper > 0.04


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


NEAR_THE_LIMIT = Gains(5.0, 9.0, 2.0)


def loop(inertia=1.0, rate=1.0, scale=1.0, **norm):
    """Return the loop of NEAR_THE_LIMIT in other units of effort, time and error."""
    p, i, d = NEAR_THE_LIMIT.p, NEAR_THE_LIMIT.i, NEAR_THE_LIMIT.d
    gains = Gains(inertia * rate**2 * p, inertia * rate**3 * i, inertia * rate * d)
    norm = NormSettings(**{"error_scale": scale, "rate_weight": 3.0 / (scale * rate), **norm})
    return LoopSettings("j", gains, mu=0.05, norm=norm), (inertia, inertia)


@pytest.mark.parametrize("norm_type", NORMS)
def test_loops_that_differ_by_their_units_are_of_one_kind(norm_type):
    kinds = {
        kind_of(*loop(inertia, rate, scale, type=norm_type))
        for inertia in (0.007, 1.0, 3.0)
        for rate in (0.3, 1.0, 17.0)
        for scale in (0.05, 1.0)
    }
    assert len(kinds) == 1
    assert kind_of(*loop(rate_weight=3.1)) not in kinds


def test_a_kind_is_computed_once_and_certifies_each_of_its_loops(monkeypatch):
    computed, told = [], []
    interval = module._interval
    monkeypatch.setattr(module, "_interval", lambda kind: computed.append(kind) or interval(kind))
    loops = [loop(), loop(0.007, 17.0, 0.05)]
    found = certified_degrees(loops, told.append)
    assert len(computed) == 1
    assert told == [["j", "j"]]
    assert len({(each.lower, each.upper) for each in found}) == 1
    for (settings, inertia), each in zip(loops, found, strict=True):
        assert each.gains == settings.gains
        assert each.inertias == inertia[:1]
        assert each.spans[0].norms[-1].degree == each.spans[1].lower
        assert verify_certificate(each).rate > 0.0
    alone = certified_degree_interval(NEAR_THE_LIMIT, loops[0][0].norm_family, 1.0)
    assert found[0].lower == pytest.approx(alone.lower, abs=4e-3)
    assert found[0].upper == pytest.approx(alone.upper, abs=4e-3)


def test_a_range_of_inertia_comes_back_in_its_units():
    settings, _ = loop(0.1, 5.0, 0.2, rate_weight=0.5)
    (found,) = certified_degrees([(settings, (0.02, 0.1))])
    assert found.inertias == (0.02, pytest.approx(0.06), 0.1)
    verify_certificate(found)


def test_loops_without_an_interval_say_why_and_the_others_go_on():
    unstable = LoopSettings("u", Gains(1.0, 9.0, 1.0))
    without = LoopSettings("w", Gains(1.0, 0.0, 1.0))
    good = LoopSettings("g", Gains(100.0, 100.0, 20.0))
    found = certified_degrees([(each, (1.0, 1.0)) for each in (unstable, without, good)])
    assert [isinstance(each, GainError) for each in found] == [True, True, False]
    assert "must exceed" in str(found[0])
    assert "integral action" in str(found[1])

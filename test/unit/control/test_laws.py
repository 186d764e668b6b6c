"""The linear and the homogeneous PID."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import GainError, NormError
from hpid_ros.control import CanonicalNorm, Gains, HomogeneousPid, Pid, WeightedNorm
from hpid_ros.control.norms import NormFamily

DEGREES = st.floats(-0.49, 0.49)
SIGNALS = st.lists(
    st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(1e-4, 0.1)), max_size=30
)
GAINS = st.builds(Gains, *[st.floats(0.0, 100.0)] * 3)
POINTS = st.tuples(st.floats(0.01, 10.0), st.floats(-10.0, -0.01))


def test_a_norm_that_nobody_has_written_is_no_other_one():
    with pytest.raises(NormError, match="no norm of type 'taxicab'"):
        NormFamily("taxicab", 1.0, 1.0)(0.1)


def test_reference_value_of_the_law():
    law = HomogeneousPid(gains=Gains(12.0, 5.0, 7.0), norm=WeightedNorm(0.2, 1.0, 1.0))
    law.restore_integral(0.25)
    assert law.update(0.5, -0.3, 0.001) == pytest.approx(3.545795166, abs=5e-10)


@given(GAINS, SIGNALS, st.sampled_from(["weighted", "canonical"]), st.floats(0.0, 1.0))
def test_degree_zero_is_the_pid_to_the_bit(gains, signal, kind, floor):
    norm = (
        WeightedNorm(0.0, 0.7, 0.3)
        if kind == "weighted"
        else CanonicalNorm(0.0, [[2.0, 0.5], [0.5, 1.0]])
    )
    pid, hpid = Pid(gains), HomogeneousPid(gains, norm, norm_floor=floor)
    for error, rate, dt in signal:
        assert hpid.update(error, rate, dt) == pid.update(error, rate, dt)
        assert hpid.integral == pid.integral
        assert hpid.terms == pid.terms


@given(GAINS, DEGREES, POINTS, st.floats(-3.0, 3.0), st.floats(-5.0, 5.0))
def test_law_is_homogeneous_under_dilation(gains, degree, point, s, integral):
    """u(d(s) x) = e^{(1+mu)s} u(x), and the integrand scales with 1 + 2 mu."""
    law = HomogeneousPid(gains, WeightedNorm(degree, 1.3, 0.4))
    error, rate = point

    def sample(e, r, i):
        law.restore_integral(i)
        return law.update(e, r, 1.0), law.integral - i

    effort, increment = sample(error, rate, integral)
    factor = math.exp((1.0 + degree) * s)
    dilated, dilated_increment = sample(
        error * math.exp((1.0 - degree) * s), rate * math.exp(s), integral * factor
    )
    size = sum(abs(term) for term in law.terms) + 1e-9
    assert dilated == pytest.approx(effort * factor, abs=1e-10 * size)
    assert dilated_increment == pytest.approx(
        increment * math.exp((1.0 + 2.0 * degree) * s), abs=1e-9 * (size + abs(dilated_increment))
    )


@given(GAINS, DEGREES, POINTS, st.floats(0.1, 10.0))
def test_hpid_is_the_pid_with_its_bandwidth_multiplied(gains, degree, point, inertia):
    """kp -> lam^2 kp, kd -> lam kd, ki -> lam^3 ki at the multiplier lam of the point."""
    law = HomogeneousPid(gains, WeightedNorm(degree, 1.0, 0.2))
    lam = law.multiplier(*point)
    scaled = Pid(Gains(gains.p * lam**2, gains.i * lam**3, gains.d * lam))
    assert law.update(*point, 0.01) == pytest.approx(scaled.update(*point, 0.01), rel=1e-12)
    assert law.integral == pytest.approx(scaled.integral, rel=1e-12)


@given(SIGNALS)
def test_effort_uses_the_integral_before_the_increment(signal):
    law, integral = Pid(Gains(1.0, 2.0, 3.0)), 0.0
    for error, rate, dt in signal:
        assert law.update(error, rate, dt) == 1.0 * error + 3.0 * rate + integral
        integral += dt * (2.0 * error)
        assert law.integral == integral


@pytest.mark.parametrize("degree", [-0.49, 0.49])
def test_at_the_origin_the_unfloored_law_is_at_rest(degree):
    law = HomogeneousPid(Gains(10.0, 10.0, 10.0), WeightedNorm(degree, 1.0, 1.0))
    law.restore_integral(0.5)
    assert law.update(0.0, 0.0, 0.1) == 0.5
    assert law.integral == 0.5
    tiny = law.update(1e-300, 0.0, 0.1)
    assert math.isfinite(tiny)


@given(st.floats(0.0, 0.1), st.floats(-1e-3, 1e-3))
def test_floor_and_cap_bound_the_multiplier(error, rate):
    norm = WeightedNorm(-0.4, 1.0, 1.0)
    law = HomogeneousPid(Gains(1.0, 0.0, 1.0), norm, norm_floor=0.01, norm_cap=0.05)
    assert 0.05**-0.4 <= law.multiplier(error, rate) <= 0.01**-0.4


class OwnNorm(WeightedNorm):
    """The weighted norm as somebody else's: the law has to call it."""


@given(GAINS, DEGREES, SIGNALS, st.floats(0.0, 0.5), st.floats(0.6, 5.0))
def test_written_out_norm_is_the_called_one_to_the_bit(gains, degree, signal, floor, cap):
    law, other = (
        HomogeneousPid(gains, kind(degree, 1.3, 0.4), floor, cap)
        for kind in (WeightedNorm, OwnNorm)
    )
    for error, rate, dt in signal:
        multiplier = other.multiplier(error, rate)
        assert law.update(error, rate, dt) == other.update(error, rate, dt)
        assert law.terms == other.terms
        assert law.terms.p == gains.p * (multiplier * multiplier) * error
        assert law.integral == other.integral


def test_integral_is_read_only_and_reset_forgets_it():
    law = HomogeneousPid(Gains(1.0, 1.0, 1.0), WeightedNorm(0.1, 1.0, 1.0))
    law.update(1.0, 0.0, 1.0)
    with pytest.raises(AttributeError):
        law.integral = 3.0
    assert law.integral > 0.0
    law.reset()
    assert law.integral == 0.0
    assert law.terms == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_bad_gains_are_refused_by_name(bad, place):
    values = [1.0, 1.0, 1.0]
    values[place] = bad
    with pytest.raises(GainError, match=f"gain {'pid'[place]} must be finite"):
        Gains(*values)


@pytest.mark.parametrize("bounds", [(-0.1, 1.0), (1.0, 1.0), (math.nan, 1.0)])
def test_a_floor_above_the_cap_is_refused(bounds):
    with pytest.raises(NormError, match="floor"):
        HomogeneousPid(Gains(1.0, 1.0, 1.0), WeightedNorm(0.1, 1.0, 1.0), *bounds)

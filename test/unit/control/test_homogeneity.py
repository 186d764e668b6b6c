"""The norms: reference values, homogeneity, positive definiteness, an independent root finder."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from hpid_ros.base.errors import NormError
from hpid_ros.control import CanonicalNorm, WeightedNorm
from hpid_ros.control.norms import norm_floor

DEGREES = st.floats(-0.49, 0.49)
SIGNS = st.sampled_from([-1.0, 1.0])
MAGNITUDES = st.floats(-12.0, 6.0).map(lambda power: 10.0**power)
COORDINATES = st.builds(lambda sign, magnitude: sign * magnitude, SIGNS, MAGNITUDES)


@st.composite
def canonical_norms(draw):
    degree = draw(DEGREES)
    p11, p22 = (10.0 ** draw(st.floats(-2.0, 2.0)) for _ in range(2))
    bound = math.sqrt(min(1.0, 4.0 * (1.0 - degree) / (2.0 - degree) ** 2) * p11 * p22)
    p12 = draw(st.floats(-0.95, 0.95)) * bound
    return CanonicalNorm(degree, [[p11, p12], [p12, p22]])


def weighted_norms():
    weights = st.floats(-2.0, 2.0).map(lambda power: 10.0**power)
    return st.builds(WeightedNorm, DEGREES, weights, weights)


NORMS = st.one_of(weighted_norms(), canonical_norms())


@pytest.mark.parametrize(
    ("norm", "expected"),
    [
        (WeightedNorm(0.2, 1.0, 1.0), 0.7204482076),
        (WeightedNorm(-0.3, 1.0, 1.0), 0.8867302300),
        (CanonicalNorm(0.2, [[1.0, 0.0], [0.0, 1.0]]), 0.5333060875),
        (CanonicalNorm(0.2, [[2.0, 0.5], [0.5, 1.0]]), 0.6022180186),
    ],
)
def test_reference_values_to_ten_digits(norm, expected):
    assert norm(0.5, -0.3) == pytest.approx(expected, abs=5e-11)


@given(NORMS, COORDINATES, COORDINATES, st.floats(-5.0, 5.0))
def test_norm_is_homogeneous_under_dilation(norm, error, rate, s):
    dilated = norm(error * math.exp((1.0 - norm.degree) * s), rate * math.exp(s))
    assert dilated == pytest.approx(math.exp(s) * norm(error, rate), rel=1e-11)


@given(NORMS, COORDINATES, COORDINATES)
def test_norm_is_positive_and_even(norm, error, rate):
    assert norm(error, rate) > 0.0
    assert norm(-error, -rate) == norm(error, rate)
    assert norm(0.0, 0.0) == 0.0


@given(canonical_norms(), COORDINATES, COORDINATES)
def test_canonical_norm_agrees_with_an_independent_root_finder(norm, error, rate):
    (p11, p12), (_, p22) = norm.shape

    def outside(s):
        y1, y2 = error * math.exp(-(1.0 - norm.degree) * s), rate * math.exp(-s)
        return math.log(p11 * y1 * y1 + 2.0 * p12 * y1 * y2 + p22 * y2 * y2)

    root = brentq(outside, -120.0, 120.0, xtol=1e-14, rtol=1e-15, maxiter=500)
    assert norm(error, rate) == pytest.approx(math.exp(root), rel=1e-12)


@given(canonical_norms(), st.sampled_from([1e-155, 1e150]))
def test_canonical_norm_survives_where_squares_do_not(norm, value):
    assert 0.0 < norm(value, 0.0) < math.inf
    assert 0.0 < norm(0.0, value) < math.inf


@given(DEGREES, st.floats(0.01, 10.0))
def test_an_error_of_the_scale_at_rest_has_norm_one(degree, scale):
    assert WeightedNorm.scaled(degree, scale, 0.1)(scale, 0.0) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WeightedNorm(0.5, 1.0, 1.0), r"\(-0.5, 0.5\), not 0.5"),
        (lambda: WeightedNorm(math.nan, 1.0, 1.0), "not nan"),
        (lambda: WeightedNorm(0.1, 0.0, 1.0), "error_weight must be positive and finite, not 0"),
        (lambda: WeightedNorm(0.1, 1.0, math.inf), "rate_weight must be positive and finite"),
        (lambda: WeightedNorm.scaled(0.1, -1.0, 1.0), "error_scale must be positive"),
        (lambda: CanonicalNorm(0.1, [[1.0, 0.2], [0.3, 1.0]]), "must be symmetric"),
        (lambda: CanonicalNorm(0.1, [[1.0, 2.0], [2.0, 1.0]]), "must be positive definite"),
        (lambda: CanonicalNorm(0.1, [[1.0, 0.0]]), "2x2 matrix"),
        (lambda: CanonicalNorm(0.1, [[1.0, math.nan], [math.nan, 1.0]]), "must be finite"),
        (lambda: CanonicalNorm(0.49, [[1.0, 0.96], [0.96, 1.0]]), "not monotone"),
    ],
)
def test_bad_norms_are_refused_in_one_line(make, message):
    with pytest.raises(NormError, match=message) as refusal:
        make()
    assert "\n" not in str(refusal.value)


def test_floor_covers_what_encoder_and_sampling_feign():
    step, period, tau = 2.0 * math.pi / 4096, 0.001, 0.005
    norm = WeightedNorm(-0.3, 1.0, 0.1)
    sensor = norm(2.0 * step, 2.0 * step / (tau + period))
    common = {"period": period, "resolution": step, "filter_time_constant": tau}
    assert norm_floor(norm, derivative_gain=20.0, **common) == pytest.approx(sensor)
    sampled = norm_floor(norm, derivative_gain=200.0, **common)
    assert period * 200.0 * sampled**-0.3 == pytest.approx(0.25)
    assert norm_floor(norm, period=period, derivative_gain=0.0) == 1e-6


@given(
    st.floats(-0.49, 0.49),
    st.floats(-320.0, -150.0),
    st.floats(-320.0, -150.0),
    st.sampled_from([1.0, -1.0]),
)
def test_the_canonical_norm_has_a_value_down_to_the_smallest_numbers(degree, e, de, sign):
    """Squares and reciprocals of such numbers have none."""
    norm = CanonicalNorm(degree, ((2.0, 0.1), (0.1, 1.0)))
    tiny = norm(10.0**e, sign * 10.0**de)
    # The same point brought up by the dilation, of about 1e150 times the norm.
    raised = norm(10.0 ** (e + 150.0 * (1.0 - degree)), sign * 10.0 ** (de + 150.0))
    assert tiny >= 0.0
    if 10.0**e > 1e-307 and 10.0**de > 1e-307 and tiny > 1e-300:  # all digits are there
        assert tiny == pytest.approx(raised * 1e-150, rel=1e-9)


def test_the_smallest_rate_is_no_overflow():
    assert CanonicalNorm(0.0, ((2.0, 0.5), (0.5, 1.0)))(0.0, 2.2250738585e-313) > 0.0

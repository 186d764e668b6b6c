"""Norms and laws: reference values, homogeneity, degree zero, and the step for slow sampling."""

import json
import math
from typing import get_args

import numpy as np
import pytest
from harness.loops import loop_settings
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from hpid_ros.base.errors import GainError, NormError
from hpid_ros.control import CanonicalNorm, Gains, HomogeneousPid, Pid, WeightedNorm
from hpid_ros.control.assembly import make_law
from hpid_ros.control.homogeneous_pid import SemiImplicitHomogeneousPid
from hpid_ros.control.laws import LAWS, LawName
from hpid_ros.control.norms import NORMS, NormFamily, norm_from_mapping, sampling_floor

DEGREES = st.floats(-0.49, 0.49)
COORDINATES = st.builds(
    lambda sign, power: sign * 10.0**power, st.sampled_from([-1.0, 1.0]), st.floats(-12.0, 6.0)
)
WEIGHTS = st.floats(-2.0, 2.0).map(lambda power: 10.0**power)
SIGNALS = st.lists(
    st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(1e-4, 0.1)), max_size=30
)
GAINS = st.builds(Gains, *[st.floats(0.0, 100.0)] * 3)
POINTS = st.tuples(st.floats(0.01, 10.0), st.floats(-10.0, -0.01))
UNIT, SKEW = [[1.0, 0.0], [0.0, 1.0]], [[2.0, 0.5], [0.5, 1.0]]


@st.composite
def canonical_norms(draw):
    degree, p11, p22 = draw(DEGREES), draw(WEIGHTS), draw(WEIGHTS)
    bound = math.sqrt(min(1.0, 4.0 * (1.0 - degree) / (2.0 - degree) ** 2) * p11 * p22)
    p12 = draw(st.floats(-0.95, 0.95)) * bound
    return CanonicalNorm(degree, [[p11, p12], [p12, p22]])


ANY_NORM = st.builds(WeightedNorm, DEGREES, WEIGHTS, WEIGHTS) | canonical_norms()


@pytest.mark.parametrize(
    ("norm", "expected"),
    [
        (WeightedNorm(0.2, 1.0, 1.0), 0.7204482076),
        (WeightedNorm(-0.3, 1.0, 1.0), 0.8867302300),
        (CanonicalNorm(0.2, UNIT), 0.5333060875),
        (CanonicalNorm(0.2, SKEW), 0.6022180186),
    ],
)
def test_reference_values_of_the_norms_to_ten_digits(norm, expected):
    assert norm(0.5, -0.3) == pytest.approx(expected, abs=5e-11)


@given(ANY_NORM, COORDINATES, COORDINATES, st.floats(-5.0, 5.0))
def test_norm_is_positive_even_and_homogeneous_under_dilation(norm, error, rate, s):
    value = norm(error, rate)
    assert value > 0.0 == norm(0.0, 0.0)
    assert norm(-error, -rate) == value
    dilated = norm(error * math.exp((1.0 - norm.degree) * s), rate * math.exp(s))
    assert dilated == pytest.approx(math.exp(s) * value, rel=1e-11)


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


@given(DEGREES, st.floats(-320.0, -150.0), st.floats(-320.0, -150.0), st.sampled_from([1.0, -1.0]))
def test_canonical_norm_has_a_value_down_to_the_smallest_numbers(degree, e, de, sign):
    """Squares and reciprocals of such numbers have none."""
    norm = CanonicalNorm(degree, ((2.0, 0.1), (0.1, 1.0)))
    tiny = norm(10.0**e, sign * 10.0**de)
    # The same point brought up by the dilation, of about 1e150 times the norm.
    raised = norm(10.0 ** (e + 150.0 * (1.0 - degree)), sign * 10.0 ** (de + 150.0))
    assert tiny >= 0.0
    if 10.0**e > 1e-307 and 10.0**de > 1e-307 and tiny > 1e-300:  # all digits are there
        assert tiny == pytest.approx(raised * 1e-150, rel=1e-9)
    assert CanonicalNorm(0.0, SKEW)(0.0, 2.2250738585e-313) > 0.0  # the smallest rate: no overflow
    assert CanonicalNorm(0.49, SKEW)(5e-324, 0.0) >= 0.0


@given(DEGREES, st.floats(0.01, 10.0))
def test_an_error_of_the_scale_at_rest_has_norm_one(degree, scale):
    assert WeightedNorm.scaled(degree, scale, 0.1)(scale, 0.0) == pytest.approx(1.0, rel=1e-12)


def test_floor_covers_encoder_steps_and_sampling():
    step, period, tau = 2.0 * math.pi / 4096, 0.001, 0.005
    norm = WeightedNorm(-0.3, 1.0, 0.1)
    sensor = norm(2.0 * step, 2.0 * step / (tau + period))
    common = {"period": period, "resolution": step, "filter_time_constant": tau}
    assert sampling_floor(norm, damping_rate=20.0, **common) == pytest.approx(sensor)
    sampled = sampling_floor(norm, damping_rate=200.0, **common)
    assert period * 200.0 * sampled**-0.3 == pytest.approx(0.25)
    assert sampling_floor(norm, period=period, damping_rate=0.0) == 1e-6


@pytest.mark.parametrize("degree", [-0.49, -0.2, -0.01])
@pytest.mark.parametrize("rate", [1.0, 100.0, 240.0])
def test_floor_keeps_the_sampled_gain_within_a_quarter(degree, rate):
    floor = sampling_floor(WeightedNorm(degree, 1.0, 0.1), period=1e-3, damping_rate=rate)
    assert floor == pytest.approx(max(1e-6, (0.25 / (1e-3 * rate)) ** (1.0 / degree)), rel=1e-12)
    assert 1e-3 * rate * floor**degree <= 0.25 * (1.0 + 1e-9)


def test_reference_value_of_the_law():
    law = HomogeneousPid(Gains(12.0, 5.0, 7.0), WeightedNorm(0.2, 1.0, 1.0))
    law.restore_integral(0.25)
    assert law.update(0.5, -0.3, 0.001) == pytest.approx(3.545795166, abs=5e-10)


@given(
    GAINS,
    SIGNALS,
    st.sampled_from([WeightedNorm(0.0, 0.7, 0.3), CanonicalNorm(0.0, SKEW)]),
    st.floats(0.0, 1.0),
)
def test_degree_zero_is_the_pid_to_the_bit(gains, signal, norm, floor):
    """The effort has the integral before the increment."""
    pid, hpid, integral = Pid(gains), HomogeneousPid(gains, norm, norm_floor=floor), 0.0
    for error, rate, dt in signal:
        effort = gains.p * error + gains.d * rate + integral
        assert hpid.update(error, rate, dt) == pid.update(error, rate, dt) == effort
        assert hpid.terms == pid.terms == (gains.p * error, integral, gains.d * rate)
        integral += dt * (gains.i * error)
        assert hpid.integral == pid.integral == integral


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


@given(GAINS, DEGREES, POINTS)
def test_hpid_is_the_pid_with_its_bandwidth_multiplied(gains, degree, point):
    """kp -> lam^2 kp, kd -> lam kd, ki -> lam^3 ki at the multiplier lam of the point."""
    law = HomogeneousPid(gains, WeightedNorm(degree, 1.0, 0.2))
    lam = law.multiplier(*point)
    scaled = Pid(Gains(gains.p * lam**2, gains.i * lam**3, gains.d * lam))
    assert law.update(*point, 0.01) == pytest.approx(scaled.update(*point, 0.01), rel=1e-12)
    assert law.integral == pytest.approx(scaled.integral, rel=1e-12)


@pytest.mark.parametrize("degree", [-0.49, 0.49])
def test_at_the_origin_the_unfloored_law_is_at_rest(degree):
    law = HomogeneousPid(Gains(10.0, 10.0, 10.0), WeightedNorm(degree, 1.0, 1.0))
    law.restore_integral(0.5)
    assert law.update(0.0, 0.0, 0.1) == law.integral == 0.5
    assert math.isfinite(law.update(1e-300, 0.0, 0.1))


@given(st.floats(0.0, 0.1), st.floats(-1e-3, 1e-3))
def test_floor_and_cap_bound_the_multiplier(error, rate):
    law = HomogeneousPid(Gains(1.0, 0.0, 1.0), WeightedNorm(-0.4, 1.0, 1.0), 0.01, 0.05)
    assert 0.05**-0.4 <= law.multiplier(error, rate) <= 0.01**-0.4


class OwnNorm(WeightedNorm):
    """The weighted norm as somebody else's: the law has to call it."""

    def __call__(self, error, error_rate):
        return WeightedNorm.__call__(self, error, error_rate)


class Halved(WeightedNorm):
    def __call__(self, error, error_rate):
        return 0.5 * WeightedNorm.__call__(self, error, error_rate)


def test_a_norm_of_ones_own_is_called_even_if_it_is_derived_from_one_that_is_written_out():
    law = HomogeneousPid(Gains(3.0, 1.0, 2.0), Halved(-0.2, 1.3, 0.4))
    multiplier = (0.5 * WeightedNorm(-0.2, 1.3, 0.4)(0.3, -0.7)) ** -0.2
    assert law.update(0.3, -0.7, 1e-3) == 3.0 * multiplier**2 * 0.3 + 2.0 * multiplier * -0.7


def test_a_norm_that_is_written_out_cannot_change_behind_the_law():
    law = HomogeneousPid(Gains(3.0, 1.0, 2.0), WeightedNorm(-0.2, 1.3, 0.4))
    with pytest.raises(AttributeError):
        law.norm.error_weight = 2.0
    with pytest.raises(AttributeError):
        law.norm = WeightedNorm(-0.2, 2.0, 0.4)


@pytest.mark.parametrize("name", NORMS)
def test_every_norm_by_name_is_homogeneous_in_one_line_of_units(name):
    """What certificates of loops that differ by their units rely on."""
    norm, unit = NORMS[name].scaled(-0.2, 0.3, 0.7), NORMS[name].scaled(-0.2, 1.0, 1.0)
    assert (norm.type, norm(0.3, 0.0)) == (name, pytest.approx(1.0))
    assert norm(0.06, -0.5) == pytest.approx(unit(0.06 / 0.3, -0.5 * 0.7), rel=1e-12)
    saved = json.loads(json.dumps(norm.to_mapping()))
    read = norm_from_mapping(saved)
    assert read(0.06, -0.5) == norm(0.06, -0.5)
    assert type(read) is type(norm)


def test_every_law_by_name_is_made():
    assert set(LAWS) == set(get_args(LawName))
    for name, law in LAWS.items():
        settings = loop_settings(law=name, mu=-0.2)
        assert settings.degree == (-0.2 if law.is_homogeneous else 0.0)
        assert hasattr(make_law(settings), "norm") == law.needs_norm


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
    assert (law.integral, *law.terms) == (0.0, 0.0, 0.0, 0.0)


TRIPLE = Gains(p=300.0, i=1000.0, d=30.0)  # three poles at -10 rad/s on a unit inertia
DAMPED = Gains(p=100.0, i=50.0, d=40.0)
VALUES = st.floats(-2.0, 2.0).filter(lambda x: x == 0.0 or abs(x) > 1e-9)


def sampled(law, period):
    """Return errors and efforts of a sampled loop, its effort held between the samples."""
    error, rate, errors, efforts = 1.0, 0.0, [], []
    for _ in range(round(12.0 / period)):
        errors.append(error)
        efforts.append(law.update(error, rate, period))
        acceleration = 20.0 - efforts[-1]  # of a unit inertia under a load
        error += period * rate + 0.5 * period**2 * acceleration
        rate += period * acceleration
        if abs(error) > 1e6:
            break
    return np.array(errors), np.array(efforts)


def explicit(degree, gains=TRIPLE, floor=1e-4):
    return HomogeneousPid(gains, WeightedNorm(degree, 1.0, 0.1), floor)


def implicit(degree, gains=TRIPLE, floor=1e-4, inertia=1.0, period=0.055):
    norm = WeightedNorm(degree, 1.0, 0.1)
    return SemiImplicitHomogeneousPid(gains, norm, floor, inertia=inertia, period=period)


@given(VALUES, VALUES, st.floats(1e-4, 0.1), st.floats(0.1, 10.0))
def test_at_degree_zero_the_semi_implicit_law_is_the_pid_by_backward_euler(e, de, period, inertia):
    law = implicit(0.0, inertia=inertia, period=period)
    law.restore_integral(0.7)
    effort = law.update(e, de, period)
    # e+ = e + T de+ and de+ = de - T (p e+ + d de+) / m, the integral left to the disturbance.
    step = [[1.0, -period], [period * TRIPLE.p / inertia, 1.0 + period * TRIPLE.d / inertia]]
    after = np.linalg.solve(step, [e, de])
    assert effort == pytest.approx(TRIPLE.p * after[0] + TRIPLE.d * after[1] + 0.7, abs=1e-9)
    assert law.integral == pytest.approx(0.7 + period * TRIPLE.i * after[0], abs=1e-9)


@given(st.floats(-0.4, 0.4), VALUES, VALUES)
def test_the_semi_implicit_law_is_the_law_itself_for_fast_sampling(degree, error, rate):
    law, other = implicit(degree, floor=1e-2, period=1e-9), explicit(degree, floor=1e-2)
    expected = other.update(error, rate, 1e-9)
    assert law.update(error, rate, 1e-9) == pytest.approx(expected, rel=1e-3, abs=1e-3)
    assert law.integral == pytest.approx(other.integral, rel=1e-3, abs=1e-9)
    assert sum(law.terms) == pytest.approx(law.update(error, rate, 0.0), rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("degree", [0.0, 0.2])
def test_the_semi_implicit_law_settles_where_forward_euler_diverges(degree):
    lost, settled = (
        sampled(make(degree, DAMPED), 0.055)[0][-20:] for make in (explicit, implicit)
    )  # T kd = 2.2
    assert np.abs(lost).max() > 1e3
    assert np.abs(settled).max() < 0.02


@pytest.mark.parametrize(("degree", "period"), [(-0.3, 0.01), (-0.3, 0.02), (-0.2, 0.02)])
def test_the_semi_implicit_law_does_not_chatter_at_rest_where_forward_euler_does(degree, period):
    """Close to the target a negative degree multiplies the gains, and T kd lam is large."""
    _, chatters = sampled(explicit(degree, DAMPED), period)
    errors, efforts = sampled(implicit(degree, DAMPED, period=period), period)
    assert np.ptp(chatters[-20:]) > 10.0
    assert np.ptp(efforts[-20:]) < 0.01 * np.ptp(chatters[-20:])
    assert np.abs(errors[-20:]).max() < 1e-3


NORM = WeightedNorm(0.1, 1.0, 1.0)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: WeightedNorm(0.5, 1.0, 1.0), NormError, r"\(-0.5, 0.5\), not 0.5"),
        (lambda: WeightedNorm(math.nan, 1.0, 1.0), NormError, "not nan"),
        (lambda: WeightedNorm(0.1, 0.0, 1.0), NormError, "error_weight .* not 0"),
        (lambda: WeightedNorm(0.1, 1.0, math.inf), NormError, "rate_weight .* finite"),
        (lambda: WeightedNorm.scaled(0.1, -1.0, 1.0), NormError, "error_scale must be positive"),
        (lambda: CanonicalNorm(0.1, [[1.0, 0.2], [0.3, 1.0]]), NormError, "symmetric"),
        (lambda: CanonicalNorm(0.1, [[1.0, 2.0], [2.0, 1.0]]), NormError, "positive definite"),
        (lambda: CanonicalNorm(0.1, [[1.0, 0.0]]), NormError, "2x2 matrix"),
        (lambda: CanonicalNorm(0.1, [[1.0, math.nan]] * 2), NormError, "must be finite"),
        (lambda: CanonicalNorm(0.49, [[1.0, 0.96], [0.96, 1.0]]), NormError, "not monotone"),
        (lambda: NormFamily("taxicab", 1.0, 1.0)(0.1), NormError, "type 'taxicab'"),
        (lambda: HomogeneousPid(TRIPLE, NORM, -0.1, 1.0), NormError, "floor"),
        (lambda: HomogeneousPid(TRIPLE, NORM, 1.0, 1.0), NormError, "floor"),
        (lambda: HomogeneousPid(TRIPLE, NORM, math.nan, 1.0), NormError, "floor"),
        (lambda: implicit(0.1, inertia=0.0), GainError, "inertia must be positive"),
        (lambda: implicit(0.1, floor=-1.0), NormError, "floor"),
        (lambda: Gains(math.nan, 1.0, 1.0), GainError, "gains.p must lie in"),
        (lambda: Gains(1.0, 1.1e6, 1.0), GainError, "gains.i must lie in"),
        (lambda: Gains(1.0, 1.0, -1.0), GainError, "gains.d must lie in"),
    ],
)
def test_bad_norms_and_gains_are_refused_in_one_line(make, error, message):
    with pytest.raises(error, match=message) as refusal:
        make()
    assert "\n" not in str(refusal.value)

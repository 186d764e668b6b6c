"""Certificates: arrays against scalars, the search against the check, lies found out."""

import dataclasses
import json

import numpy as np
import pytest
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

from hpid_ros.base.errors import GainError, NormError, SettingError
from hpid_ros.control import CanonicalNorm, Gains, HomogeneousPid, Norm, WeightedNorm
from hpid_ros.stability.certificate_search import (
    SphereGrid,
    certified_degree_interval,
    certify_degree,
    first_shapes,
    growth_rates,
    least_maximum,
    lyapunov_solution,
    scaled_loop,
    shared_spans,
    time_unit,
    worst_rate,
    worst_rates,
)
from hpid_ros.stability.certification import best_spans, span_margins, verify_certificate
from hpid_ros.stability.closed_loop import (
    FORMAT,
    Certificate,
    CertifiedSpan,
    closed_loop_field,
    dilated,
    state_norm,
    unit_curve,
)
from hpid_ros.stability.gain_check import saved_certificates, settling_time_bound

DEGREES = st.floats(-0.49, 0.49)
WEIGHTS = st.floats(-1.5, 1.5).map(lambda power: 10.0**power)
COORDINATES = st.floats(-1e6, 1e6).filter(lambda x: x == 0.0 or abs(x) > 1e-12)


@st.composite
def norms(draw):
    degree, first, second = draw(DEGREES), draw(WEIGHTS), draw(WEIGHTS)
    if draw(st.booleans()):
        return WeightedNorm(degree, first, second)
    cross = draw(st.floats(-0.9, 0.9)) * np.sqrt(
        first * second * min(1.0, 4.0 * (1.0 - degree) / (2.0 - degree) ** 2)
    )
    return CanonicalNorm(degree, [[first, cross], [cross, second]])


STATES = (
    st.tuples(*[st.floats(-5.0, 5.0).filter(lambda x: x == 0.0 or abs(x) > 1e-9)] * 3)
    .map(np.array)
    .filter(np.any)
)
GAINS = st.builds(
    lambda p, d, log_rho: Gains(p, 10.0**log_rho * p * d, d),
    st.floats(0.5, 50.0),
    st.floats(0.5, 50.0),
    st.floats(-3.0, -0.05),
)


@given(norms(), st.lists(st.tuples(COORDINATES, COORDINATES), min_size=1, max_size=20))
def test_norms_of_arrays_are_those_of_numbers(norm, points):
    errors, rates = np.array(points).T
    expected = [norm(error, rate) for error, rate in points]
    assert norm.values(errors, rates) == pytest.approx(expected, rel=1e-12)


@given(norms())
def test_unit_curve_has_norm_one_on_either_side_of_every_axis(norm):
    curve = unit_curve(norm, 9)
    assert norm.values(*curve.T) == pytest.approx(1.0, rel=1e-12)
    assert len({(error > 0.0, rate > 0.0) for error, rate in curve}) == 4


@given(GAINS, norms(), STATES, st.floats(-3.0, 3.0), st.floats(0.1, 10.0))
def test_closed_loop_is_homogeneous_of_the_degree(gains, norm, state, s, inertia):
    field = closed_loop_field(gains, norm, state, inertia)
    there = closed_loop_field(gains, norm, dilated(norm.degree, state, s), inertia)
    expected = np.exp(norm.degree * s) * dilated(norm.degree, field, s)
    assert there == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


@given(GAINS, norms(), STATES)
def test_closed_loop_is_driven_by_the_law_itself(gains, norm, state):
    error, rate, disturbance = (float(x) for x in state)
    law, inertia, dt = HomogeneousPid(gains, norm), 0.7, 1e-3
    effort = law.update(error, rate, dt)
    expected = [rate, disturbance - effort / inertia, -law.integral / dt / inertia]
    found = closed_loop_field(gains, norm, state, inertia)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)


@given(GAINS, DEGREES, STATES, st.floats(-3.0, 3.0))
def test_state_norm_is_homogeneous_and_one_on_its_sphere(gains, degree, state, s):
    shape = lyapunov_solution(scaled_loop(gains), (1.0, 1.0, 1.0))
    if growth_rates(shape, [degree])[0, 0] <= 0.05:
        return
    on_sphere = dilated(degree, state, -np.log(state_norm(shape, degree, state)))
    assert on_sphere @ shape @ on_sphere == pytest.approx(1.0, rel=1e-9)
    moved = state_norm(shape, degree, dilated(degree, state, s))
    assert moved == pytest.approx(np.exp(s) * state_norm(shape, degree, state), rel=1e-9)


@examples(0.15)
@given(GAINS, norms(), st.floats(-2.0, 2.0), st.floats(0.2, 5.0))
def test_search_and_check_see_the_same_sphere(gains, norm, log_scale, q):
    """The two share nothing but P: other points, other units, another form of the field."""
    unit = time_unit(gains)
    shape = 10.0**log_scale * lyapunov_solution(scaled_loop(gains), (1.0, q, 1.0 / q))
    if growth_rates(shape, [norm.degree])[0, 0] <= 0.05:
        return
    seen = -unit * SphereGrid(gains, norm, 100, 160).rates(shape).max()
    units = np.array([1.0, 1.0 / unit, 1.0 / unit**2])
    physical = tuple(map(tuple, shape * np.outer(units, units)))
    span = CertifiedSpan(inertia=1.0, norms=(norm,), shape=physical, rate=0.0)
    checked = span_margins(gains, span, norm)
    assert checked.monotonicity == pytest.approx(
        growth_rates(shape, [norm.degree])[0, 0], rel=1e-6
    )
    assert checked.rate == pytest.approx(seen, rel=0.03, abs=0.01 * unit)


@pytest.mark.parametrize(
    ("gains", "norm", "cost"),
    [
        (Gains(1.0, 4.0, 8.0), CanonicalNorm(0.25, ((1.0, 0.0), (0.0, 1.0))), (1.0, 1.0, 1.0)),
        (Gains(100.0, 1.0, 20.0), WeightedNorm(0.01, 1.0, 0.1), (1.0, 0.01, 1.0)),
        (Gains(100.0, 1e-3, 20.0), WeightedNorm(0.05, 1.0, 0.1), (1.0, 1e-4, 1e-4)),
    ],
    ids=["thin ellipse", "little integral action", "hardly any"],
)
def test_even_the_coarse_grid_misses_nothing_of_a_thin_sphere(gains, norm, cost):
    """Grids that were even on the norm's curve, or in n, called these P good or better."""
    shape = lyapunov_solution(scaled_loop(gains), cost)
    coarse = SphereGrid(gains, norm, 12, 24).rates(shape).max()
    fine = SphereGrid(gains, norm, 300, 600).rates(shape).max()
    assert coarse == pytest.approx(fine, rel=0.1)


@pytest.fixture(scope="module")
def interval():
    gains = Gains(10.0, 15.0, 5.0)
    return certified_degree_interval(gains, lambda mu: WeightedNorm(mu, 1.0, 0.5), tolerance=0.02)


def test_a_certificate_survives_a_file_and_holds_when_checked_anew(interval):
    read = Certificate.from_mapping(json.loads(json.dumps(interval.to_mapping())))
    assert read.to_mapping() == interval.to_mapping()
    margins = verify_certificate(read)
    assert min(margins) > 0.0
    assert interval.lower < -0.1
    assert interval.upper > 0.1
    assert interval.lower == min(span.lower for span in read.spans)
    assert all(span.upper - span.lower <= 0.0501 for span in read.spans)


def test_a_certificate_holds_between_the_degrees_that_it_names(interval):
    for degree in np.linspace(interval.lower, interval.upper, 23):
        norm = WeightedNorm(float(degree), 1.0, 0.5)
        assert min(each.rate for _, each in best_spans(interval, norm)) > 0.0
    with pytest.raises(GainError, match="reaches from degree"):
        best_spans(interval, WeightedNorm(0.4999, 1.0, 0.5))


def with_first_span(certificate, **changes):
    first, *others = certificate.spans
    return dataclasses.replace(certificate, spans=(dataclasses.replace(first, **changes), *others))


@pytest.mark.parametrize(
    ("first", "cross", "other"),
    [(1.0, 0.0, 0.0), (1.0, 0.1, 0.0), (1.0, 2.0, 2.0), (float("nan"), 0.0, 0.0)],
    ids=["not decreasing", "not symmetric", "not positive", "not a number"],
)
def test_a_certificate_with_another_matrix_is_found_out(interval, first, cross, other):
    shape = ((first, cross, 0.0), (other, 1.0, 0.0), (0.0, 0.0, 1.0))
    with pytest.raises(GainError, match="certificate"):
        verify_certificate(with_first_span(interval, shape=shape))


def test_a_certificate_of_other_gains_or_another_norm_is_found_out(interval):
    norms = tuple(WeightedNorm(n.degree, 1.0, 500.0) for n in interval.spans[0].norms)
    for other, words in (
        (dataclasses.replace(interval, gains=Gains(10.0, 45.0, 5.0)), "does not hold"),
        (dataclasses.replace(interval, gains=Gains(10.0, 60.0, 5.0)), "must exceed"),
        (with_first_span(interval, norms=norms), "does not hold"),
    ):
        with pytest.raises(GainError, match=words):
            verify_certificate(other)


def test_what_is_no_certificate_is_refused(interval):
    whole = interval.to_mapping()
    lacking = [{k: v for k, v in whole.items() if k != key} for key in ("gains", "spans")]
    for mapping in ({}, {"format": "other"}, [], None, *lacking):
        with pytest.raises(SettingError, match=r"format|gains|spans"):
            Certificate.from_mapping(mapping)
    first, _, *others = interval.spans
    with pytest.raises(SettingError, match="follow each other"):  # a hole between them
        dataclasses.replace(interval, spans=(first, *others))


@pytest.mark.parametrize("degree", [-0.2, 0.0, 0.2])
def test_no_simulation_settles_later_than_the_bound(degree):
    gains, norm, start = Gains(3.0, 1.0, 3.0), WeightedNorm(degree, 1.0, 1.0), (1.0, -0.5, 2.0)
    certificate = certify_degree(gains, norm)
    bound = settling_time_bound(certificate, norm, start)

    def field(_, x):
        return closed_loop_field(gains, norm, x)

    solution = solve_ivp(field, (0.0, bound), start, "LSODA", rtol=1e-8, atol=1e-10)
    sizes = state_norm(certificate.spans[0].shape, degree, solution.y.T)
    assert sizes[-1] <= 0.01 * sizes[0]
    assert np.diff(sizes).max() < 1e-6 * sizes[0]


class HalvedInTheLoop(WeightedNorm):
    """What the loop calls is not what its array form says."""

    def __call__(self, error, error_rate):
        return 0.5 * WeightedNorm.__call__(self, error, error_rate)


class Halved(HalvedInTheLoop):
    """Half of the weighted norm in both forms."""

    def values(self, errors, rates):
        return 0.5 * WeightedNorm.values(self, errors, rates)


class Euclidean(Norm):
    """Scales with error and rate alike: homogeneous of degree zero alone."""

    def __init__(self, degree):
        self.degree = degree

    def __call__(self, error, error_rate):
        return float(np.hypot(error, error_rate))

    def values(self, errors, rates):
        return np.hypot(errors, rates)


class Foreign:
    """A norm of the loop that is no Norm: it has no array form."""

    degree = -0.2

    def __call__(self, error, error_rate):
        return WeightedNorm(-0.2, 1.0, 1.0)(error, error_rate)


@pytest.mark.parametrize(
    ("norm", "message"),
    [
        (HalvedInTheLoop(-0.2, 1.0, 1.0), "is 0.5 in the loop and 1 in its array form"),
        (Euclidean(-0.2), "not homogeneous of degree -0.2"),
        (Foreign(), "derive Foreign from hpid_ros.control.Norm"),
    ],
    ids=["subclass", "not homogeneous", "no array form"],
)
def test_a_norm_that_the_certificate_would_not_be_of_is_refused_in_a_line(norm, message):
    gains, shape = Gains(3.0, 1.0, 3.0), tuple(map(tuple, np.eye(3)))
    assert HomogeneousPid(gains, norm).update(0.1, 0.2, 0.001)  # a loop takes it
    certificate = Certificate(gains, (CertifiedSpan(1.0, (norm,), shape, 0.0),))
    for certify in (
        lambda: certify_degree(gains, norm),
        lambda: certified_degree_interval(gains, lambda degree: norm),
        lambda: verify_certificate(certificate),
        lambda: settling_time_bound(certificate, norm, (1.0, 0.0, 0.0)),
    ):
        with pytest.raises(NormError, match=message) as caught:
            certify()
        assert "\n" not in str(caught.value)


def test_a_norm_of_another_degree_is_refused():
    with pytest.raises(NormError, match=r"asked 0\.0, got"):
        certified_degree_interval(Gains(3.0, 1.0, 3.0), lambda mu: WeightedNorm(0.1, 1.0, 1.0))


def test_a_norm_of_ones_own_is_the_same_in_loop_and_certificate():
    """Half of a norm is a norm whose weights are half: with the same loop and certificate."""
    gains, own, other = Gains(3.0, 1.0, 3.0), Halved(-0.2, 1.0, 1.0), WeightedNorm(-0.2, 0.5, 0.5)
    state = np.array([0.3, -0.2, 0.1])
    law, field = HomogeneousPid(gains, own), closed_loop_field(gains, own, state)
    assert law.update(0.3, -0.2, 1e-3) == pytest.approx(state[2] - field[1], rel=1e-12)
    found = certify_degree(gains, own)
    span = found.spans[0]
    assert span_margins(gains, span, own) == pytest.approx(span_margins(gains, span, other))
    assert verify_certificate(found).rate > 0.0
    with pytest.raises(SettingError, match="a certificate of a Halved cannot be saved"):
        found.to_mapping()


@pytest.mark.parametrize("degree", [-0.4, 0.3])
def test_the_unit_curve_of_a_norm_of_ones_own_has_norm_one(degree):
    curve = unit_curve(Halved(degree, 2.0, 0.1), 5)
    assert 0.5 * WeightedNorm(degree, 2.0, 0.1).values(*curve.T) == pytest.approx(1.0, rel=1e-12)


@st.composite
def programs(draw):
    """Return a linear program as the search makes them, rows and columns of any size."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows, n = draw(st.integers(1, 200)), 6
    slopes = rng.normal(size=(rows, n)) * 10.0 ** rng.uniform(-2.0, 2.0, size=(1, n))
    slopes[rows // 2 :] = slopes[: rows - rows // 2]  # repeated rows: vertices where many meet
    return slopes, rng.normal(size=rows), rng.normal(size=(2, n)), rng.random(2)


@examples(0.6)
@given(programs(), st.floats(-4.0, 0.0))
def test_the_least_maximum_is_that_of_a_general_solver(program, log_radius):
    slopes, values, losses, spare = program
    rows, n = slopes.shape
    radius, scale = 10.0**log_radius, np.abs(slopes).max()
    x = least_maximum(values, slopes, losses, spare, radius)
    assert np.abs(x).max() <= radius
    assert (losses @ x <= spare + 1e-7).all()
    general = linprog(
        [0.0] * n + [1.0],
        A_ub=np.block([[slopes / scale, -np.ones((rows, 1))], [losses, np.zeros((2, 1))]]),
        b_ub=np.concatenate([-values / scale, spare]),
        bounds=[(-radius, radius)] * n + [(None, None)],
    )
    assert (values + slopes @ x).max() / scale == pytest.approx(general.fun, abs=1e-7)


def test_many_shapes_at_once_have_the_rates_of_each():
    gains, norm = Gains(10.0, 15.0, 5.0), CanonicalNorm(0.2, ((1.0, 0.1), (0.1, 0.3)))
    shapes = first_shapes(gains, norm).reshape(-1, 3, 3)[::7]
    shapes[3] = np.diag([1.0, -1.0, 1.0])  # not positive definite
    grids = [SphereGrid(gains, norm, 12, 24)]
    each = [worst_rate(grids, shape) for shape in shapes]
    assert each[3] == np.inf
    assert worst_rates(grids, shapes) == pytest.approx(each, rel=1e-12)


def test_a_shape_that_holds_at_two_inertias_holds_between_them():
    gains = Gains(39.6, 132.0, 3.96)
    found = certified_degree_interval(
        gains, lambda mu: WeightedNorm.scaled(mu, 0.3, 0.2), (0.12, 0.16), 0.02
    )
    least, middle, largest = (
        [span for span in found.spans if span.inertia == each] for each in found.inertias
    )
    shared = shared_spans(largest, least, 0.15)
    assert len(shared) > 10
    for span in shared[::5]:
        for norm in span.norms:
            assert span_margins(gains, span, norm).rate >= 0.99 * span.rate
    assert {(span.lower, span.upper) for span in shared} <= {(s.lower, s.upper) for s in middle}
    larger = [tuple(map(tuple, 1.1 * np.array(span.shape))) for span in least]
    moved = [dataclasses.replace(s, shape=p) for s, p in zip(least, larger, strict=True)]
    assert shared_spans(largest, moved, 0.15) == []


def test_gains_over_a_light_inertia_may_be_beyond_the_range_of_their_parameters():
    assert certify_degree(Gains(50.0, 2500.0, 0.4), WeightedNorm(-0.1, 1.0, 1.0), 0.002).spans


@pytest.mark.parametrize("value", ["x", 10**400, None, {"a": 1}], ids=range(4))
def test_a_certificate_of_no_numbers_is_refused(value):
    mapping = {"format": FORMAT, "gains": {"p": value, "i": 1.0, "d": 1.0}, "spans": []}
    with pytest.raises(SettingError, match="misshapes an entry"):
        Certificate.from_mapping(mapping)


def test_certificates_of_a_hundred_thousand_brackets_are_one_line(tmp_path):
    (tmp_path / "certificates.json").write_text("[" * 100_000)
    with pytest.raises(SettingError, match="is no JSON"):
        saved_certificates(tmp_path / "certificates.json")

"""Whether the loop around one joint is stable: search of a certificate, its check, the verdict.

A linear PID is stable if and only if its gains are Hurwitz. The homogeneous PID with the same
gains is stable for degrees close to zero; how close is what a certificate says.

The search (:class:`CertificateSearch`) accepts what holds on a fine grid. The check
(:func:`check_certificate`) proves the same statement again and shares neither code nor points with
it: the field comes from the law's definition and the norms themselves, in physical units, on a
circle in the plane of error and rate, carried by the dilation from the sphere's rim to its pole,
and a second time with small steps around the worst of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import GainError, NormError, SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.control.homogeneous_pid import Gains, require_hurwitz
from hpid_ros.stability.closed_loop import (
    Certificate,
    CertifiedSpan,
    DegreeInterval,
    Norm,
    closed_loop_field,
    effective_gains,
    require_known_norm,
)
from hpid_ros.stability.quadratic_forms import (
    SphereGrid,
    first_shapes,
    improved,
    scaled_loop,
    time_unit,
    worst_rate,
    worst_rates,
)

_ANGLES_EVEN = 240
_ANGLES_NEAR_AXES = 48  # in each quadrant
_DEPTHS = 160
_LEAST_TANGENT = 1e-6
_DEEPEST = 450.0  # in ln n; beyond it the coordinates underflow
_NEGLIGIBLE = 14.0  # in ln of the slowest power of n
_WORST, _ZOOM, _ZOOMS = 12, 13, 3


class Margins(NamedTuple):
    """By how much a certificate holds."""

    rate: float  # [1/s] least of -x'Pf(x) on the sphere x'Px = 1
    monotonicity: float  # least growth rate of the P-norm along the dilation
    decay: float


def check_certificate(certificate: Certificate) -> Margins:
    """Check a certificate on points of its own, and return its least margins."""
    margins = []
    for span in certificate.spans:
        _require_shape(span)
        for norm in span.norms:
            found = span_margins(certificate.gains, span, norm)
            _require_margins(span, norm.degree, found)
            margins.append(found)
    return Margins(*(min(column) for column in zip(*margins, strict=True)))


def best_spans(certificate: Certificate, norm: Norm) -> list[tuple[CertifiedSpan, Margins]]:
    """Return for each inertia the span that proves the fastest decay at one degree."""
    degree = norm.degree
    if not certificate.lower <= degree <= certificate.upper:
        raise GainError(
            f"the certificate reaches from degree {certificate.lower:g} to "
            f"{certificate.upper:g}, not to {degree:g}"
        )
    best = []
    for inertia in certificate.inertias:
        there = [
            (span, span_margins(certificate.gains, span, norm))
            for span in certificate.spans
            if span.inertia == inertia and span.lower <= degree <= span.upper
        ]
        span, margins = max(there, key=lambda each: each[1].decay)
        _require_margins(span, degree, margins)
        best.append((span, margins))
    return best


def span_margins(gains: Gains, span: CertifiedSpan, norm: Norm) -> Margins:
    """Return by how much a span's P holds at one degree; negative where it does not."""
    shape, degree = np.array(span.shape), norm.degree
    exponents = np.array([1.0 - degree, 1.0, 1.0 + degree])
    product = shape * exponents
    growth = np.linalg.eigvals(np.linalg.solve(shape, 0.5 * (product + product.T))).real
    monotonicity = float(growth.min())
    if monotonicity <= 0.0:
        return Margins(-np.inf, monotonicity, -np.inf)
    sphere = _Sphere(shape, degree)

    def rates(angles: Numbers, depths: Numbers) -> tuple[Numbers, Numbers]:
        states = sphere.states(angles, depths)
        field = closed_loop_field(gains, norm, states, span.inertia)
        inward = np.einsum("...i,...i->...", states @ shape, field)
        return inward, inward / np.einsum("...i,...i->...", states @ product, states)

    pole = shape[1, 2] / shape[2, 2]  # at e = de = 0 the field is (0, x3, 0)
    rate, decay = _largest(sphere.angles(), rates)
    return Margins(-max(rate, pole), monotonicity, -max(decay, pole / exponents[2]))


def _require_margins(span: CertifiedSpan, degree: float, margins: Margins) -> None:
    if not (margins.monotonicity > 0.0 and margins.rate > 0.0 and margins.decay > 0.0):
        raise GainError(
            f"the certificate does not hold at degree {degree:g}, inertia {span.inertia:g} "
            f"kg m^2: the field must enter the sphere, margin {margins.rate:.3g} 1/s, and the "
            f"dilation leave it, {margins.monotonicity:.3g}"
        )


class _Sphere:
    """The half of the sphere that lies above its rim; the other half is its mirror image.

    A point has an angle, its direction in coordinates in which the rim is a circle, and a depth
    from 0 on the rim to 1 close to the pole, along the dilation.
    """

    def __init__(self, shape: Numbers, degree: float) -> None:
        self._shape, self._degree = shape, degree
        schur = shape[:2, :2] - np.outer(shape[:2, 2], shape[2, :2]) / shape[2, 2]
        self._schur, self._to_circle = schur, np.linalg.cholesky(schur).T
        slowest = min(1.0 + 2.0 * degree, 1.0 - degree)
        self._depth = min(_NEGLIGIBLE / slowest, _DEEPEST)

    def angles(self) -> Numbers:
        """Return angles all around in [rad], even and closely spaced at e = 0 and de = 0."""
        even = np.linspace(-np.pi, np.pi, _ANGLES_EVEN, endpoint=False)
        tangents = np.geomspace(_LEAST_TANGENT, 1.0 / _LEAST_TANGENT, _ANGLES_NEAR_AXES)
        quadrant = np.arctan(tangents)
        plane = (quadrant[None, :] + 0.5 * np.pi * np.arange(4.0)[:, None]).ravel()
        sides = np.sqrt(np.diag(self._schur))
        x, y = self._to_circle @ (np.stack([np.cos(plane), np.sin(plane)]) / sides[:, None])
        return np.unique(np.concatenate([even, np.arctan2(y, x)]))

    def states(self, angles: Numbers, depths: Numbers) -> Numbers:
        """Return the points of the sphere at these angles [rad] and depths in [0, 1]."""
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        rim = circle @ np.linalg.inv(self._to_circle).T
        s = -self._depth * depths**3
        first = np.exp((1.0 - self._degree) * s) * rim[..., 0]
        second = np.exp(s) * rim[..., 1]
        plane = np.stack([first, second], axis=-1)
        p33, coupling = self._shape[2, 2], self._shape[:2, 2]
        square = np.einsum("...i,...i->...", plane @ self._schur, plane)
        height = np.sqrt(np.maximum(1.0 - square, 0.0) / p33)
        return np.stack([first, second, height - plane @ coupling / p33], axis=-1)


def _largest(
    angles: Numbers, function: Callable[[Numbers, Numbers], tuple[Numbers, Numbers]]
) -> tuple[float, float]:
    """Return the largest values over all angles and depths, looking closer where one is large."""
    depths = np.linspace(0.0, 1.0, _DEPTHS)
    gaps = np.diff(angles, append=angles[0] + 2.0 * np.pi)
    steps = np.maximum(gaps, np.roll(gaps, 1))
    first, second = function(angles[:, None], depths[None, :])

    def zoomed(values: Numbers, which: int) -> float:
        worst = np.argpartition(values, -_WORST, None)[-_WORST:]
        rows, columns = np.unravel_index(worst, values.shape)
        angle, depth = angles[rows], depths[columns]
        wide, deep = steps[rows], np.full(rows.shape, depths[1])
        largest = values.max()
        for _ in range(_ZOOMS):
            near = [_around(angle, wide), _around(depth, deep).clip(0.0, 1.0)]
            found = function(near[0][:, :, None], near[1][:, None, :])[which]
            index = np.arange(_WORST)
            i, j = np.unravel_index(found.reshape(_WORST, -1).argmax(axis=1), found.shape[1:])
            angle, depth = near[0][index, i], near[1][index, j]
            largest = max(largest, found.max())
            wide, deep = wide / 5.0, deep / 5.0
        return float(largest)

    return zoomed(first, 0), zoomed(second, 1)


def _around(centres: Numbers, widths: Numbers) -> Numbers:
    spread: Numbers = centres[:, None] + widths[:, None] * np.linspace(-1.0, 1.0, _ZOOM)
    return spread


def _require_shape(span: CertifiedSpan) -> None:
    shape = np.array(span.shape, float)
    if shape.shape != (3, 3) or not np.isfinite(shape).all() or not (shape == shape.T).all():
        raise GainError(
            f"a certificate's P must be a finite symmetric 3x3 matrix, not {span.shape}"
        )
    if not np.linalg.eigvalsh(shape / np.sqrt(np.outer(np.diag(shape), np.diag(shape)))).min() > 0:
        raise GainError(f"a certificate's P must be positive definite, not {span.shape}")
    if not span.inertia > 0.0:
        raise GainError(f"the inertia must be positive and finite, not {span.inertia} kg m^2")


NormOfDegree = Callable[[float], Norm]

OUTERMOST_DEGREE = 0.495
"""Where the search ends on either side."""

_MARGIN = 1e-3  # of the rate in units of ki^(1/3), on the fine grid
_MARGIN_OF_SLOW_LOOP = 0.05  # of the loop's slowest pole, where that is less
_WIDEST_SPAN = 0.05
_COARSE = (12, 24)
_MEDIUM = (30, 60)
_FINE = (80, 260)
_REFINED = 4
_AMPLE = 3.0
_SAME = 1e-12  # of two P; rounding when units are changed and changed back


def shared_spans(
    one: Sequence[CertifiedSpan], other: Sequence[CertifiedSpan], inertia: float
) -> list[CertifiedSpan]:
    """Return spans that are certified at an inertia between two others because they are there.

    For one P, x'P f(x) is a linear function of one over the inertia: what is negative at two
    inertias is negative between them.
    """
    return [
        CertifiedSpan(inertia, here.norms, here.shape, min(here.rate, there.rate))
        for here in one
        for there in other
        if (here.lower, here.upper) == (there.lower, there.upper)
        and np.allclose(here.shape, there.shape, rtol=_SAME, atol=0.0)
    ]


class CertificateSearch:
    """Finds certificates of one loop."""

    def __init__(
        self, gains: Gains, inertia: float, norm_of_degree: NormOfDegree, first_degree: float = 0.0
    ) -> None:
        self._inertia = inertia
        self._effective = effective_gains(gains, inertia)
        self._norm_of_degree = norm_of_degree
        slowest = -np.linalg.eigvals(scaled_loop(self._effective)).real.max()
        self._margin = min(_MARGIN, _MARGIN_OF_SLOW_LOOP * float(slowest))
        self._seen: dict[tuple[float, bytes], float] = {}
        self._first_shapes = first_shapes(self._effective, self.norm(first_degree))

    def norm(self, degree: float) -> Norm:
        norm = self._norm_of_degree(degree)
        require_known_norm(norm)
        if norm.degree != degree:
            raise NormError(
                f"norm_of_degree must give a norm of the degree it is asked for: "
                f"asked {degree}, got {norm!r}"
            )
        return norm

    def outward(
        self,
        direction: float,
        tolerance: float,
        outermost: float = OUTERMOST_DEGREE,
        like: Sequence[CertifiedSpan] = (),
        certain: Sequence[CertifiedSpan] = (),
    ) -> list[CertifiedSpan]:
        """Return certified spans that follow each other from degree zero."""
        here, width = 0.0, _WIDEST_SPAN
        spans: list[CertifiedSpan] = []
        shape: Numbers | None = None
        while abs(here) < outermost and width >= 0.5 * tolerance:
            there = direction * round(min(abs(here) + width, outermost), 12)
            ends = sorted((here, there))
            ready = [span for span in certain if [span.lower, span.upper] == ends]
            if ready:
                shape = self._in_units(ready[0])
                spans.append(ready[0])
                here = there
                continue
            middle = 0.5 * (here + there)
            others = [self._in_units(span) for span in like if span.lower <= middle <= span.upper]
            found = self._find((here, middle, there), shape, others)
            if found is None:
                width *= 0.5
                continue
            shape, span = found
            spans.append(span)
            here = there
        return spans or [self.at(0.0)]

    def at(self, degree: float) -> CertifiedSpan:
        """Return a certificate of one degree alone, its decay made as fast as the search can."""
        found = self._find((degree,), None)
        if found is None:
            raise GainError(
                f"degree {degree:g} is not certified for effective gains p "
                f"{self._effective.p:g}, i {self._effective.i:g}, d {self._effective.d:g}: "
                f"choose one closer to 0, or gains with p d further above i"
            )
        shape, span = found
        faster = improved(self._grids((degree,), _COARSE), shape, relative=True)
        return self._accepted((degree,), faster) or span

    def _find(
        self, degrees: tuple[float, ...], near: Numbers | None, others: Sequence[Numbers] = ()
    ) -> tuple[Numbers, CertifiedSpan] | None:
        """Return a shape that is accepted at all of these degrees, or None."""
        ends = (degrees[0], degrees[-1])[: len(degrees)]
        try:
            coarse = self._grids(ends, _COARSE)
        except NormError:
            return None  # the law has none there
        for shape in chain(others, self._candidates(coarse, ends, near)):
            span = self._accepted(degrees, shape)
            if span is not None:
                return shape, span
        return None

    def _candidates(
        self, coarse: list[SphereGrid], ends: tuple[float, ...], near: Numbers | None
    ) -> Iterator[Numbers]:
        """Yield shapes worth a look on the fine grid, the cheapest first."""
        enough = -_AMPLE * self._margin
        # A narrower span is asked for after a wider one failed, and is close to what is known.
        is_widest = near is None or abs(ends[-1] - ends[0]) > 0.99 * _WIDEST_SPAN
        for start in self._starts(coarse, near, is_widest):
            yield start
            shape = improved(coarse, start, enough=enough)
            yield shape
            if worst_rate(coarse, shape) < -self._margin:  # but too bad between the points
                yield improved(self._grids(ends, _MEDIUM), shape, enough=enough)

    def _starts(
        self, grids: list[SphereGrid], near: Numbers | None, is_widest: bool
    ) -> Iterator[Numbers]:
        if near is not None:
            yield near
        # The best shape of each scale: from scales that are far apart, the search ends in
        # different optima.
        scales, solutions = self._first_shapes.shape[:2]
        rates = worst_rates(grids, self._first_shapes.reshape(-1, 3, 3))
        rates = rates.reshape(scales, solutions)
        best = self._first_shapes[np.arange(scales), rates.argmin(axis=1)]
        order = np.argsort(rates.min(axis=1), kind="stable")
        yield from best[order[: _REFINED if is_widest else 1]]

    def _accepted(self, degrees: tuple[float, ...], shape: Numbers) -> CertifiedSpan | None:
        """Return the span that a shape certifies on the fine grid, or None."""
        coarse = worst_rate(self._grids(degrees, _COARSE), shape)
        if coarse > -self._margin:
            return None
        worst = coarse
        for degree in degrees:
            worst = max(worst, self._on_fine_grid(degree, shape))
            if worst > -self._margin:
                return None
        unit = time_unit(self._effective)
        physical = shape / self._units()
        physical = 0.5 * (physical + physical.T)
        return CertifiedSpan(
            inertia=self._inertia,
            norms=tuple(self.norm(degree) for degree in sorted(degrees)),
            shape=tuple(tuple(float(x) for x in row) for row in physical),
            rate=-worst * unit,
        )

    def _on_fine_grid(self, degree: float, shape: Numbers) -> float:
        """Return the worst rate; spans that follow each other share a degree, and often a P."""
        key = degree, shape.tobytes()
        if key not in self._seen:
            self._seen[key] = worst_rate(self._grids((degree,), _FINE), shape)
        return self._seen[key]

    def _units(self) -> Numbers:
        """Return what turns a P in [rad], [s] into one in units of ki^(1/3)."""
        scales = time_unit(self._effective) ** np.arange(3.0)
        units: Numbers = np.multiply.outer(scales, scales)
        return units

    def _in_units(self, span: CertifiedSpan) -> Numbers:
        shape: Numbers = np.array(span.shape) * self._units()
        return shape

    def _grids(self, degrees: tuple[float, ...], size: tuple[int, int]) -> list[SphereGrid]:
        return [SphereGrid(self._effective, self.norm(degree), *size) for degree in degrees]


def certified_degree_interval(
    gains: Gains,
    norm_of_degree: Callable[[float], Norm],
    inertia: float | tuple[float, float] = 1.0,
    tolerance: float = 2e-3,
) -> DegreeInterval:
    """Return degrees around zero for which the homogeneous PID is certified stable.

    Certified is the ideal loop, the law without floor or cap on a double integrator of constant
    inertia. The certificate holds one quadratic form for each span of at most 0.05 in the
    degree, seen to hold at the span's ends and middle on a fine grid; it is not necessary for
    stability, so a loop may well be stable outside the interval.
    """
    if not tolerance > 0.0:
        raise SettingError(f"the tolerance of a degree must be positive, not {tolerance}")
    # From the largest inertia, where the integral weighs most and the interval is narrowest: the
    # others need not be searched beyond its ends, and often share its P. The middle comes last.
    inertias = require_certifiable(gains, inertia)
    order = dict.fromkeys((inertias[-1], inertias[0], *inertias[1:-1]))
    searches = {each: CertificateSearch(gains, each, norm_of_degree) for each in order}
    spans: dict[float, list[CertifiedSpan]] = {each: [] for each in inertias}
    for direction in (-1.0, 1.0):
        found: list[list[CertifiedSpan]] = []
        outermost = OUTERMOST_DEGREE
        for each, search in searches.items():
            like = found[-1] if found else ()
            certain = shared_spans(found[0], found[1], each) if len(found) == 2 else ()
            found.append(search.outward(direction, tolerance, outermost, like, certain))
            outermost = max(abs(found[-1][-1].lower), abs(found[-1][-1].upper))
            spans[each] += reversed(found[-1]) if direction < 0.0 else found[-1]
    certificate = Certificate(gains, tuple(span for own in spans.values() for span in own))
    return DegreeInterval(certificate.lower, certificate.upper, certificate)


def certify_degree(
    gains: Gains, norm: Norm, inertia: float | tuple[float, float] = 1.0
) -> Certificate:
    """Return a certificate of one degree, its decay made as fast as the search can."""
    require_known_norm(norm)
    spans = [
        CertificateSearch(gains, each, lambda degree: norm, norm.degree).at(norm.degree)
        for each in require_certifiable(gains, inertia)
    ]
    return Certificate(gains, tuple(spans))


def verify_certificate(certificate: Certificate) -> Margins:
    """Check a certificate again, without anything of the search that found it.

    Other points, and the field from the law's definition; see
    :mod:`hpid_ros.stability.certification`. Checked is every degree whose norm it holds.
    """
    for inertia in certificate.inertias:
        _require_integral_action(certificate.gains)
        require_hurwitz(certificate.gains, inertia)
    return check_certificate(certificate)


def require_certifiable(gains: Gains, inertia: float | tuple[float, float]) -> tuple[float, ...]:
    """Refuse gains that no certificate can be looked for."""
    if isinstance(inertia, int | float):
        values = [float(inertia)]
    else:
        low, high = inertia
        if not low <= high:
            raise GainError(f"the least inertia {low} must not exceed the largest {high} kg m^2")
        values = sorted({float(low), 0.5 * (low + high), float(high)})
    _require_integral_action(gains)
    for value in values:
        require_hurwitz(gains, value)
    return tuple(values)


def _require_integral_action(gains: Gains) -> None:
    if not gains.i > 0.0:
        raise GainError(
            f"a certificate needs integral action: i must be positive, not {gains.i:g}"
        )

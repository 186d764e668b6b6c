"""Whether the loop around one joint is stable: a certificate checked.

A linear PID is stable if and only if its gains are Hurwitz. The homogeneous PID with the same
gains is stable for degrees close to zero; how close is what a certificate says.

The search (:mod:`hpid_ros.stability.certificate_search`) accepts what holds on a fine grid. The
check proves the same statement again and shares neither code nor points with it: the field comes
from the law's definition and the norms themselves, in physical units, on a circle in the plane of
error and rate, carried by the dilation from the sphere's rim to its pole, and a second time with
small steps around the worst of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import GainError
from hpid_ros.base.units import Numbers
from hpid_ros.control.homogeneous_pid import Gains, require_hurwitz
from hpid_ros.control.norms import Norm
from hpid_ros.stability.closed_loop import (
    Certificate,
    CertifiedSpan,
    closed_loop_field,
    require_certifiable_norm,
)

_ANGLES_EVEN = 240
_ANGLES_NEAR_AXES = 48  # in each quadrant
_DEPTHS = 160
_LEAST_TANGENT = 1e-6
_DEEPEST = 450.0  # in ln n; beyond it the coordinates underflow
_NEGLIGIBLE = 14.0  # in ln of the slowest power of n
_WORST, _ZOOM, _ZOOMS = 12, 13, 3


class CertificateMargins(NamedTuple):
    """By how much a certificate holds."""

    rate: float  # [1/s] least of -x'Pf(x) on the sphere x'Px = 1
    monotonicity: float  # least growth rate of the P-norm along the dilation
    decay: float


def check_certificate(certificate: Certificate) -> CertificateMargins:
    """Check a certificate on points of its own, and return its least margins."""
    margins = []
    for span in certificate.spans:
        _require_shape(span)
        for norm in span.norms:
            found = span_margins(certificate.gains, span, norm)
            _require_margins(span, norm.degree, found)
            margins.append(found)
    return CertificateMargins(*(min(column) for column in zip(*margins, strict=True)))


def best_spans(
    certificate: Certificate, norm: Norm
) -> list[tuple[CertifiedSpan, CertificateMargins]]:
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


def span_margins(gains: Gains, span: CertifiedSpan, norm: Norm) -> CertificateMargins:
    """Return by how much a span's P holds at one degree; negative where it does not."""
    require_certifiable_norm(norm)
    shape, degree = np.array(span.shape), norm.degree
    exponents = np.array([1.0 - degree, 1.0, 1.0 + degree])
    product = shape * exponents
    growth = np.linalg.eigvals(np.linalg.solve(shape, 0.5 * (product + product.T))).real
    monotonicity = float(growth.min())
    if monotonicity <= 0.0:
        return CertificateMargins(-np.inf, monotonicity, -np.inf)
    sphere = _Sphere(shape, degree)

    def rates(angles: Numbers, depths: Numbers) -> tuple[Numbers, Numbers]:
        states = sphere.states(angles, depths)
        field = closed_loop_field(gains, norm, states, span.inertia)
        inward = np.einsum("...i,...i->...", states @ shape, field)
        return inward, inward / np.einsum("...i,...i->...", states @ product, states)

    pole = shape[1, 2] / shape[2, 2]  # at e = de = 0 the field is (0, x3, 0)
    rate, decay = _largest(sphere.angles(), rates)
    return CertificateMargins(-max(rate, pole), monotonicity, -max(decay, pole / exponents[2]))


def _require_margins(span: CertifiedSpan, degree: float, margins: CertificateMargins) -> None:
    if not (margins.monotonicity > 0.0 and margins.rate > 0.0 and margins.decay > 0.0):
        raise GainError(
            f"the certificate does not hold at degree {degree:g}, inertia {span.inertia:g} "
            f"kg m^2: decay margin {margins.rate:.3g} 1/s, monotonicity of the dilation "
            f"{margins.monotonicity:.3g}: both must be positive"
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
    return np.asarray(centres[:, None] + widths[:, None] * np.linspace(-1.0, 1.0, _ZOOM))


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


def verify_certificate(certificate: Certificate) -> CertificateMargins:
    """Check a certificate again, without anything of the search that found it.

    Checked is every degree whose norm it holds.
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

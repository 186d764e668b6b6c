"""Stability of the loop around one joint: what is certain, and how certain.

A linear PID is stable if and only if its gains are Hurwitz. The homogeneous PID with the same
gains is stable for degrees close to zero; how close is what a certificate says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.control.gains import Gains, require_hurwitz
from hpid_ros.stability.certificate import Certificate, CertifiedSpan, DegreeInterval
from hpid_ros.stability.closed_loop import Norm

if TYPE_CHECKING:
    from hpid_ros.stability.check import Margins

__all__ = [
    "Certificate",
    "DegreeInterval",
    "certified_degree_interval",
    "certify_degree",
    "require_certifiable",
    "verify_certificate",
]


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
    # Imported here: a controller that only checks Routh and Hurwitz does not wait for numpy.
    from hpid_ros.stability.search import OUTERMOST_DEGREE, CertificateSearch, shared_spans

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
    from hpid_ros.stability.closed_loop import require_known_norm
    from hpid_ros.stability.search import CertificateSearch

    require_known_norm(norm)
    spans = [
        CertificateSearch(gains, each, lambda degree: norm, norm.degree).at(norm.degree)
        for each in require_certifiable(gains, inertia)
    ]
    return Certificate(gains, tuple(spans))


def verify_certificate(certificate: Certificate) -> Margins:
    """Check a certificate anew, without anything of the search that found it.

    Other points, and the field from the law's definition; see
    :mod:`hpid_ros.stability.check`. Checked is every degree whose norm it holds.
    """
    from hpid_ros.stability.check import check_certificate

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

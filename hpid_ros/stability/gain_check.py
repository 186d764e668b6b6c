"""Whether gains are certified: many loops at once, figures of a loop, saved certificates verified.

Two loops are of one kind if they differ by their units alone: by the scale of the error, of time
and of effort. Joints that were tuned by one rule are of one kind, and so are the controllers of
one joint that differ in their degree. Each kind is computed once, the kinds on all cores.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hpid_ros.base.errors import GainError, NormError, SettingError
from hpid_ros.base.files import load_json
from hpid_ros.base.processes import side_by_side
from hpid_ros.base.rounding import significant
from hpid_ros.base.units import Numbers
from hpid_ros.control.homogeneous_pid import Gains, is_hurwitz
from hpid_ros.control.laws import LawName
from hpid_ros.control.norms import Norm, NormFamily
from hpid_ros.control.settings import LoopSettings
from hpid_ros.stability.certificate_search import certified_degree_interval, certify_degree
from hpid_ros.stability.certification import best_spans, require_certifiable, verify_certificate
from hpid_ros.stability.closed_loop import (
    Certificate,
    CertifiedSpan,
    as_matrix,
    effective_gains,
    state_norm,
)

Loop = tuple[LoopSettings, tuple[float, float]]
"""Settings, and the least and the largest inertia in [kg m^2]."""

_DIGITS = 12  # rounding when units are changed; a certificate's margins are far larger


class LoopKind(NamedTuple):
    """A loop in its own units: ``norm.error_scale`` 1, i 1, and 1 the largest inertia."""

    p: float  # proportional gain
    d: float  # derivative gain
    least_inertia: float
    norm_type: str
    rate_weight: float  # weight of the error rate in the norm


def certified_degrees(
    loops: Sequence[Loop], progress: Callable[[Sequence[str]], None] = lambda joints: None
) -> list[Certificate | GainError]:
    """Certify many loops, see :func:`.certified_degree_interval`."""
    found: list[Certificate | GainError | None] = [None] * len(loops)
    places: dict[LoopKind, list[int]] = {}
    for place, (settings, inertia) in enumerate(loops):
        try:
            require_certifiable(settings.gains, inertia)
        except GainError as error:
            found[place] = error
            progress([settings.joint])
        else:
            places.setdefault(kind_of(settings, inertia), []).append(place)
    kinds = list(places)
    for number, interval in side_by_side(_interval, kinds):
        kind = kinds[number]
        for place in places[kind]:
            found[place] = _in_physical_units(interval, *loops[place])
        progress([loops[place][0].joint for place in places[kind]])
    return [each for each in found if each is not None]


def kind_of(settings: LoopSettings, inertia: tuple[float, float]) -> LoopKind:
    least, largest = inertia
    rate, norm = _rate(settings.gains, largest), settings.norm_family
    numbers = (
        settings.gains.p / (largest * rate**2),
        settings.gains.d / (largest * rate),
        least / largest,
        norm.rate_weight * norm.error_scale * rate,
    )
    p, d, least_inertia, rate_weight = (significant(each, _DIGITS) for each in numbers)
    return LoopKind(p, d, least_inertia, norm.type, rate_weight)


def _rate(gains: Gains, inertia: float) -> float:
    """Return the loop's unit of rate in [1/s]."""
    return float((gains.i / inertia) ** (1.0 / 3.0))


def physical_units(settings: LoopSettings, inertia: tuple[float, float]) -> Numbers:
    """Return the units of a loop's state, of its kind: in [rad], [rad/s] and [rad/s^2]."""
    scale, rate = settings.norm_family.error_scale, _rate(settings.gains, inertia[1])
    return np.array([scale, scale * rate, scale * rate**2])


def _interval(kind: LoopKind) -> Certificate | None:
    try:
        return certified_degree_interval(
            Gains(kind.p, 1.0, kind.d),
            NormFamily(kind.norm_type, 1.0, kind.rate_weight),
            (kind.least_inertia, 1.0),
        )
    except GainError:
        return None


def _in_physical_units(
    certificate: Certificate | None, settings: LoopSettings, inertia: tuple[float, float]
) -> Certificate | GainError:
    gains, (least, largest) = settings.gains, inertia
    if certificate is None:
        return GainError(
            f"not even degree 0 is certified: p d = {gains.p * gains.d:g} must exceed i x inertia "
            f"= {gains.i * largest:g} by more"
        )
    family = settings.norm_family
    rate, units = _rate(gains, largest), physical_units(settings, inertia)
    middle = [0.5 * (least + largest)] * (len(certificate.inertias) - 2)
    ends = [least, largest] if len(certificate.inertias) > 1 else [largest]
    physical = dict(zip(certificate.inertias, sorted([*ends, *middle]), strict=True))

    spans = tuple(
        CertifiedSpan(
            physical[span.inertia],
            tuple(family(norm.degree) for norm in span.norms),
            as_matrix(np.array(span.shape) / np.multiply.outer(units, units)),
            span.rate * rate,
        )
        for span in certificate.spans
    )
    return Certificate(gains, spans)


_GAIN_DIGITS = 9
"""Loops whose gains over their inertia agree to so many digits are one: the margins with which
certificates are accepted are larger by orders of magnitude."""


class DegreeChecker:
    """Remembers what it found: joints tuned by one rule have one and the same loop."""

    def __init__(self) -> None:
        self._known: dict[Hashable, str] = {}

    def instability(self, settings: LoopSettings) -> str:
        """Return why a loop is unstable as a linear PID, in one line; empty if it is stable."""
        if not settings.plant_inertia > 0.0:
            raise SettingError(
                f"the inertia of {settings.joint!r} is not known: set its parameter inertia"
            )
        return _instability(settings.gains, settings.plant_inertia)

    def refusal(self, settings: LoopSettings) -> str:
        """Return why a loop is not certified, in one line; empty if it is.

        The linear law is certified by Routh and Hurwitz, the homogeneous one at its degree by
        :func:`.certify_degree`, at the inertia of its settings.
        """
        reason = self.instability(settings)
        if reason or settings.degree == 0.0:
            return reason
        gains = effective_gains(settings.gains, settings.plant_inertia)
        rounded = tuple(significant(each, _GAIN_DIGITS) for each in (gains.p, gains.i, gains.d))
        key = (rounded, settings.mu, settings.norm_family)
        if key not in self._known:
            try:
                norm = settings.norm_family(settings.mu)
                certify_degree(settings.gains, norm, settings.plant_inertia)
            except (GainError, NormError) as error:
                self._known[key] = f"not certified at mu = {settings.mu:g}: {error}"
            else:
                self._known[key] = ""
        return self._known[key]


def _instability(gains: Gains, inertia: float) -> str:
    if is_hurwitz(gains, inertia):
        return ""
    return (
        f"unstable as a linear PID: p d = {gains.p * gains.d:g} must exceed i x inertia = "
        f"{gains.i * inertia:g}"
    )


LARGEST_SAMPLING_MARGIN, LARGEST_SAMPLING_MARGIN_LATE = 2.0, 0.85
"""T kd lam / m at which the sampled loop breaks, and where a sample is answered one period late,
as over a topic."""

_NEGLIGIBLE_DEGREE = 1e-100  # a quotient of two such numbers has no digits
_SETTLED = 0.01  # of the first value


def integral_ratio(gains: Gains, inertia: float = 1.0) -> float:
    """Return rho = m ki / (kp kd): 0 without integral action, 1 at Routh's limit.

    Source: Routh and Hurwitz on m s^3 + kd s^2 + kp s + ki.
    """
    product = gains.p * gains.d
    return inertia * gains.i / product if product > 0.0 else math.inf


def sampling_margin(
    gains: Gains, period: float, largest_multiplier: float, inertia: float = 1.0
) -> float:
    """Return T kd lam / m, without a unit; see :data:`GOOD_SAMPLING_MARGIN`.

    Source: Livne and Levant, "Proper discretization of homogeneous differentiators" (2014), for
    the principle; its limits were measured on the sampled double integrator.
    """
    return period * gains.d / inertia * largest_multiplier


def decay_time(degree: float, decay: float, start: float, end: float) -> float:
    r"""Return how long :math:`\dot V = -\beta V^{1+\mu}` takes from one value to another."""
    logarithm = math.log(start / end)
    if abs(degree) < _NEGLIGIBLE_DEGREE:
        return logarithm / decay
    # end^-mu - start^-mu, without the loss of digits for a small degree.
    return math.pow(end, -degree) * -math.expm1(-degree * logarithm) / (decay * degree)


def settling_time_bound(
    certificate: Certificate,
    norm: Norm,
    state: tuple[float, float, float],
) -> float:
    """Return a time after which the ideal loop has settled for certain, in [s].

    Settled means that the canonical norm V of the certificate's P is below a hundredth of its
    first value, for every certified inertia. The bound is what the certificate proves, and hence
    larger than what a simulation shows.

    Source: along the closed loop dV/dt <= -beta V^{1+mu} with beta the least of -x'Pf/x'PGx on
    the sphere. (The paper's bound of the rate takes lambda_min where lambda_max is needed.)
    """
    times = []
    for span, margins in best_spans(certificate, norm):
        start = float(state_norm(span.shape, norm.degree, state))
        times.append(decay_time(norm.degree, margins.decay, start, _SETTLED * start))
    return max(times)


LARGEST_QUOTED_NORM = 2.0
"""The error at ``norm.error_scale`` while the rate adds as much: where figures are quoted."""


@dataclass(frozen=True)
class GainVerdict:
    """What is known of one joint's loop."""

    joint: str
    law: LawName
    degree: float  # the configured degree; 0 for the linear law
    inertia: tuple[float, float]  # [kg m^2] least and largest inertia
    is_certified: bool  # whether the loop is certified at the configured degree and every inertia
    reason: str  # why it is not; empty when it is
    interval: tuple[float, float] | None  # certified degrees, or None when there are none
    integral_ratio: float  # rho = m ki / (kp kd) at the largest inertia
    sampling_margin: float  # T kd lam_max / m at the least inertia
    multipliers: tuple[float, float]  # least and largest factor of the bandwidth, up to norm 2
    # [s] time after which an error of norm.error_scale has certainly come down to a hundredth
    settling_bound: float | None
    certificate: dict[str, Any] | None  # the certificate as plain data, or None


def check_gains(
    loops: Sequence[Loop], progress: Callable[[Sequence[str]], None] = lambda joints: None
) -> list[GainVerdict]:
    """Judge several loops, side by side on the machine's cores."""
    for settings, inertia in loops:
        low, high = inertia
        if not 0.0 < low <= high < math.inf:
            raise GainError(
                f"the inertia of {settings.joint!r} must be positive and finite, its least value "
                f"not above its largest, not {low} to {high} kg m^2"
            )
    found = certified_degrees(loops, progress)
    tasks = [(*loop, each) for loop, each in zip(loops, found, strict=True)]
    verdicts = dict(side_by_side(_verdict, tasks, name=lambda task: task[0].joint))
    return [verdicts[place] for place in range(len(tasks))]


def _verdict(
    task: tuple[LoopSettings, tuple[float, float], Certificate | GainError],
) -> GainVerdict:
    settings, inertia, found = task
    low, high = inertia
    gains = settings.gains
    degree = settings.degree
    multipliers = _multipliers(settings)
    interval, certificate, bound, reason = None, None, None, ""
    if isinstance(found, Certificate):
        interval, certificate = (found.lower, found.upper), found.to_mapping()
        if found.contains(degree):
            bound = _settling_bound(settings, inertia, found)
        elif settings.is_homogeneous:
            reason = f"mu = {degree:g} is outside the certified interval"
    else:  # Hurwitz decides for the linear law
        reason = _instability(gains, high) or (str(found) if degree != 0.0 else "")
    return GainVerdict(
        joint=settings.joint,
        law=settings.law,
        degree=degree,
        inertia=inertia,
        is_certified=not reason,
        reason=reason,
        interval=interval,
        integral_ratio=integral_ratio(gains, high),
        sampling_margin=sampling_margin(
            gains, settings.timing.control_period, multipliers[1], low
        ),
        multipliers=multipliers,
        settling_bound=bound,
        certificate=certificate,
    )


def _settling_bound(
    settings: LoopSettings, inertia: tuple[float, float], certificate: Certificate
) -> float:
    """Return the bound by a certificate of this degree alone, which is tighter than a span's."""
    family = settings.norm_family
    norm = family(settings.degree)
    with suppress(GainError):  # it was found from its neighbours only
        certificate = certify_degree(settings.gains, norm, inertia)
    return settling_time_bound(certificate, norm, (family.error_scale, 0.0, 0.0))


def judged_inertia(
    settings: LoopSettings, known: tuple[float, float] | None = None
) -> tuple[float, float]:
    """Return the inertia to judge a loop with."""
    if settings.model.is_decoupling:  # the law acts on a unit double integrator
        return settings.plant_inertia, settings.plant_inertia
    own = (settings.inertia, settings.inertia) if settings.inertia > 0.0 else None
    if known is not None and own is not None:
        return min(known[0], own[0]), max(known[1], own[1])
    if known is not None:
        return known
    if own is not None:
        return own
    raise SettingError(
        f"the inertia of {settings.joint!r} is unknown: give --inertia or --urdf, or set the "
        f"parameter inertia"
    )


def _multipliers(settings: LoopSettings) -> tuple[float, float]:
    """Return the least and the largest factor of the bandwidth, lam = n^mu.

    The derivative gain is multiplied by lam, the proportional one by its square, the integral
    one by its cube. Source: the paper, equation (8).
    """
    cap = min(settings.norm.cap, LARGEST_QUOTED_NORM)
    floor, degree = min(settings.norm_floor, cap), settings.degree
    at_floor = math.inf if floor == 0.0 and degree < 0.0 else math.pow(floor, degree)
    least, largest = sorted((at_floor, math.pow(cap, degree)))
    return least, largest


CERTIFICATES = "certificates"
"""Key of a file of certificates by name; a name may have several (corners of ranges of gains)."""


class CertificateVerification(NamedTuple):
    """What became of one saved certificate."""

    holds: bool  # whether it holds
    text: str  # for people: the certified degrees and the margin, or why it does not


def certificates(controllers: Mapping[str, Sequence[LoopSettings]]) -> dict[str, Any]:
    """Certify every homogeneous loop whose inertia is known."""
    loops = {
        f"{label} {each.joint}": each
        for label, settings in controllers.items()
        for each in settings
        if each.is_homogeneous and each.plant_inertia > 0.0 and each.gains.i > 0.0
    }
    verdicts = check_gains(
        [(each, (each.plant_inertia, each.plant_inertia)) for each in loops.values()]
    )
    return {
        CERTIFICATES: {
            name: verdict.certificate or {"reason": verdict.reason}
            for name, verdict in zip(loops, verdicts, strict=True)
        }
    }


def saved_certificates(path: Path) -> dict[str, list[Mapping[str, Any]]]:
    """Return the certificates of a file by name; empty when it is another kind of file."""
    if path.suffix != ".json":
        return {}
    document = load_json(path)
    found = document.get(CERTIFICATES) if isinstance(document, Mapping) else None
    if not isinstance(found, Mapping):
        return {}
    return {name: each if isinstance(each, list) else [each] for name, each in found.items()}


def verify_certificates(saved: Sequence[Mapping[str, Any]]) -> CertificateVerification:
    """Check a loop's saved certificates again, without anything of the search that found them."""
    found = []
    for number, each in enumerate(saved, 1):
        where = f"certificate {number} of {len(saved)} " if len(saved) > 1 else ""
        if isinstance(each, Mapping) and "reason" in each:
            return CertificateVerification(False, f"none was found: {each['reason']}")
        certificate = Certificate.from_mapping(each)
        try:
            rate = verify_certificate(certificate).rate
        except (GainError, np.linalg.LinAlgError) as error:
            return CertificateVerification(False, f"{where}does NOT hold: {error}")
        found.append((certificate.lower, certificate.upper, rate))
    if not found:
        return CertificateVerification(False, "none was found")
    lowers, uppers, rates = zip(*found, strict=True)
    holds = "holds" if len(found) == 1 else f"all {len(found)} hold"
    degrees = f"mu {min(lowers):+.3f} to {max(uppers):+.3f}"
    return CertificateVerification(True, f"{holds}, {degrees}, least rate {min(rates):.3g} 1/s")

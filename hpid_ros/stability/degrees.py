"""Certified degrees of many loops: each kind of loop computed once, the kinds on all cores.

Two loops are of one kind if they differ by their units alone: by the scale of the error, of time
and of effort. Joints that were tuned by one rule are of one kind, and so are the controllers of
one joint that differ in their degree.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import NamedTuple

from hpid_ros.base.errors import GainError, NormError, SettingError
from hpid_ros.base.processes import side_by_side
from hpid_ros.control.assembly import make_norm
from hpid_ros.control.homogeneous_pid import Gains, is_hurwitz
from hpid_ros.control.norms import NormFamily, NormType
from hpid_ros.control.settings import LoopSettings
from hpid_ros.stability.closed_loop import (
    Certificate,
    CertifiedSpan,
    DegreeInterval,
    Matrix,
    effective_gains,
)
from hpid_ros.stability.verdict import (
    certified_degree_interval,
    certify_degree,
    require_certifiable,
)

Loop = tuple[LoopSettings, tuple[float, float]]
"""Settings, and the least and the largest inertia in [kg m^2]."""

_DIGITS = 12  # rounding when units are changed; a certificate's margins are far larger


class LoopKind(NamedTuple):
    """A loop in its own units: ``norm.error_scale`` 1, i 1, and 1 the largest inertia."""

    p: float  # proportional gain
    d: float  # derivative gain
    least_inertia: float
    norm_type: NormType
    rate_weight: float  # weight of the error rate in the norm


def certified_degrees(
    loops: Sequence[Loop], tell: Callable[[Sequence[str]], None] = lambda joints: None
) -> list[DegreeInterval | GainError]:
    """Certify many loops, see :func:`~hpid_ros.stability.verdict.certified_degree_interval`."""
    found: list[DegreeInterval | GainError | None] = [None] * len(loops)
    places: dict[LoopKind, list[int]] = {}
    for place, (settings, inertia) in enumerate(loops):
        try:
            require_certifiable(settings.gains, inertia)
        except GainError as error:
            found[place] = error
            tell([settings.joint])
        else:
            places.setdefault(kind_of(settings, inertia), []).append(place)
    for kind, interval in _computed(list(places)):
        for place in places[kind]:
            found[place] = _in_physical_units(interval, *loops[place])
        tell([loops[place][0].joint for place in places[kind]])
    return [each for each in found if each is not None]


def kind_of(settings: LoopSettings, inertia: tuple[float, float]) -> LoopKind:
    """Return a loop's kind."""
    least, largest = inertia
    rate, norm = _rate(settings.gains, largest), settings.norm_family
    numbers = (
        settings.gains.p / (largest * rate**2),
        settings.gains.d / (largest * rate),
        least / largest,
        norm.rate_weight * norm.error_scale * rate,
    )
    p, d, least_inertia, rate_weight = (float(f"{each:.{_DIGITS}g}") for each in numbers)
    return LoopKind(p, d, least_inertia, norm.type, rate_weight)


def _rate(gains: Gains, inertia: float) -> float:
    """Return the loop's unit of rate in [1/s]."""
    return float((gains.i / inertia) ** (1.0 / 3.0))


def _computed(
    kinds: Sequence[LoopKind],
) -> Iterator[tuple[LoopKind, DegreeInterval | None]]:
    """Yield the interval of each kind as it becomes known, or None where there is none."""
    for place, interval in side_by_side(_interval, kinds):
        yield kinds[place], interval


def _interval(kind: LoopKind) -> DegreeInterval | None:
    try:
        return certified_degree_interval(
            Gains(kind.p, 1.0, kind.d),
            NormFamily(kind.norm_type, 1.0, kind.rate_weight),
            (kind.least_inertia, 1.0),
        )
    except GainError:
        return None


def _in_physical_units(
    interval: DegreeInterval | None, settings: LoopSettings, inertia: tuple[float, float]
) -> DegreeInterval | GainError:
    gains, (least, largest) = settings.gains, inertia
    if interval is None:
        return GainError(
            f"not even degree 0 is certified: p d = {gains.p * gains.d:g} must exceed i x inertia "
            f"= {gains.i * largest:g} by more"
        )
    family = settings.norm_family
    rate, scale = _rate(gains, largest), family.error_scale
    units = [scale, scale * rate, scale * rate**2]
    certificate = interval.certificate
    middle = [0.5 * (least + largest)] * (len(certificate.inertias) - 2)
    ends = [least, largest] if len(certificate.inertias) > 1 else [largest]
    physical = dict(zip(certificate.inertias, sorted([*ends, *middle]), strict=True))

    def converted(span: CertifiedSpan) -> CertifiedSpan:
        shape: Matrix = tuple(
            tuple(value / (units[i] * units[j]) for j, value in enumerate(row))
            for i, row in enumerate(span.shape)
        )
        norms = tuple(family(norm.degree) for norm in span.norms)
        return CertifiedSpan(physical[span.inertia], norms, shape, span.rate * rate)

    return DegreeInterval(
        interval.lower,
        interval.upper,
        Certificate(gains, tuple(converted(span) for span in certificate.spans)),
    )


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
        if is_hurwitz(settings.gains, settings.plant_inertia):
            return ""
        gains, inertia = settings.gains, settings.plant_inertia
        return (
            f"unstable as a linear PID: p d = {gains.p * gains.d:g} must exceed "
            f"i x inertia = {gains.i * inertia:g}"
        )

    def refusal(self, settings: LoopSettings) -> str:
        """Return why a loop is not certified, in one line; empty if it is.

        The linear law is certified by Routh and Hurwitz, the homogeneous one at its degree by
        :func:`~hpid_ros.stability.verdict.certify_degree`, at the inertia of its settings.
        """
        reason = self.instability(settings)
        if reason or settings.degree == 0.0:
            return reason
        gains = effective_gains(settings.gains, settings.plant_inertia)
        rounded = tuple(float(f"{each:.{_GAIN_DIGITS}g}") for each in (gains.p, gains.i, gains.d))
        key = (rounded, settings.mu, settings.norm_family)
        if key not in self._known:
            self._known[key] = _reason(settings)
        return self._known[key]


def _reason(settings: LoopSettings) -> str:
    try:
        certify_degree(settings.gains, make_norm(settings), settings.plant_inertia)
    except (GainError, NormError) as error:
        return f"not certified at mu = {settings.mu:g}: {error}"
    return ""

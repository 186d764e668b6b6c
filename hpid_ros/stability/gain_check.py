"""Verdicts on one joint's gains: stable or not, for which degrees, with what margins."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.base.workers import side_by_side
from hpid_ros.control import HomogeneousPid, LoopSettings
from hpid_ros.control.gains import is_hurwitz
from hpid_ros.control.norms import GOOD_SAMPLING_MARGIN
from hpid_ros.control.settings.assembly import make_law, make_norm
from hpid_ros.stability.bounds import (
    gain_multiplier_range,
    integral_ratio,
    sampling_margin,
    settling_time_bound,
)
from hpid_ros.stability.certificate import Certificate, DegreeInterval
from hpid_ros.stability.degrees import Loop, certified_degrees
from hpid_ros.stability.verdict import certify_degree

LARGEST_NORM = 2.0
"""The error at ``norm.error_scale`` while the rate adds as much: where figures are quoted."""


@dataclass(frozen=True)
class GainVerdict:
    """What is known of one joint's loop."""

    joint: str
    law: str  # pid or hpid
    degree: float  # the configured degree; 0 for the linear law
    inertia: tuple[float, float]  # [kg m^2] least and largest inertia
    is_certified: bool  # whether the loop is certified at the configured degree and every inertia
    reason: str  # why it is not; empty when it is
    interval: tuple[float, float] | None  # certified degrees, or None when there are none
    integral_ratio: float  # rho = m ki / (kp kd) at the largest inertia
    sampling_margin: float  # t kd lam_max / m at the least inertia
    multipliers: tuple[float, float]  # least and largest factor of the bandwidth, up to norm 2
    # [s] time after which an error of norm.error_scale has certainly come down to a hundredth
    settling_bound: float | None
    certificate: dict[str, Any] | None  # the certificate as plain data, or None

    @property
    def is_sampled_fast_enough(self) -> bool:
        """Whether sampling is not felt."""
        return self.sampling_margin <= GOOD_SAMPLING_MARGIN

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return dataclasses.asdict(self)


def check_gains(
    loops: Sequence[Loop], tell: Callable[[Sequence[str]], None] = lambda joints: None
) -> list[GainVerdict]:
    """Judge several loops, side by side on the machine's cores."""
    for settings, inertia in loops:
        _require_inertia(settings.joint, inertia)
    found = certified_degrees(loops, tell)
    tasks = [(*loop, each) for loop, each in zip(loops, found, strict=True)]
    verdicts = dict(side_by_side(_verdict, tasks, name=lambda task: task[0].joint))
    return [verdicts[place] for place in range(len(tasks))]


def judge(settings: LoopSettings, inertia: tuple[float, float]) -> GainVerdict:
    """Judge one loop."""
    return check_gains([(settings, inertia)])[0]


def _require_inertia(joint: str, inertia: tuple[float, float]) -> None:
    low, high = inertia
    if not 0.0 < low <= high < float("inf"):
        raise GainError(
            f"the inertia of {joint!r} must be positive and finite, its least value not "
            f"above its largest, not {low} to {high} kg m^2"
        )


def _verdict(
    task: tuple[LoopSettings, tuple[float, float], DegreeInterval | GainError],
) -> GainVerdict:
    settings, inertia, found = task
    low, high = inertia
    gains = settings.gains
    degree = settings.degree
    multipliers = _multipliers(settings)
    interval, certificate, bound, reason = None, None, None, ""
    if isinstance(found, DegreeInterval):
        interval, certificate = (found.lower, found.upper), found.certificate.to_mapping()
        if found.contains(degree):
            bound = _settling_bound(settings, degree, inertia, found.certificate)
        elif settings.law == "hpid":
            reason = f"mu = {degree:g} is outside the certified interval"
    elif not is_hurwitz(gains, high):
        reason = (
            f"unstable as a linear PID: p d = {gains.p * gains.d:g} must exceed i x inertia = "
            f"{gains.i * high:g}"
        )
    elif degree != 0.0:  # Hurwitz decides for the linear law
        reason = str(found)
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
    settings: LoopSettings, degree: float, inertia: tuple[float, float], certificate: Certificate
) -> float:
    """Return the bound by a certificate of this degree alone, which is tighter than a span's."""
    family = settings.norm_family
    norm, start = family(degree), (family.error_scale, 0.0, 0.0)
    try:
        own = certify_degree(settings.gains, norm, inertia)
    except GainError:  # it was found from its neighbours only
        own = certificate
    return settling_time_bound(own, norm, start)


def inertia_of(
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
    law = make_law(settings)
    if not isinstance(law, HomogeneousPid):
        return 1.0, 1.0
    cap = min(law.norm_cap, LARGEST_NORM)
    least, largest = gain_multiplier_range(
        make_norm(settings), floor=min(law.norm_floor, cap), cap=cap
    )
    return least, largest

r"""Performance indices of a run, and nothing else: arrays in, named numbers out.

IVC, IAVC, ITAE of each joint and the L2 norms over all joints, as in the paper's section
"Experimental assessment of HPID on the mobile manipulator"; and further ones: docs/indices.md.

Quadrature: see :mod:`~hpid_ros.analysis.indices.integrals`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from hpid_ros.analysis.conditions import conditions_of
from hpid_ros.analysis.indices.effort import chatter, energy, saturation_share
from hpid_ros.analysis.indices.integrals import (
    integral_of_absolute,
    itae,
    l2_norm,
    root_mean_square,
    square_integral,
    total_variation,
)
from hpid_ros.analysis.indices.step_response import find_steps, step_response
from hpid_ros.analysis.quantities import (
    EFFORT_L2,
    ERROR_L2,
    IAVC,
    INDICES,
    ITAE,
    IVC,
    NORMS,
    QUANTITIES,
    STEP_QUANTITIES,
    Data,
    Fold,
    Quantity,
    folded,
)
from hpid_ros.analysis.results import JointIndices, RunIndices
from hpid_ros.base.errors import unknown_name
from hpid_ros.recordings.quality import HELD, HOLD, MEASURED, NO_EFFORT, NO_REFERENCE
from hpid_ros.recordings.series import JointSeries, RunSeries, SeriesError

__all__ = [
    "EFFORT_L2",
    "ERROR_L2",
    "IAVC",
    "INDICES",
    "ITAE",
    "IVC",
    "NORMS",
    "IndexSettings",
    "JointIndices",
    "Quantity",
    "RunIndices",
    "integral_of_absolute",
    "itae",
    "joint_indices",
    "l2_norm",
    "run_indices",
    "total_variation",
]

DEFAULT_CUTOFF = 20.0
"""Above what motions of an arm hold and below what its drives follow, in [Hz]."""


@dataclass(frozen=True)
class IndexSettings:
    """What some of the indices need beside the arrays."""

    cutoff: float = DEFAULT_CUTOFF  # [Hz] frequency above which effort counts as chatter
    effort_limits: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        limits = {f"effort limit of {name}": value for name, value in self.effort_limits.items()}
        for name, value in {"cut-off": self.cutoff, **limits}.items():
            if not (math.isfinite(value) and value > 0.0):
                raise SeriesError(f"the {name} must be positive and finite, not {value}")


def joint_indices(series: JointSeries, settings: IndexSettings | None = None) -> JointIndices:
    """Return the indices of one joint; time counts from its first state.

    What needs a reference or efforts that the joint does not have is not defined (nan).
    """
    t, u = series.command_time, series.effort
    return JointIndices(
        ivc=total_variation(u) if series.has_effort else math.nan,
        iavc=integral_of_absolute(t, u) if series.has_effort else math.nan,
        itae=itae(series.time, series.error) if series.has_reference else math.nan,
        further=_further(series, settings or IndexSettings()),
    )


def run_indices(run: RunSeries, settings: IndexSettings | None = None) -> RunIndices:
    """Return all numbers of one run.

    The squares of the L2 norms are sums of the joints' own integrals, which equals the paper's
    integral of the sum and needs no stamps in common.
    """
    settings = settings or IndexSettings()
    for name in settings.effort_limits:
        if name not in run.joint_names:
            raise SeriesError(unknown_name("joint", name, run.joint_names))
    joints = {series.joint: joint_indices(series, settings) for series in run.joints}
    lacking = _lacking(run)
    missing = {data for reasons in lacking.values() for data in reasons}
    return RunIndices(
        label=run.label,
        joints=joints,
        totals=_totals(joints.values(), missing),
        effort_l2=math.nan if Data.EFFORT in missing else _effort_norm(run),
        error_l2=math.nan if Data.REFERENCE in missing else _error_norm(run),
        quantities=tuple(QUANTITIES.values()),
        conditions=conditions_of(run, settings.cutoff),
        lacking=lacking,
        assumed=_assumed(run),
        slides=run.slides,
    )


def _effort_norm(run: RunSeries) -> float:
    return math.sqrt(math.fsum(square_integral(s.command_time, s.effort) for s in run.joints))


def _error_norm(run: RunSeries) -> float:
    return math.sqrt(math.fsum(square_integral(s.time, s.error) for s in run.joints))


def _lacking(run: RunSeries) -> dict[str, dict[Data, str]]:
    """Return which joints lack a reference or efforts, and why."""
    lacking: dict[str, dict[Data, str]] = {}
    for series in run.joints:
        quality = run.quality.joints.get(series.joint)
        if not series.has_reference:
            lacking.setdefault(series.joint, {})[Data.REFERENCE] = NO_REFERENCE
        if not series.has_effort:
            reason = NO_EFFORT if quality is None else quality.no_effort or NO_EFFORT
            lacking.setdefault(series.joint, {})[Data.EFFORT] = reason
    return lacking


def _assumed(run: RunSeries) -> dict[Data, str]:
    """Return what stands in for a recorded reference or commanded efforts."""
    qualities = run.quality.joints.values()
    assumed = {}
    if any(each.reference == HOLD for each in qualities):
        assumed[Data.REFERENCE] = HELD
    measured = dict.fromkeys(q.effort for q in qualities if q.effort.startswith(MEASURED))
    if measured:
        assumed[Data.EFFORT] = " and ".join(measured)
    return assumed


def _totals(joints: Iterable[JointIndices], missing: Collection[Data]) -> JointIndices:
    """Return what is so over all joints; nothing that needs what one of them lacks."""
    numbers = list(joints)
    sums = {each.key: math.fsum(joint.value(each) for joint in numbers) for each in INDICES}
    further = {}
    for key, quantity in QUANTITIES.items():
        if quantity in INDICES or quantity in NORMS or quantity.needs in missing:
            continue
        values = [joint.further[key] for joint in numbers if key in joint.further]
        if quantity.fold is Fold.SUM and len(values) < len(numbers):
            continue  # a sum without one of its joints would be too small
        total = folded(quantity.fold, values)
        if total is not None:
            further[key] = total
    return JointIndices(**sums, further=further)


def _further(series: JointSeries, settings: IndexSettings) -> dict[str, float]:
    # The order of the keys is that of files.
    numbers: dict[str, float | None] = {}
    if series.has_reference:
        numbers |= _error_numbers(series)
    if series.has_effort:
        numbers["effort_l2"] = l2_norm(series.command_time, series.effort)
    if series.has_reference:
        numbers |= _worst_step(series)
    if series.has_effort:
        numbers |= {
            "saturation": saturation_share(series, settings.effort_limits.get(series.joint)),
            "chatter": chatter(series, settings.cutoff),
            "energy": energy(series),
        }
    return {key: value for key, value in numbers.items() if value is not None}


def _error_numbers(series: JointSeries) -> dict[str, float]:
    # A function of its own: of an hour's series the error is not kept beside what comes next.
    t, error = series.time, series.error
    ise = square_integral(t, error)
    return {
        "iae": integral_of_absolute(t, error),
        "ise": ise,
        "rmse": root_mean_square(t, error),
        "error_max": max(float(error.max()), -float(error.min())),
        "error_l2": math.sqrt(ise),
    }


def _worst_step(series: JointSeries) -> dict[str, float | None]:
    """Return each number of the steps' responses at its worst; nothing without a step."""
    responses = [step_response(series, step) for step in find_steps(series)]
    return {
        quantity.key: max((getattr(each, quantity.key) for each in responses), default=None)
        for quantity in STEP_QUANTITIES
    }

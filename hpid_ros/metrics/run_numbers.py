r"""The numbers of a run, computed from its arrays.

IVC, IAVC, ITAE of each joint and the L2 norms over all joints, as in the paper's section
"Experimental assessment of HPID on the mobile manipulator"; and further ones: docs/indices.md.

Quadrature: see :mod:`~hpid_ros.metrics.indices`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import listed_names, unknown_name
from hpid_ros.messages.quality import GIVEN, HELD, HOLD, MEASURED, NO_EFFORT, NO_REFERENCE, NONE
from hpid_ros.messages.series import JointSeries, RunSeries, SeriesError
from hpid_ros.metrics.alignment import JointCourse, course_of, outline_of
from hpid_ros.metrics.conditions import Conditions, knots_of
from hpid_ros.metrics.indices import (
    chatter,
    energy,
    find_steps,
    integral_of_absolute,
    itae,
    root_mean_square_of_parts,
    saturation_share,
    square_integral,
    step_response,
    total_variation,
)
from hpid_ros.metrics.quantities import (
    EFFORT_L2,
    ERROR_L2,
    L2_NORMS,
    QUANTITIES,
    STEP_QUANTITIES,
    Data,
    Fold,
    Quantity,
    folded,
)
from hpid_ros.metrics.results import Indices, RunIndices


class _JointNumbers(NamedTuple):
    """All that is kept of one joint."""

    indices: Indices
    effort_square: float | None  # integral over time; None without efforts
    error_square: float | None  # None without a reference
    knots: tuple[float, ...]  # of its reference; empty without one
    effort_times: tuple[float, float] | None  # [s] from the first to the last, mean period
    course: JointCourse


def _numbers_of(
    series: JointSeries, start_ns: int, cutoff: float, effort_limit: float | None
) -> _JointNumbers:
    time = float(np.ptp(series.command_time)) if series.has_effort else 0.0
    effort_square = _effort_square(series)
    indices = _joint_indices(series, cutoff, effort_limit, effort_square)
    return _JointNumbers(
        indices,
        effort_square,
        indices["ise"] if series.has_reference else None,
        knots_of(series) if series.has_reference else (),
        (time, time / max(1, series.effort.size - 1)) if series.has_effort else None,
        course_of(series, start_ns),
    )


def _conditions_of(
    run: RunSeries, numbers: Mapping[str, _JointNumbers], cutoff: float
) -> Conditions:
    states = max(each.states for each in run.outlines)
    return Conditions(
        duration=run.duration,
        period=run.duration / max(1, states - 1),
        cutoff=cutoff,
        references={joint: each.knots for joint, each in numbers.items() if each.knots},
        clock=next((each.state_clock for each in run.quality.joints.values()), "header"),
        outline=outline_of(run, {joint: each.course for joint, each in numbers.items()}),
        efforts={
            joint: each.effort_times
            for joint, each in numbers.items()
            if each.effort_times is not None
        },
    )


DEFAULT_CUTOFF = 20.0  # [Hz] above what motions of an arm hold, below what its drives follow


def joint_indices(
    series: JointSeries, cutoff: float = DEFAULT_CUTOFF, effort_limit: float | None = None
) -> Indices:
    """Return the indices of one joint; time counts from its first state.

    What needs a reference or efforts that the joint does not have is not there.
    """
    return _joint_indices(series, cutoff, effort_limit, _effort_square(series))


def _effort_square(series: JointSeries) -> float | None:
    """Return the integral of a joint's squared effort; None without efforts."""
    return square_integral(series.command_time, series.effort) if series.has_effort else None


def _joint_indices(
    series: JointSeries, cutoff: float, effort_limit: float | None, effort_square: float | None
) -> Indices:
    # The order of the keys is that of files.
    numbers: dict[str, float | None] = {}
    t, u = series.command_time, series.effort
    if series.has_effort:
        numbers |= {"ivc": total_variation(u), "iavc": integral_of_absolute(t, u)}
    if series.has_reference:
        numbers |= _error_numbers(series)
    if effort_square is not None:
        numbers["effort_l2"] = math.sqrt(effort_square)
    if series.has_reference:
        numbers |= _worst_step(series)
    if series.has_effort:
        numbers |= {
            "saturation": saturation_share(series, effort_limit),
            "chatter": chatter(series, cutoff),
            "energy": energy(series),
        }
    return {key: value for key, value in numbers.items() if value is not None}


def run_indices(
    run: RunSeries,
    cutoff: float = DEFAULT_CUTOFF,
    effort_limits: Mapping[str, float] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> RunIndices:
    """Return all numbers of one run.

    The squares of the L2 norms are sums of the joints' own integrals, which equals the paper's
    integral of the sum and needs no stamps in common.
    """
    limits = effort_limits or {}
    for name in limits:
        if name not in run.joint_names:
            raise SeriesError(unknown_name("joint", name, run.joint_names))
    texts = {f"effort limit of {name}": value for name, value in limits.items()}
    for name, value in {"cut-off": cutoff, **texts}.items():
        if not (math.isfinite(value) and value > 0.0):
            raise SeriesError(f"the {name} must be positive and finite, not {value}")
    numbers: dict[str, _JointNumbers] = {}
    for each in run.joints:
        progress(len(numbers) / len(run.joints))
        limit = limits.get(each.joint)
        numbers[each.joint] = _numbers_of(each, run.start_ns, cutoff, limit)
    joints = {joint: each.indices for joint, each in numbers.items()}
    lacking = _lacking(run)
    norms = {}
    for norm, squares in (
        (EFFORT_L2, [each.effort_square for each in numbers.values()]),
        (ERROR_L2, [each.error_square for each in numbers.values()]),
    ):
        if known := [each for each in squares if each is not None]:
            norms[norm.key] = math.sqrt(math.fsum(known))
    return RunIndices(
        label=run.label,
        joints=joints,
        totals=_totals(joints, lacking) | norms,
        quantities=tuple(QUANTITIES.values()),
        conditions=_conditions_of(run, numbers, cutoff),
        lacking=lacking,
        assumed=_assumed(run),
        against={
            name: against_text(each.reference)
            for name, each in run.quality.joints.items()
            if each.reference not in (NONE, HOLD)
        },
        slides=run.slides,
    )


def l2_of_run(run: RunSeries, quantity: Quantity) -> float:
    """Return one of the L2 norms over all joints of a run; nan where no joint has it."""
    if quantity == EFFORT_L2:
        squares = [
            square_integral(each.command_time, each.effort)
            for each in run.joints
            if each.has_effort
        ]
    else:
        squares = [square_of_error(each) for each in run.joints if each.has_reference]
    return math.sqrt(math.fsum(squares)) if squares else math.nan


def against_text(reference: str) -> str:
    """Return what an error is measured against, ``/joint_trajectory (trajectory)``.

    Args:
        reference: As :attr:`DataQuality.reference` names it, ``trajectory /joint_trajectory``.
    """
    if reference == GIVEN:
        return "the trajectory that was given"
    topics: dict[str, list[str]] = {}
    for part in reference.split(" and "):
        kind, _, topic = part.partition(" ")
        topics.setdefault(kind, []).append(topic)
    return " and ".join(
        f"{' and '.join(named)} ({kind})" if any(named) else kind for kind, named in topics.items()
    )


def _lacking(run: RunSeries) -> dict[str, dict[Data, str]]:
    """Return which joints lack a reference or efforts, and why."""
    lacking: dict[str, dict[Data, str]] = {}
    for each in run.outlines:
        quality = run.quality.joints.get(each.joint)
        if not each.has_reference:
            lacking.setdefault(each.joint, {})[Data.REFERENCE] = NO_REFERENCE
        if not each.commands:
            reason = NO_EFFORT if quality is None else quality.no_effort or NO_EFFORT
            lacking.setdefault(each.joint, {})[Data.EFFORT] = reason
    return lacking


def _assumed(run: RunSeries) -> dict[Data, str]:
    """Return what stands in for a recorded reference or commanded efforts."""
    qualities = run.quality.joints.values()
    assumed = {}
    if any(each.reference == HOLD for each in qualities):
        assumed[Data.REFERENCE] = HELD
    measured: dict[str, list[str]] = {}
    for joint, each in run.quality.joints.items():
        if each.effort.startswith(MEASURED):
            measured.setdefault(each.effort, []).append(joint)
    is_every = not any(q.effort != NONE and q.effort not in measured for q in qualities)
    if measured:
        assumed[Data.EFFORT] = " and ".join(
            text if is_every else f"{text} ({listed_names(joints)})"
            for text, joints in measured.items()
        )
    return assumed


def _totals(
    joints: Mapping[str, Indices], lacking: Mapping[str, Mapping[Data, str]]
) -> dict[str, float]:
    """Return what is so over all joints that have what a quantity needs."""
    totals = {}
    for quantity in QUANTITIES.values():
        if quantity in L2_NORMS:
            continue
        numbers = [
            each for name, each in joints.items() if quantity.needs not in lacking.get(name, {})
        ]
        values = [joint[quantity.key] for joint in numbers if quantity.key in joint]
        if quantity.fold in (Fold.SUM, Fold.EUCLIDEAN) and len(values) < len(numbers):
            continue  # a sum without one of its joints would be too small
        if values:
            totals[quantity.key] = folded(quantity.fold, values)
    return totals


def _error_numbers(series: JointSeries) -> dict[str, float]:
    # A function of its own: of an hour's series the error is not kept with what comes next.
    t, error = series.time, series.error
    parts = [(t[each], error[each]) for each in series.referenced]
    ise = math.fsum(square_integral(*part) for part in parts)
    span = math.fsum(float(t[-1] - t[0]) for t, _ in parts)
    return {
        "itae": math.fsum(itae(*part) for part in parts),
        "iae": math.fsum(integral_of_absolute(*part) for part in parts),
        "ise": ise,
        "rmse": math.sqrt(ise / span) if span else root_mean_square_of_parts(parts),
        "error_max": max(max(float(e.max()), -float(e.min())) for _, e in parts),
        "error_l2": math.sqrt(ise),
    }


def square_of_error(series: JointSeries) -> float:
    """Return the integral of a joint's squared error over all stretches with a reference."""
    t, error = series.time, series.error
    return math.fsum(square_integral(t[each], error[each]) for each in series.referenced)


def _worst_step(series: JointSeries) -> dict[str, float | None]:
    """Return each number of the steps' responses at its worst; nothing without a step."""
    responses = [step_response(part, step) for part in series.parts() for step in find_steps(part)]
    return {
        quantity.key: max((getattr(each, quantity.key) for each in responses), default=None)
        for quantity in STEP_QUANTITIES
    }

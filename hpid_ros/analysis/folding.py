"""Repeated runs under one label become one: medians and quartiles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from hpid_ros.analysis.quantities import INDICES, NORMS, Data, Quantity
from hpid_ros.analysis.results import JointIndices, RunIndices, Spread
from hpid_ros.recordings.series import SeriesError

Pair = tuple[float, float]


def fold_repeats(runs: Sequence[RunIndices]) -> tuple[RunIndices, ...]:
    """Return one run for each label, in the order of the labels' first runs."""
    groups: dict[str, list[RunIndices]] = {}
    for run in runs:
        groups.setdefault(run.label, []).append(run)
    return tuple(
        group[0] if len(group) == 1 else _folded(label, group) for label, group in groups.items()
    )


def median_and_quartiles(values: Sequence[float]) -> tuple[float, Pair]:
    """Return the median and, by linear interpolation, the first and third quartile."""
    ordered = sorted(values)
    if len(ordered) == 1:
        return ordered[0], (ordered[0], ordered[0])
    return _quantile(ordered, 0.5), (_quantile(ordered, 0.25), _quantile(ordered, 0.75))


def _quantile(ordered: Sequence[float], share: float) -> float:
    place = share * (len(ordered) - 1)
    k = min(math.floor(place), len(ordered) - 2)
    low, high = ordered[k], ordered[k + 1]
    part = place - k
    if part == 0.0 or low == high:
        return low
    return low + part * (high - low)


def _folded(label: str, runs: Sequence[RunIndices]) -> RunIndices:
    first = runs[0]
    for run in runs[1:]:
        if set(run.joints) != set(first.joints):
            raise SeriesError(
                f"repeats of {label!r} do not have the same joints: {', '.join(first.joints)} "
                f"and {', '.join(run.joints)}"
            )
        if run.spread is not None or first.spread is not None:
            raise SeriesError(
                f"runs of {label!r} are medians already and cannot be folded again: give the "
                "single runs, or another label"
            )
    quantities = tuple(q for q in first.quantities if all(q in run.quantities for run in runs))
    quartiles: dict[str | None, dict[str, Pair]] = {}

    def median_of(joint: str | None) -> Callable[[Quantity], float]:
        of_scope = quartiles.setdefault(joint, {})

        def median(quantity: Quantity) -> float:
            values = [run.value(quantity, joint) for run in runs]
            if any(math.isnan(value) for value in values):
                return math.nan
            middle, of_scope[quantity.key] = median_and_quartiles(values)
            return middle

        return median

    joints = {name: _median_indices(quantities, median_of(name)) for name in first.joints}
    of_all = median_of(None)
    totals = _median_indices([q for q in quantities if q not in NORMS], of_all)
    norms = {quantity.key: of_all(quantity) for quantity in NORMS}
    return RunIndices(
        label=label,
        joints=joints,
        totals=totals,
        **norms,
        quantities=quantities,
        conditions=first.conditions,
        spread=Spread(len(runs), quartiles),
        angle_unit=first.angle_unit,
        lacking={joint: merged for joint in first.joints if (merged := _lacking(runs, joint))},
        assumed={data: text for run in reversed(runs) for data, text in run.assumed.items()},
        cut=next((run.cut for run in runs if run.cut), ""),
        slides=frozenset().union(*(run.slides for run in runs)),
    )


def _lacking(runs: Sequence[RunIndices], joint: str) -> dict[Data, str]:
    """Return what any of the repeats lacks: its median is not defined."""
    return {
        data: reason
        for run in reversed(runs)
        for data, reason in run.lacking.get(joint, {}).items()
    }


def _median_indices(
    quantities: Sequence[Quantity], median: Callable[[Quantity], float]
) -> JointIndices:
    core = {quantity.key: median(quantity) for quantity in INDICES}
    further = {q.key: median(q) for q in quantities if q not in INDICES}
    known = {key: value for key, value in further.items() if not math.isnan(value)}
    return JointIndices(**core, further=known)

"""Measured recordings side by side: the comparison, and all that belongs beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.messages.series import RunSeries
from hpid_ros.metrics.comparison import Comparison, mismatches
from hpid_ros.metrics.folding import fold_repeats
from hpid_ros.metrics.measure import Measured, Measuring, measure_all
from hpid_ros.metrics.quantities import INDICES, NORMS, Data, find_quantities
from hpid_ros.metrics.results import RunIndices
from hpid_ros.metrics.saved import in_units
from hpid_ros.metrics.task import EndEffectorFigures, EndEffectorPath

Parameters = Mapping[str, Mapping[str, Mapping[str, object]]]

_REMEDIES = {
    "effort": "--commands TOPIC, --commands effort or --command-topic JOINT=TOPIC[INDEX]",
    "reference": "--reference TOPIC, FILE or hold",
}


@dataclass(frozen=True)
class Summary:
    """A comparison with what a table, figures and a report need beside its numbers."""

    comparison: Comparison  # the numbers; repeats under one label are medians
    repeats: tuple[RunIndices, ...] = ()  # the single runs of its medians
    # the first recording of each label, as far as there are recordings
    series: tuple[RunSeries, ...] = ()
    parameters: Parameters = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # what keeps the runs from being compared fairly, one line each
    sources: tuple[Path, ...] = ()  # where the numbers come from
    end_effectors: Mapping[str, EndEffectorFigures] = field(default_factory=dict)
    paths: tuple[EndEffectorPath, ...] = ()


def compare(
    bags: Sequence[Measured | Path | str],
    *,
    baseline: str | None = None,
    indices: Sequence[str] = ("paper",),
    units: str = "rad",
    how: Measuring | None = None,
) -> Comparison:
    """Return recordings side by side, with ratios to the baseline.

    Args:
        bags: What was measured, or bags, result folders and saved numbers to be measured.
        baseline: The label that ratios are taken of; that of the first if None.
        indices: Keys of quantities, or the groups ``paper``, ``step`` and ``all``.
        units: Of angles: ``rad`` or ``deg``.
        how: How bags are read that have not been measured.

    Raises:
        HpidError: A bag cannot be read, the runs' joints differ, or a name is unknown.
    """
    paths = [each for each in bags if not isinstance(each, Measured)]
    if len(paths) == len(bags):
        found = measure_all(paths, how)
    else:
        found = [
            read
            for each in bags
            for read in ([each] if isinstance(each, Measured) else measure_all([each], how))
        ]
    return summary(found, baseline=baseline, indices=indices, units=units).comparison


def summary(
    measured: Sequence[Measured],
    *,
    baseline: str | None = None,
    indices: Sequence[str] = ("paper",),
    units: str = "rad",
    is_overall: bool = False,
    names_commands: bool = False,
) -> Summary:
    """Return measured recordings side by side, with all that belongs beside the numbers."""
    single = _baseline_first(baseline, [run for each in measured for run in each.runs])
    warnings = (
        *(line for each in measured for line in each.defects),
        *_advice(single, is_measured_a_choice=not names_commands),
        *mismatches(single),
    )
    single = in_units(single, units)
    comparison = _selected(fold_repeats(single), indices, is_overall)
    _require_a_number(comparison)
    labels = [run.label for run in comparison.runs]
    first_of = {each.run.label: each for each in reversed(measured)}
    return Summary(
        comparison=comparison,
        repeats=tuple(run for run in single if comparison.run(run.label).spread),
        series=tuple(
            each.with_slides(comparison.slides) for each in _of_first(first_of, labels, "series")
        ),
        parameters={
            label: first_of[label].parameters
            for label in labels
            if label in first_of and first_of[label].parameters
        },
        warnings=warnings,
        sources=tuple(each.path for each in measured),
        end_effectors={
            label: first_of[label].end_effector  # type: ignore[misc]
            for label in labels
            if label in first_of and first_of[label].end_effector is not None
        },
        paths=_of_first(first_of, labels, "end_effector_path"),
    )


def _of_first(first_of: Mapping[str, Measured], labels: Sequence[str], what: str) -> Any:
    """Return something of the first recording of each label that has it."""
    found = (getattr(first_of[label], what) for label in labels if label in first_of)
    return tuple(each for each in found if each is not None)


def _baseline_first(baseline: str | None, runs: Sequence[RunIndices]) -> list[RunIndices]:
    if baseline is None:
        return list(runs)
    labels = [run.label for run in runs]
    if baseline not in labels:
        raise SettingError(unknown_name("baseline", baseline, set(labels)))
    return sorted(runs, key=lambda run: run.label != baseline)


def _selected(runs: Sequence[RunIndices], indices: Sequence[str], is_overall: bool) -> Comparison:
    """Return the runs with the indices that were asked for."""
    chosen = find_quantities(indices)
    if is_overall:
        return Comparison(tuple(runs), indices=(), norms=chosen)
    if chosen == (*INDICES, *NORMS):
        return Comparison(tuple(runs))
    return Comparison(tuple(runs), indices=chosen, norms=())


def _advice(runs: Sequence[RunIndices], *, is_measured_a_choice: bool) -> list[str]:
    """Return one line for each set of runs that lack something, with the options that give it."""
    labels: dict[str, list[str]] = {}
    for run in runs:
        parts = []
        if Data.EFFORT in run.assumed and is_measured_a_choice:
            parts.append(
                f"efforts are {run.assumed[Data.EFFORT]}, as nothing else carries any "
                "(--commands TOPIC or --command-topic JOINT=TOPIC[INDEX] names commands)"
            )
        for data, remedy in _REMEDIES.items():
            reasons: dict[str, list[str]] = {}
            for joint, lacking in run.lacking.items():
                for each, reason in lacking.items():
                    if each.value == data:
                        reasons.setdefault(reason, []).append(joint)
            for reason, joints in reasons.items():
                where = "" if len(joints) == len(run.joints) else f" for {', '.join(joints)}"
                parts.append(f"{reason}{where}: {remedy}")
        if parts:
            labels.setdefault("; ".join(parts), []).append(repr(run.label))
    return [
        f"run{'s' if len(names) > 1 else ''} {', '.join(dict.fromkeys(names))}: {text}"
        for text, names in labels.items()
    ]


def _require_a_number(comparison: Comparison) -> None:
    """Raise SettingError if no run has what any of the numbers asked for needs."""
    for run in comparison.runs:
        for quantity in (*comparison.indices, *comparison.norms):
            if any(quantity.needs not in run.lacking.get(joint, {}) for joint in run.joints):
                return
    lines = "; ".join(_advice(comparison.runs, is_measured_a_choice=True))
    raise SettingError(f"none of the indices asked for can be computed: {lines}")

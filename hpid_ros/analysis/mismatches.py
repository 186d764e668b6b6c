"""What keeps runs from being compared fairly, in words; the numbers are given all the same."""

from __future__ import annotations

from collections.abc import Sequence

from hpid_ros.analysis.conditions import differences
from hpid_ros.analysis.results import RunIndices


def mismatches(runs: Sequence[RunIndices]) -> list[str]:
    """Return one line for each way in which a run's conditions differ from the first run's.

    Args:
        runs: The runs, the baseline first; repeats may share a label.
    """
    lines = []
    first = runs[0]
    for run in runs[1:]:
        names = f"runs {first.label!r} and {run.label!r}"
        if run.label == first.label:
            names = f"repeats of {run.label!r}"
        if run.angle_unit != first.angle_unit:
            lines.append(f"{names}: units differ: {first.angle_unit} and {run.angle_unit}")
        if first.conditions is None or run.conditions is None:
            unknown = first.label if first.conditions is None else run.label
            lines.append(f"{names}: the conditions of {unknown!r} were not saved")
            continue
        lines += [f"{names}: {each}" for each in differences(first.conditions, run.conditions)]
    return list(dict.fromkeys(lines))

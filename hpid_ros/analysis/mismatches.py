"""What keeps two runs from being compared, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hpid_ros.analysis.conditions import NOTHING, Difference, differences
from hpid_ros.analysis.quantities import QUANTITIES, Data
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
        lines += [f"{names}: {each.text}" for each in run_differences(first, run)]
    return list(dict.fromkeys(lines))


def run_differences(one: RunIndices, other: RunIndices) -> Iterator[Difference]:
    """Yield what two runs do not share of conditions and of what their numbers stand on.

    Args:
        one: The one, the first in every pair.
        other: The other.
    """
    for data in Data:
        if (data in one.assumed) != (data in other.assumed) and not _lacks(data, one, other):
            texts = (f"{run.label}'s is {_source(run, data)}" for run in (one, other))
            keys = (key for key, each in QUANTITIES.items() if each.needs is data)
            yield Difference(f"{data.value}: {', '.join(texts)}", frozenset(keys))
    if one.conditions is None or other.conditions is None:
        unknown = one.label if one.conditions is None else other.label
        yield Difference(f"the conditions of {unknown!r} were not saved", NOTHING)
        return
    yield from differences(one.conditions, other.conditions)


def _lacks(data: Data, *runs: RunIndices) -> bool:
    """Tell whether all joints of a run lack something: there is nothing to compare then."""
    return any(all(data in run.lacking.get(joint, {}) for joint in run.joints) for run in runs)


def _source(run: RunIndices, data: Data) -> str:
    recorded = {Data.REFERENCE: "recorded", Data.EFFORT: "commanded"}
    return run.assumed.get(data, recorded[data])

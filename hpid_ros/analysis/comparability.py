"""Comparability of runs: differences in their conditions, and the time that all of them have."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from hpid_ros.analysis.conditions import DURATION_WITHIN, NOTHING, Difference, differences
from hpid_ros.analysis.quantities import QUANTITIES, Data
from hpid_ros.analysis.results import RunIndices


def mismatches(runs: Sequence[RunIndices]) -> list[str]:
    """Return one line for each way in which a run's conditions differ from the first run's."""
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
    """Yield what two runs do not share of conditions and of what their numbers stand on."""
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


SHORTEST = 0.1
"""Shorter common times, in [s], say nothing of whole motions: runs are left as they are."""


class Cut(NamedTuple):
    """The part of a recording that is common to all."""

    start: float  # [s] its begin since the first state of any joint
    end: float  # its end, likewise
    text: str  # the same in words; empty where it is the whole recording


def common_cuts(runs: Sequence[RunIndices]) -> tuple[Cut, ...]:
    """Return the part of each recording to compare; nothing if the whole ones can be.

    Recordings are laid beside each other where their references begin, as recorders are started
    by hand; where one has none, at their first states.
    """
    conditions = [run.conditions for run in runs]
    known = [each for each in conditions if each is not None]
    if len(known) < len(runs) or len(runs) < 2:
        return ()
    durations = [each.duration for each in known]
    begins = [each.reference_from for each in known]
    has_references = all(begin is not None for begin in begins)
    starts = [begin or 0.0 for begin in begins] if has_references else [0.0] * len(runs)
    room = min(duration - start for duration, start in zip(durations, starts, strict=True))
    within = DURATION_WITHIN * max(durations)
    if max(durations) - min(durations) <= within and max(starts) - min(starts) <= within:
        return ()
    if room < SHORTEST:
        return ()
    where = "its reference begins" if has_references else "its states do"
    return tuple(
        Cut(
            start,
            start + room,
            ""
            if duration - room <= DURATION_WITHIN * room
            else f"cut to {room:.4g} s of {duration:.4g} s, from {start:.4g} s on, where {where}",
        )
        for start, duration in zip(starts, durations, strict=True)
    )

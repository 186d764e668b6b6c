"""Runs folded into medians, doubts about them, and what two engines make of the same runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hpid_ros.base.text import shown
from hpid_ros.messages.series import DataQuality, JointSeries, RunSeries, SeriesError, StampQuality
from hpid_ros.metrics.comparison import ratio
from hpid_ros.metrics.quantities import NORMS, Data, Quantity
from hpid_ros.metrics.results import RunIndices, Spread, for_json

SMALL = 0.05  # an error below this is small for any joint, in [rad]
SHARE_OF_RANGE = 0.1  # so is one below this share of the reference's range
SELDOM = 0.1  # a joint follows if its error is small for at least this share of its motion
MOVED = 0.05  # a joint whose position ranges over more than this has moved, in [rad]


def unfollowed(run: RunSeries) -> dict[str, float]:
    """Return the joints whose error was small hardly ever, from where the reference moved on."""
    told = [series for series in run.joints if series.reference.size]
    least = {series.joint: _usual_least(series) for series in told}
    allowed = {
        series.joint: max(SMALL, SHARE_OF_RANGE * float(np.ptp(series.reference)))
        for series in told
    }
    return {joint: error for joint, error in least.items() if error > allowed[joint]}


def unfollowed_lines(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield a line for each run with joints that did not follow."""
    for run in runs:
        joints = unfollowed(run)
        if joints:
            shown = ", ".join(
                f"{joint} ({error:.3g} {'m' if joint in run.slides else 'rad'})"
                for joint, error in joints.items()
            )
            yield (
                f"run {run.label!r}: these joints do not follow their reference, and their ratios "
                f"say nothing of the controller: {shown}; in brackets the error that they exceed "
                f"{1 - SELDOM:.0%} of the time"
            )


def unfollowed_mapping(runs: Sequence[RunSeries]) -> Mapping[str, Mapping[str, float]]:
    """Return :func:`unfollowed` by label, of the runs that have such joints."""
    found = {run.label: unfollowed(run) for run in runs}
    return {label: joints for label, joints in found.items() if joints}


def _usual_least(series: JointSeries) -> float:
    moved = np.flatnonzero(series.reference != series.reference[0])
    error = np.abs(series.error[moved[0] :] if moved.size else series.error)
    return float(np.quantile(error, SELDOM))


COLUMNS = (
    *("joint", "stream", "clock", "samples", "rate [Hz]", "from [s]", "to [s]"),
    *("lost", "gaps", "longest gap [ms]", "at [s]", "repeated", "out of order", "not finite"),
)


def quality_lines(run: RunSeries) -> Iterator[str]:
    """Yield one line for each thing about a recording that its numbers must be read with."""
    for line in _lines(run):
        yield shown(line)


def _lines(run: RunSeries) -> Iterator[str]:
    joints = run.quality.joints
    for line in run.quality.lines:
        yield f"run {run.label!r}: {line}"
    for stream in ("states", "commands"):
        qualities = {name: getattr(quality, stream) for name, quality in joints.items()}
        parts = [f"{name}: {_defects(each)}" for name, each in qualities.items() if _defects(each)]
        if parts:
            shown = "; ".join(parts[:3]) + (f"; {len(parts) - 3} more" if len(parts) > 3 else "")
            yield f"run {run.label!r}: {stream} are not complete: {shown}"
    received = [
        stream
        for stream in ("state", "command")
        if any(getattr(each, f"{stream}_clock") == "receive" for each in joints.values())
    ]
    if received:
        streams = " and ".join(f"{stream}s" for stream in received)
        yield f"run {run.label!r}: {streams} have their receive time, not a stamp of their own"
    idle = [
        series.joint
        for series in run.joints
        if series.effort.size and not series.effort.any() and np.ptp(series.position) > MOVED
    ]
    if idle:
        yield (
            f"run {run.label!r}: every effort of {', '.join(idle)} is 0, and the joint moved: "
            "nobody commanded it, or its driver fills in what it does not measure"
        )
    yield from unfollowed_lines([run])


def quality_rows(joint: str, quality: DataQuality) -> Iterator[tuple[object, ...]]:
    """Yield the rows of a joint's states and commands, see :data:`COLUMNS`."""
    streams = (
        ("states", quality.states, quality.state_clock),
        ("commands", quality.commands, quality.command_clock),
    )
    for name, each, clock in streams:
        yield (
            *(joint, name, clock, each.count),
            f"{1.0 / each.period:.4g}" if each.period else "–",
            *(f"{each.begin:.3f}", f"{each.end:.3f}", each.lost, each.gaps),
            f"{1e3 * each.longest_gap:.3f}" if each.gaps else "–",
            f"{each.longest_gap_at:.3f}" if each.gaps else "–",
            *(each.repeated, each.out_of_order, each.not_finite),
        )


def _defects(quality: StampQuality) -> str:
    counts = {
        "lost": quality.lost,
        "repeated": quality.repeated,
        "out of order": quality.out_of_order,
        "not finite": quality.not_finite,
    }
    parts = [f"{count} {name}" for name, count in counts.items() if count]
    if quality.gaps:
        parts.append(
            f"longest gap {1e3 * quality.longest_gap:.3g} ms at {quality.longest_gap_at:.3f} s"
        )
    return ", ".join(parts)


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

    def medians(joint: str | None) -> dict[str, float]:
        found, quartiles[joint] = {}, {}
        for quantity in sorted(quantities, key=lambda each: joint is None and each in NORMS):
            values = [run.value(quantity, joint) for run in runs]
            if not any(map(math.isnan, values)):
                found[quantity.key], quartiles[joint][quantity.key] = median_and_quartiles(values)
        return found

    return RunIndices(
        label=label,
        joints={name: medians(name) for name in first.joints},
        totals=medians(None),
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


BySeed = Mapping[int, float]  # a number of each run, by its seed


@dataclass(frozen=True)
class EngineTotal:
    """One number of one controller in two engines."""

    experiment: str  # name of the experiment
    controller: str  # label of the controller
    quantity: Quantity  # which number
    values: Mapping[str, BySeed]  # by engine, the one that the other is held against first
    ratios: Mapping[str, BySeed] = field(default_factory=dict)
    unit: str = ""  # of the number; that of joints which turn if empty

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", self.unit or self.quantity.unit)

    @property
    def distances(self) -> dict[int, float]:
        """The second engine's number over the first's with the same seed, less 1, by seed."""
        against, own = self.values.values()
        found = {seed: ratio(own[seed], against[seed]) - 1.0 for seed in own if seed in against}
        return {seed: each for seed, each in found.items() if not math.isnan(each)}

    @property
    def distance(self) -> float | None:
        """Median of the distances; None if no seed has run in both engines."""
        return median([*self.distances.values()])

    @property
    def largest_distance(self) -> float | None:
        """Of the distances, the one that is farthest from 0."""
        return max(self.distances.values(), key=abs, default=None)


def median(values: Sequence[float]) -> float | None:
    """Return the median of some numbers; None of none."""
    return median_and_quartiles(values)[0] if values else None


def engine_mapping(totals: Iterable[EngineTotal]) -> dict[str, object]:
    """Return medians, ratios and distances by experiment, controller and quantity, for JSON."""
    found: dict[str, dict[str, dict[str, object]]] = {}
    for total in totals:
        of_experiment = found.setdefault(total.experiment, {})
        of_experiment.setdefault(total.controller, {})[total.quantity.key] = {
            "values": _medians(total.values),
            "ratios": _medians(total.ratios),
            "distance": for_json(total.distance),
            "largest_distance": for_json(total.largest_distance),
        }
    return {**found}


def _medians(numbers: Mapping[str, BySeed]) -> dict[str, float | None]:
    return {engine: for_json(median(list(each.values()))) for engine, each in numbers.items()}

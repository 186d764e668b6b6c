"""Runs side by side: the first is the baseline, the others are ratios of it.

Every index and norm here is a cost: a ratio below one is an improvement. Runs of unlike length,
rate or reference have no ratios: their numbers stand beside each other and say nothing. Repeats
of one run are folded into their medians.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

from hpid_ros.base.errors import unknown_name
from hpid_ros.messages.series import SeriesError
from hpid_ros.metrics.conditions import (
    EVERYTHING,
    NO_QUANTITY,
    ConditionDifference,
    condition_differences,
)
from hpid_ros.metrics.quantities import INDICES, L2_NORMS, PAPER, QUANTITIES, Data, Quantity
from hpid_ros.metrics.results import RunIndices, Spread, for_json


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


def run_differences(one: RunIndices, other: RunIndices) -> Iterator[ConditionDifference]:
    """Yield what two runs do not share of conditions and of what their numbers stand on."""
    for data in Data:
        if (data in one.assumed) != (data in other.assumed) and not _lacks(data, one, other):
            usual = {Data.REFERENCE: "recorded", Data.EFFORT: "commanded"}[data]
            texts = (f"{run.label}'s is {run.assumed.get(data, usual)}" for run in (one, other))
            keys = (key for key, each in QUANTITIES.items() if each.needs is data)
            yield ConditionDifference(f"{data.value}: {', '.join(texts)}", frozenset(keys))
    if one.conditions is None or other.conditions is None:
        unknown = one.label if one.conditions is None else other.label
        yield ConditionDifference(f"the conditions of {unknown!r} were not saved", NO_QUANTITY)
        return
    yield from condition_differences(one.conditions, other.conditions)


def _lacks(data: Data, *runs: RunIndices) -> bool:
    """Return whether all joints of a run lack something: there is nothing to compare then."""
    return any(all(data in run.lacking.get(joint, {}) for joint in run.joints) for run in runs)


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
        for quantity in sorted(quantities, key=lambda each: joint is None and each in L2_NORMS):
            values = [run.value(quantity, joint) for run in runs]
            is_of_others = joint is None and _are_of_others(quantity, *runs)
            if not is_of_others and not any(map(math.isnan, values)):
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
        against={joint: text for run in reversed(runs) for joint, text in run.against.items()},
        cut=next((run.cut for run in runs if run.cut), ""),
        shift=first.shift,
        slides=frozenset().union(*(run.slides for run in runs)),
    )


def _lacking(runs: Sequence[RunIndices], joint: str) -> dict[Data, str]:
    """Return what any of the repeats lacks: its median is not defined."""
    return {
        data: reason
        for run in reversed(runs)
        for data, reason in run.lacking.get(joint, {}).items()
    }


# Half of the last digit that tables show: what reads as 1.000 is called equal.
EQUAL_WITHIN = 5e-4
THRESHOLD = f"within {100.0 * EQUAL_WITHIN:g}%"  # how near to one a ratio counts as unchanged


class Verdict(Enum):
    """What a ratio says of a cost, and the paper's five together of a run."""

    BETTER = "better"
    WORSE = "worse"
    MIXED = "mixed"  # better in one number, worse in another
    EQUAL = "unchanged"
    UNKNOWN = "not comparable"


@dataclass(frozen=True)
class Comparison:
    """Any number of runs of the same joints; the first is the baseline."""

    runs: tuple[RunIndices, ...]  # the numbers of each run, at least one
    indices: tuple[Quantity, ...] = INDICES  # what tables show of each joint and of all
    norms: tuple[Quantity, ...] = L2_NORMS  # what they show of all joints alone

    def __post_init__(self) -> None:
        object.__setattr__(self, "runs", tuple(self.runs))
        if not self.runs:
            raise SeriesError("a comparison needs at least one run, got none")
        labels = [run.label for run in self.runs]
        if len(set(labels)) < len(labels):
            raise SeriesError(f"a comparison needs unlike labels, got {', '.join(labels)}")
        for run in self.others:
            unlike = sorted(set(run.joints) ^ set(self.baseline.joints))
            if unlike:
                shared = [name for name in self.baseline.joints if name in run.joints]
                advice = f"; choose among those that both have: {', '.join(shared)}"
                raise SeriesError(
                    f"runs {self.baseline.label!r} and {run.label!r} are not comparable, they do "
                    f"not have the same joints: only one of them has {', '.join(unlike)}"
                    f"{advice if shared else ''}"
                )
            if run.angle_unit != self.angle_unit:
                raise SeriesError(
                    f"runs {self.baseline.label!r} and {run.label!r} differ in the unit of "
                    f"angles: {self.angle_unit} and {run.angle_unit}"
                )
            if run.slides != self.slides:
                unlike = sorted(run.slides ^ self.slides)
                raise SeriesError(
                    f"runs {self.baseline.label!r} and {run.label!r} differ in the units of "
                    f"{', '.join(unlike)}: only one of them knows that it slides"
                )
        for quantity in (*self.indices, *self.norms):
            for run in self.runs:
                run.value(quantity)  # raises if it was not computed

    @property
    def baseline(self) -> RunIndices:
        """The run that the others are measured against."""
        return self.runs[0]

    @property
    def others(self) -> tuple[RunIndices, ...]:
        """All runs but the baseline."""
        return self.runs[1:]

    @property
    def angle_unit(self) -> str:
        return self.baseline.angle_unit

    @property
    def slides(self) -> frozenset[str]:
        """The joints that are known to slide, in all runs."""
        return self.baseline.slides

    def unit(self, quantity: Quantity, joint: str | None = None) -> str:
        """Return the unit of a quantity in this comparison, see :meth:`RunIndices.unit`."""
        return self.baseline.unit(quantity, joint)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the baseline's order."""
        return tuple(self.baseline.joints)

    def run(self, label: str) -> RunIndices:
        for run in self.runs:
            if run.label == label:
                return run
        raise SeriesError(unknown_name("run", label, [run.label for run in self.runs]))

    def ratio(self, label: str, quantity: Quantity, joint: str | None = None) -> float:
        """Return :func:`ratio` to the baseline's; nan where runs differ in what it depends on."""
        run = self.run(label)
        value, of_baseline = run.value(quantity, joint), self.baseline.value(quantity, joint)
        if any(quantity.key in each.spoils for each in self.differences(label)):
            return math.nan
        if joint is None and _are_of_others(quantity, self.baseline, run):
            return math.nan
        return ratio(value, of_baseline)

    def differences(self, label: str) -> tuple[ConditionDifference, ...]:
        """Return what a run and the baseline do not share, and which numbers that spoils."""
        return self._differences[self.run(label).label]

    @cached_property
    def _differences(self) -> dict[str, tuple[ConditionDifference, ...]]:
        found = {run.label: tuple(run_differences(self.baseline, run)) for run in self.others}
        return {self.baseline.label: (), **found}

    def spoilt(self, label: str) -> dict[str, list[Quantity]]:
        """Return what of the shown numbers is not compared, by why the runs do not allow it."""
        shown = (*self.indices, *self.norms)
        spoilt = {
            each.text: [quantity for quantity in shown if quantity.key in each.spoils]
            for each in self.differences(label)
        }
        return {text: quantities for text, quantities in spoilt.items() if quantities}

    def verdicts(self, label: str) -> dict[Quantity, Verdict]:
        """Return what became of the paper's five numbers over all joints."""
        return {quantity: verdict(self.ratio(label, quantity)) for quantity in PAPER}

    def worse_joints(self, label: str) -> dict[Quantity, tuple[int, int]]:
        """Return in how many of the joints with a ratio each of the paper's numbers got worse."""
        counts = {}
        for quantity in PAPER:
            kinds = [verdict(self.ratio(label, quantity, joint)) for joint in self.joint_names]
            known = len(kinds) - kinds.count(Verdict.UNKNOWN)
            if known:
                counts[quantity] = (kinds.count(Verdict.WORSE), known)
        return counts

    def judgement(self, label: str) -> Verdict:
        """Return what the paper's five numbers together say of a run beside the baseline."""
        kinds = set(self.verdicts(label).values())
        if kinds >= {Verdict.BETTER, Verdict.WORSE}:
            return Verdict.MIXED
        order = (Verdict.BETTER, Verdict.WORSE, Verdict.EQUAL)
        return next((each for each in order if each in kinds), Verdict.UNKNOWN)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the runs' numbers must be read with, one sentence each."""
        labels: dict[str, list[str]] = {}
        for run in self.runs:
            for note in run.notes:
                labels.setdefault(note, []).append(run.label)
        return tuple(f"{enumerate_words(names)}: {note}." for note, names in labels.items())

    def as_mapping(self) -> dict[str, object]:
        """Return runs and ratios as plain dicts for JSON.

        An infinite ratio becomes None, one that is not defined is absent; ``not_compared`` has
        the reasons and what they spoil, for runs that differ in more than their controllers.
        """
        mapping: dict[str, object] = {
            "baseline": self.baseline.label,
            "runs": {run.label: run.as_mapping() for run in self.runs},
            "ratios": {run.label: self._ratios(run.label) for run in self.others},
        }
        spoilt = {
            run.label: {
                each.text: "all" if each.spoils == EVERYTHING else sorted(each.spoils)
                for each in self.differences(run.label)
                if each.spoils
            }
            for run in self.others
        }
        if any(spoilt.values()):
            mapping["not_compared"] = {label: texts for label, texts in spoilt.items() if texts}
        return mapping

    def _ratios(self, label: str) -> dict[str, object]:
        run = self.run(label)
        shared = [each for each in self.baseline.quantities if each in run.quantities]

        def ratios(quantities: Iterable[Quantity], joint: str | None = None) -> dict[str, object]:
            found = {each.key: self.ratio(label, each, joint) for each in quantities}
            return {key: for_json(value) for key, value in found.items() if not math.isnan(value)}

        joints = {name: ratios(shared, name) for name in self.joint_names}
        totals = ratios(each for each in shared if each not in L2_NORMS)
        return {"joints": joints, "totals": totals, **ratios(L2_NORMS)}


def _are_of_others(quantity: Quantity, *runs: RunIndices) -> bool:
    """Return whether the totals of runs go over different joints."""
    return len({run.without(quantity.needs) for run in runs}) > 1


def ratio(value: float, baseline: float) -> float:
    """Return value / baseline for two costs.

    Two zeros and two infinities have the ratio one (nothing changed); anything against zero is
    infinite; what is not defined (nan) has no ratio (nan).
    """
    if math.isnan(value) or math.isnan(baseline):
        return math.nan
    if value == baseline:
        return 1.0
    return value / baseline if baseline else math.inf


def verdict(ratio: float) -> Verdict:
    """Return what a ratio says; what a table would show as 1.000 is equal."""
    if math.isnan(ratio):
        return Verdict.UNKNOWN
    if abs(ratio - 1.0) < EQUAL_WITHIN:
        return Verdict.EQUAL
    return Verdict.BETTER if ratio < 1.0 else Verdict.WORSE


def answer(comparison: Comparison) -> str:
    """Return in sentences what each run is better and worse in, or a single run's numbers."""
    if not comparison.others:
        sentences = [_figures(comparison.baseline)]
    else:
        sentences = [_sentences(comparison, run.label) for run in comparison.others]
        if any(_is_compared(comparison, run.label) for run in comparison.others):
            sentences.append(f"Unchanged means {THRESHOLD}.")
    return " ".join((*sentences, *comparison.notes))


def verdict_lines(comparison: Comparison) -> Iterator[str]:
    """Yield each run's verdict, and in how many joints each number is worse."""
    for run in comparison.others:
        yield _verdict_line(comparison, run.label)
        counts = _worse_joints(comparison, run.label, "/")
        if counts:
            yield f"  Joints it is worse in: {', '.join(counts)}."


def _verdict_line(comparison: Comparison, label: str) -> str:
    head = f"{label} against {comparison.baseline.label}:"
    judgement = comparison.judgement(label)
    if not _is_compared(comparison, label):
        return f"{head} {judgement.value}: {_why(comparison, label)}."
    verdicts = comparison.verdicts(label)
    parts = []
    if judgement is Verdict.MIXED:
        head += f" {judgement.value}:"
    for kind in (Verdict.BETTER, Verdict.WORSE, Verdict.EQUAL, Verdict.UNKNOWN):
        symbols = [quantity.symbol for quantity, each in verdicts.items() if each is kind]
        if symbols:
            parts.append(f"{kind.value} in {', '.join(symbols)}")
    return f"{head} {'; '.join(parts)}."


def _worse_joints(comparison: Comparison, label: str, of: str) -> list[str]:
    """Return the counts of a run as texts, none where one joint is all."""
    if len(comparison.joint_names) == 1:
        return []
    counts = comparison.worse_joints(label)
    return [f"{each.symbol} {worse}{of}{known}" for each, (worse, known) in counts.items()]


def _is_compared(comparison: Comparison, label: str) -> bool:
    return comparison.judgement(label) is not Verdict.UNKNOWN


def _sentences(comparison: Comparison, label: str) -> str:
    verdicts = comparison.verdicts(label)
    head = f"{label} against {comparison.baseline.label}, over {_joints(comparison.baseline)}"
    sentences = [f"{head}: {comparison.judgement(label).value}."]
    if not _is_compared(comparison, label):
        return f"{sentences[0].removesuffix('.')}: {_why(comparison, label)}."
    for kind in (Verdict.BETTER, Verdict.WORSE, Verdict.EQUAL):
        changes = [
            f"the {quantity.meaning} ({quantity.symbol})"
            f"{_change(comparison.ratio(label, quantity), kind)}"
            for quantity, each in verdicts.items()
            if each is kind
        ]
        if changes:
            sentences.append(f"{kind.value.capitalize()}: {enumerate_words(changes)}.")
    counts = _worse_joints(comparison, label, " of ")
    if counts:
        sentences.append(f"Joints it is worse in: {', '.join(counts)}.")
    unknown = [each for each, kind in verdicts.items() if kind is Verdict.UNKNOWN]
    if unknown:
        symbols = enumerate_words([each.symbol for each in unknown])
        sentences[0] = f"{sentences[0].removesuffix('.')} as far as can be compared."
        sentences.append(f"Not comparable: {symbols} ({_why(comparison, label)}).")
    return " ".join(sentences)


def _why(comparison: Comparison, label: str) -> str:
    """Return why some of the paper's numbers have no ratio."""
    spoils = [each.text for each in comparison.differences(label) if each.spoils]
    runs = (comparison.baseline, comparison.run(label))
    for quantity in PAPER:
        lacking = {
            run.label: list(dict.fromkeys(run.why_undefined(quantity).values())) for run in runs
        }
        if not any(lacking.values()) and _are_of_others(quantity, *runs):
            lacking = {run.label: _reasons(quantity, run) for run in runs}
        of_first, of_other = lacking.values()
        if of_first == of_other:
            spoils += of_first
        else:
            spoils += [f"{name}: {reason}" for name, each in lacking.items() for reason in each]
    return "; ".join(dict.fromkeys(spoils))


def _reasons(quantity: Quantity, run: RunIndices) -> list[str]:
    """Return why some joints of a run have no such number."""
    reasons = (run.lacking.get(name, {}).get(quantity.needs) for name in run.joints)
    return list(dict.fromkeys(each for each in reasons if each is not None))


def _figures(run: RunIndices) -> str:
    """Return a single run's own numbers."""
    duration = "" if run.conditions is None else f" and {run.conditions.duration:.4g} s"
    figures = []
    for quantity in PAPER:
        value = run.value(quantity)
        name = f"{quantity.meaning} ({quantity.symbol})"
        if math.isnan(value):
            reasons = dict.fromkeys(run.why_undefined(quantity).values())
            figures.append(f"no {name}, as {' and '.join(reasons)}")
        else:
            unit = run.unit(quantity)
            figures.append(f"{name} {value:.4g} {f'[{unit}]' if ',' in unit else unit}")
    return (
        f"{run.label} alone (there is nothing to compare it with), over {_joints(run)}{duration}: "
        f"{', '.join(figures)}."
    )


def _joints(run: RunIndices) -> str:
    count = len(run.joints)
    return "the one joint" if count == 1 else f"all {count} joints"


def _change(value: float, kind: Verdict) -> str:
    if kind is Verdict.EQUAL:
        return ""
    if math.isinf(value):
        return " from zero"
    return f" by {abs(value - 1.0):.1%}" if value < 2.0 else f" to {value:.3g} times"


def enumerate_words(items: list[str]) -> str:
    """Return items as a list in words."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"

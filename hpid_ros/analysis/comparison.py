"""Runs side by side: the first is the baseline, the others are ratios of it.

Every index and norm here is a cost: a ratio below one is an improvement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from hpid_ros.analysis.indices import INDICES, NORMS, Quantity, RunIndices
from hpid_ros.analysis.series import SeriesError
from hpid_ros.errors import unknown_name

# Half of the last digit that tables show: what reads as 1.000 is called equal.
EQUAL_WITHIN = 5e-4


class Verdict(Enum):
    """What a ratio says of a cost, and the words for what the run did to it."""

    BETTER = "lowered {}"
    WORSE = "raised {}"
    EQUAL = "left {} unchanged"
    UNKNOWN = "has no comparable {}"


@dataclass(frozen=True)
class Comparison:
    """Any number of runs of the same joints; the first is the baseline.

    Attributes:
        runs: The numbers of each run, at least one.
        indices: What tables show of each joint and of all.
        norms: What they show of all joints alone.

    Raises:
        SeriesError: If there is no run, a label occurs twice, or the runs' joints, their units
            of angles or what was computed of them differ.
    """

    runs: tuple[RunIndices, ...]
    indices: tuple[Quantity, ...] = INDICES
    norms: tuple[Quantity, ...] = NORMS

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
                raise SeriesError(
                    f"runs {self.baseline.label!r} and {run.label!r} do not have the same "
                    f"joints: only one of them has {', '.join(unlike)}"
                )
            if run.angle_unit != self.angle_unit:
                raise SeriesError(
                    f"runs {self.baseline.label!r} and {run.label!r} differ in the unit of "
                    f"angles: {self.angle_unit} and {run.angle_unit}"
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
        """The unit of angles in all numbers."""
        return self.baseline.angle_unit

    def unit(self, quantity: Quantity) -> str:
        """Return the unit of a quantity in this comparison.

        Args:
            quantity: Which one.
        """
        return quantity.unit_in(self.angle_unit)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the baseline's order."""
        return tuple(self.baseline.joints)

    def run(self, label: str) -> RunIndices:
        """Return the run of that label.

        Args:
            label: The label.

        Raises:
            SeriesError: If there is none.
        """
        for run in self.runs:
            if run.label == label:
                return run
        raise SeriesError(unknown_name("run", label, [run.label for run in self.runs]))

    def ratio(self, label: str, quantity: Quantity, joint: str | None = None) -> float:
        """Return one number of a run divided by the baseline's, see :func:`ratio`.

        Args:
            label: The run.
            quantity: Which number.
            joint: The joint, or None for all of them.

        Raises:
            SeriesError: If there is no such run or joint.
        """
        return ratio(self.run(label).value(quantity, joint), self.baseline.value(quantity, joint))

    def as_mapping(self) -> dict[str, object]:
        """Return runs and ratios as plain dicts for JSON; an infinite ratio becomes None."""
        return {
            "baseline": self.baseline.label,
            "runs": {run.label: run.as_mapping() for run in self.runs},
            "ratios": {run.label: self._ratios(run.label) for run in self.others},
        }

    def _ratios(self, label: str) -> dict[str, object]:
        def finite(quantity: Quantity, joint: str | None = None) -> float | None:
            value = self.ratio(label, quantity, joint)
            return value if math.isfinite(value) else None

        shared = self._shared(self.run(label))
        joints = {
            name: {q.key: finite(q, name) for q in shared if self._is_defined(label, q, name)}
            for name in self.joint_names
        }
        of_all = [q for q in shared if q not in NORMS and self._is_defined(label, q)]
        totals = {quantity.key: finite(quantity) for quantity in of_all}
        return {
            "joints": joints,
            "totals": totals,
            **{quantity.key: finite(quantity) for quantity in NORMS},
        }

    def _shared(self, run: RunIndices) -> list[Quantity]:
        return [q for q in self.baseline.quantities if q in run.quantities]

    def _is_defined(self, label: str, quantity: Quantity, joint: str | None = None) -> bool:
        return not math.isnan(self.ratio(label, quantity, joint))


def ratio(value: float, baseline: float) -> float:
    """Return value / baseline for two costs.

    Two zeros and two infinities have the ratio one (nothing changed); anything against zero is
    infinite; what is not defined (nan) has no ratio (nan).

    Args:
        value: The cost in question, not negative.
        baseline: The cost it is measured against, not negative.
    """
    if math.isnan(value) or math.isnan(baseline):
        return math.nan
    if value == baseline:
        return 1.0
    return value / baseline if baseline else math.inf


def verdict(ratio: float) -> Verdict:
    """Return what a ratio says; what a table would show as 1.000 is equal.

    Args:
        ratio: A cost over the baseline's; nan says nothing.
    """
    if math.isnan(ratio):
        return Verdict.UNKNOWN
    if abs(ratio - 1.0) < EQUAL_WITHIN:
        return Verdict.EQUAL
    return Verdict.BETTER if ratio < 1.0 else Verdict.WORSE


def answer(comparison: Comparison) -> str:
    """Return the comparison in one sentence for each run: which costs fell, which rose.

    Args:
        comparison: The comparison.
    """
    if not comparison.others:
        return f"{comparison.baseline.label} was run alone: there is nothing to compare it with."
    return " ".join(_sentence(comparison, run.label) for run in comparison.others)


def _sentence(comparison: Comparison, label: str) -> str:
    clauses: list[str] = []
    for kind in Verdict:
        changes = [
            f"the {quantity.meaning} ({quantity.symbol}){_change(value)}"
            for quantity in INDICES
            for value in [comparison.ratio(label, quantity)]
            if verdict(value) is kind
        ]
        if changes:
            clauses.append(kind.value.format(_enumerate(changes)))
    count = len(comparison.joint_names)
    joints = "the one joint" if count == 1 else f"all {count} joints"
    against = f"against {comparison.baseline.label}"
    return f"Over {joints} and {against}, {label} {_enumerate(clauses)}."


def _change(value: float) -> str:
    if verdict(value) is Verdict.EQUAL:
        return ""
    if math.isinf(value):
        return " from zero"
    return f" by {abs(value - 1.0):.1%}" if value < 2.0 else f" to {value:.3g} times"


def _enumerate(items: list[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"

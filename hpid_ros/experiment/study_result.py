"""The numbers of a study, medians and quartiles over seeds, and the paper's claims.

Source: the paper, Table I and the text around it: over six arm joints IVC 4980 -> 2866, IAVC
541 -> 428, L2 norm of the effort 423.9 -> 329.5, ITAE 24.68 -> 23.37, ITAE lower in most joints.
(Table I has the error's L2 norm twice with opposite winners: held is that it rises by at most
5 %.) The words "smoother", "less effort", "same accuracy" and "less overshoot" are its
conclusions; what each is taken to mean is said beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

from hpid_ros.base.units import unit_over
from hpid_ros.experiment.batch import LAST_ERROR, TOTAL, RunRecord, RunTable
from hpid_ros.experiment.result_folder import versions
from hpid_ros.experiment.study_plan import QUANTITIES, StudyEntry, StudyPlan
from hpid_ros.metrics.folding import EngineTotal, engine_mapping
from hpid_ros.metrics.quantities import EFFORT_L2, ERROR_L2, IAVC, ITAE, IVC, OVERSHOOT, Quantity
from hpid_ros.report.table import format_ratio
from hpid_ros.stability.gain_check import DegreeChecker

JOINTS_SHARE = 4.0 / 6.0
"""The paper's four of six joints."""


@dataclass(frozen=True)
class Evidence:
    """What one experiment says of a controller, against the baseline with the same gains."""

    ratios: Mapping[str, float]  # median over the seeds of each index over the baseline's, by key
    joint_itae: Mapping[str, float]  # the same of each joint's ITAE

    @property
    def joints_better(self) -> int:
        """Joints whose ITAE is lower than the baseline's."""
        return sum(value < 1.0 for value in self.joint_itae.values())

    @property
    def joints_wanted(self) -> int:
        """As many of the joints as four are of six, rounded up."""
        return math.ceil(JOINTS_SHARE * len(self.joint_itae) - 1e-9)


class ClaimVerdict(Enum):
    """What several experiments say of a claim."""

    HOLDS = "holds"
    HOLDS_WHEN = "holds only when"
    DOES_NOT_HOLD = "does not hold"
    UNKNOWN = "not measured"


@dataclass(frozen=True)
class PaperClaim:
    key: str  # name in files
    text: str  # the claim in words
    holds: Callable[[Evidence], bool | None]  # whether evidence supports it
    figure: Callable[[Evidence], str]  # the figures of the evidence that decide


def _figures(quantities: Sequence[Quantity]) -> Callable[[Evidence], str]:
    def figure(evidence: Evidence) -> str:
        ratios = {q.symbol: evidence.ratios[q.key] for q in quantities if q.key in evidence.ratios}
        if len(quantities) == 1:
            return "".join(map(format_ratio, ratios.values()))
        return ", ".join(f"{symbol} {format_ratio(each)}" for symbol, each in ratios.items())

    return figure


_BELOW_ONE = math.nextafter(1.0, 0.0)


def _at_most(limits: Mapping[Quantity, float]) -> Callable[[Evidence], bool | None]:
    def holds(evidence: Evidence) -> bool | None:
        if any(quantity.key not in evidence.ratios for quantity in limits):
            return None
        return all(evidence.ratios[q.key] <= limit for q, limit in limits.items())

    return holds


def _limits_claim(key: str, text: str, limits: Mapping[Quantity, float]) -> PaperClaim:
    return PaperClaim(key, text, _at_most(limits), _figures(list(limits)))


def _ratio_claim(key: str, quantity: Quantity, limit: float) -> PaperClaim:
    text = f"{quantity.symbol}, {quantity.meaning}: at most {limit:g} of the PID's"
    return _limits_claim(key, text, {quantity: limit})


def _enough_joints(evidence: Evidence) -> bool | None:
    return evidence.joints_better >= evidence.joints_wanted if evidence.joint_itae else None


def _joints_figure(evidence: Evidence) -> str:
    return f"{evidence.joints_better} of {len(evidence.joint_itae)}"


NUMERIC_CLAIMS = (
    _ratio_claim("ivc", IVC, 0.575),
    _ratio_claim("iavc", IAVC, 0.79),
    _ratio_claim("effort_l2", EFFORT_L2, 0.777),
    _ratio_claim("itae", ITAE, 0.947),
    _ratio_claim("error_l2", ERROR_L2, 1.05),
    PaperClaim("joints", "ITAE lower in at least 4 of 6 joints", _enough_joints, _joints_figure),
)


def _all_hold(evidence: Evidence) -> bool | None:
    answers = [claim.holds(evidence) for claim in NUMERIC_CLAIMS]
    return None if None in answers else all(answers)


def _count(evidence: Evidence) -> str:
    held = sum(claim.holds(evidence) is True for claim in NUMERIC_CLAIMS)
    return f"{held} of {len(NUMERIC_CLAIMS)}"


CLAIMS = (
    *NUMERIC_CLAIMS,
    PaperClaim("together", "all of these together", _all_hold, _count),
    _limits_claim("smoother", "smoother: a lower IVC", {IVC: _BELOW_ONE}),
    _limits_claim(
        "less_effort",
        "less effort: a lower IAVC and ||u||",
        dict.fromkeys((IAVC, EFFORT_L2), _BELOW_ONE),
    ),
    _limits_claim(
        "accuracy",
        "the same accuracy: ITAE and ||e|| up to 1.05",
        dict.fromkeys((ITAE, ERROR_L2), 1.05),
    ),
    _limits_claim("overshoot", "less overshoot: the largest of a step", {OVERSHOOT: _BELOW_ONE}),
)


def verdict(
    claim: PaperClaim, evidence: Mapping[str, Evidence]
) -> tuple[ClaimVerdict, tuple[str, ...]]:
    """Return what experiments say of a claim, and in which of them it holds."""
    answers = {name: claim.holds(each) for name, each in evidence.items()}
    known = {name: answer for name, answer in answers.items() if answer is not None}
    held = tuple(name for name, answer in known.items() if answer)
    if not known:
        return ClaimVerdict.UNKNOWN, held
    if len(held) == len(known):
        return ClaimVerdict.HOLDS, held
    return (ClaimVerdict.HOLDS_WHEN if held else ClaimVerdict.DOES_NOT_HOLD), held


SETTLED = 0.01
"""A controller has settled whose error stays below this in the last second, in [rad]."""


@dataclass(frozen=True)
class StudyResult:
    plan: StudyPlan  # what was run
    records: Mapping[tuple[object, ...], RunRecord]  # of each run; an interrupted study lacks some
    _checker: DegreeChecker = field(default_factory=DegreeChecker, repr=False, compare=False)

    @cached_property
    def table(self) -> RunTable:
        """The numbers over the seeds, by ``entry.row(label)``."""
        entries = self.plan.entries
        return RunTable(
            {e.row(k): self.plan.seeds(e) for e in entries for k in (e.baseline, *e.others)},
            {e.row(label): e.row(e.baseline) for e in entries for label in e.others},
            self.records,
        )

    def engine_totals(self) -> list[EngineTotal]:
        """Return the totals of what was run in both engines; empty if nothing was."""
        table = self.table
        return [
            EngineTotal(
                first.experiment.name,
                label,
                quantity,
                {e.engine: table.numbers(e.row(label), quantity) for e in (first, second)},
                {}
                if label == first.baseline
                else {
                    e.engine: table.seed_ratios(e.row(label), quantity) for e in (first, second)
                },
                unit_over(quantity.unit, first.are_slides),
            )
            for first, second in self.plan.pairs
            for label in first.experiment.controllers
            for quantity in QUANTITIES
            if any(table.numbers(each.row(label), quantity) for each in (first, second))
        ]

    def evidence(self, entry: StudyEntry, label: str) -> Evidence:
        """Return what an experiment says of a controller, by medians."""
        row, table = entry.row(label), self.table
        all_ratios = {q.key: table.ratios(row, q) for q in QUANTITIES}
        itae = {joint: table.ratios(row, ITAE, joint) for joint in entry.joints}
        return Evidence(
            {key: each.median for key, each in all_ratios.items() if each is not None},
            {joint: each.median for joint, each in itae.items() if each is not None},
        )

    def worst_last_error(self, entry: StudyEntry, label: str, joint: str = TOTAL) -> float | None:
        """Return the largest error of the last second over joints and seeds, in [rad]."""
        found = self.table.numbers(entry.row(label), LAST_ERROR, joint)
        return max(found.values(), default=None)

    def claimed_labels(self) -> list[str]:
        """Return the controllers of the claims: homogeneous, with the baseline's gains."""
        labels: dict[str, None] = {}
        for entry in self.plan.entries:
            gains = [each.gains for each in entry.experiment.controllers[entry.baseline]]
            for label in entry.others:
                loops = entry.experiment.controllers[label]
                is_homogeneous = any(each.law == "hpid" for each in loops)
                if is_homogeneous and [each.gains for each in loops] == gains:
                    labels[label] = None
        return list(labels)

    def all_evidence(self, label: str) -> dict[str, Evidence]:
        """Return what each experiment that has a controller says of it, by experiment."""
        return {
            entry.name: self.evidence(entry, label)
            for entry in self.plan.entries
            if label in entry.others and self.table.seed_ratios(entry.row(label), ITAE)
        }

    def refusals(self, entry: StudyEntry, label: str) -> dict[str, str]:
        """Return why loops are not certified at their degree and inertia, by joint.

        A loop whose inertia is not known is named as such.
        """
        reasons: dict[str, str] = {}
        for each in entry.experiment.controllers[label]:
            if each.joint in entry.joints:
                unknown = "" if each.plant_inertia > 0.0 else "its inertia is not known"
                reason = unknown or self._checker.refusal(each)
                reasons |= {each.joint: reason} if reason else {}
        return reasons

    def as_mapping(self) -> dict[str, object]:
        """Return everything that the plan determines, ready for JSON."""
        totals = self.engine_totals()
        return {
            "versions": versions(),
            "seeds": self.plan.count,
            "runs": {
                "planned": len(self.plan.tasks()),
                "made": len(self.records),
                "failed": self.table.failures,
            },
            "units": {quantity.key: quantity.unit for quantity in QUANTITIES},
            "settled_below": SETTLED,
            "experiments": {entry.name: self._entry(entry) for entry in self.plan.entries},
            "claims": {label: self._claims(label) for label in self.claimed_labels()},
            **({"engines": engine_mapping(totals)} if totals else {}),
        }

    def _entry(self, entry: StudyEntry) -> dict[str, object]:
        experiment = entry.experiment
        return {
            "file": experiment.path.name,
            "sha256": experiment.digest,
            "engine": entry.engine,
            "duration": experiment.duration,
            "joints": list(entry.joints),
            **self._of_slides(entry),
            "seeds": list(self.plan.seeds(entry)),
            "baseline": entry.baseline,
            "controllers": {
                label: self._controller(entry, label) for label in experiment.controllers
            },
        }

    def _of_slides(self, entry: StudyEntry) -> dict[str, object]:
        """Return which joints slide, and the units of totals, where one does."""
        if not any(entry.are_slides):
            return {}
        slides = [name for name, each in zip(entry.joints, entry.are_slides, strict=True) if each]
        units = {q.key: unit_over(q.unit, entry.are_slides) for q in QUANTITIES}
        return {"slides": slides, "units": units}

    def _controller(self, entry: StudyEntry, label: str) -> dict[str, object]:
        last = self.worst_last_error(entry, label)
        refusals = self.refusals(entry, label)
        joints = {joint: self._numbers(entry, label, joint) for joint in entry.joints}
        values, ratios = self._numbers(entry, label, TOTAL).values()
        better = self.evidence(entry, label).joints_better
        return {
            "note": self.table.note(entry.row(label)),
            "totals": values,
            "ratios": ratios,
            "joints": joints,
            "itae_better": None if label == entry.baseline else better,
            "worst_last_error": last,
            "is_settled": None if last is None else last < SETTLED,
            "is_certified": not refusals,
            "refusals": refusals,
        }

    def _numbers(self, entry: StudyEntry, label: str, joint: str) -> dict[str, object]:
        return {
            name: {q.key: each.as_mapping() for q in QUANTITIES if (each := of(row, q, joint))}
            for name, of in (("values", self.table.quartiles), ("ratios", self.table.ratios))
            for row in (entry.row(label),)
        }

    def _claims(self, label: str) -> list[dict[str, object]]:
        evidence = self.all_evidence(label)
        rows: list[dict[str, object]] = []
        for claim in CLAIMS:
            kind, held = verdict(claim, evidence)
            figures = {name: claim.figure(each) for name, each in evidence.items()}
            row = {"key": claim.key, "claim": claim.text, "verdict": kind.value}
            rows.append({**row, "holds_in": list(held), "figures": figures})
        return rows

"""The numbers of a study: for each experiment and controller medians and quartiles over seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from hpid_ros.analysis.comparison import ratio
from hpid_ros.analysis.engine_totals import EngineTotal, engine_mapping
from hpid_ros.analysis.quantities import ITAE, Quantity
from hpid_ros.base.units import unit_over
from hpid_ros.experiment.result.folder import versions
from hpid_ros.stability.degrees import DegreeChecker
from hpid_ros.studies.batch import LAST_ERROR
from hpid_ros.studies.claims import CLAIMS, Evidence, verdict
from hpid_ros.studies.study_plan import QUANTITIES, TOTAL, RunKey, RunRecord, StudyEntry, StudyPlan
from hpid_ros.studies.sweep_result import Quartiles, plain_quartiles

SETTLED = 0.01
"""A controller has settled whose error stays below this in the last second, in [rad]."""


@dataclass(frozen=True)
class StudyResult:
    """What a study gave."""

    plan: StudyPlan  # what was run
    records: Mapping[RunKey, RunRecord]  # of each run; an interrupted study lacks some
    _checker: DegreeChecker = field(default_factory=DegreeChecker, repr=False, compare=False)

    def numbers(
        self, entry: StudyEntry, label: str, quantity: Quantity, joint: str = TOTAL
    ) -> dict[int, float]:
        """Return one number of a controller's runs by seed; failed runs have none."""
        found = {}
        for seed in self.plan.seeds(entry):
            record = self.records.get(entry.key(label, seed))
            values = record.numbers.get(joint, {}) if record is not None else {}
            if quantity.key in values:
                found[seed] = values[quantity.key]
        return found

    def quartiles(
        self, entry: StudyEntry, label: str, quantity: Quantity, joint: str = TOTAL
    ) -> Quartiles | None:
        """Return one number over the seeds; None if no run gave it."""
        return Quartiles.of(list(self.numbers(entry, label, quantity, joint).values()))

    def ratios(
        self, entry: StudyEntry, label: str, quantity: Quantity, joint: str = TOTAL
    ) -> Quartiles | None:
        """Return a controller's ratio to the baseline over the seeds, taken seed by seed."""
        return Quartiles.of(list(self.seed_ratios(entry, label, quantity, joint).values()))

    def seed_ratios(
        self, entry: StudyEntry, label: str, quantity: Quantity, joint: str = TOTAL
    ) -> dict[int, float]:
        """Return a controller's ratio to the baseline with the same seed, by seed."""
        against = self.numbers(entry, entry.baseline, quantity, joint)
        own = self.numbers(entry, label, quantity, joint)
        return {seed: ratio(own[seed], against[seed]) for seed in own if seed in against}

    def engine_totals(self) -> list[EngineTotal]:
        """Return the totals of what was run in both engines; empty if nothing was."""
        return [
            EngineTotal(
                first.experiment.name,
                label,
                quantity,
                {each.engine: self.numbers(each, label, quantity) for each in (first, second)},
                {}
                if label == first.baseline
                else {
                    each.engine: self.seed_ratios(each, label, quantity)
                    for each in (first, second)
                },
                unit_over(quantity.unit, first.are_slides),
            )
            for first, second in self.plan.pairs
            for label in first.experiment.controllers
            for quantity in QUANTITIES
            if self.numbers(first, label, quantity) or self.numbers(second, label, quantity)
        ]

    def evidence(self, entry: StudyEntry, label: str) -> Evidence:
        """Return what an experiment says of a controller, by medians."""
        all_ratios = {q.key: self.ratios(entry, label, q) for q in QUANTITIES}
        itae = {joint: self.ratios(entry, label, ITAE, joint) for joint in entry.joints}
        return Evidence(
            {key: each.median for key, each in all_ratios.items() if each is not None},
            {joint: each.median for joint, each in itae.items() if each is not None},
        )

    def worst_last_error(self, entry: StudyEntry, label: str) -> float | None:
        """Return the largest error of the last second over joints and seeds, in [rad]."""
        return max(self.numbers(entry, label, LAST_ERROR).values(), default=None)

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
            if label in entry.others and self.ratios(entry, label, ITAE) is not None
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

    def note(self, entry: StudyEntry, label: str) -> str:
        """Return in one line what did not run; empty if everything did."""
        seeds = self.plan.seeds(entry)
        found = [self.records.get(entry.key(label, seed)) for seed in seeds]
        failures = [each.failure for each in found if each is not None and each.failure]
        missing = sum(each is None for each in found)
        notes = [f"{len(failures)} of {len(seeds)} runs failed: {failures[0]}"] if failures else []
        notes += [f"{missing} of {len(seeds)} runs were not made"] if missing else []
        return "; ".join(notes)

    @property
    def failures(self) -> int:
        """Number of runs that failed."""
        return sum(bool(record.failure) for record in self.records.values())

    def as_mapping(self) -> dict[str, object]:
        """Return everything that the plan determines, ready for JSON."""
        return {
            "versions": versions(),
            "seeds": self.plan.count,
            "runs": {
                "planned": len(self.plan.tasks()),
                "made": len(self.records),
                "failed": self.failures,
            },
            "units": {quantity.key: quantity.unit for quantity in QUANTITIES},
            "settled_below": SETTLED,
            "experiments": {entry.name: self._entry(entry) for entry in self.plan.entries},
            "claims": {label: self._claims(label) for label in self.claimed_labels()},
            **self._engines(),
        }

    def _engines(self) -> dict[str, object]:
        totals = self.engine_totals()
        return {"engines": engine_mapping(totals)} if totals else {}

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
        is_baseline = label == entry.baseline
        last = self.worst_last_error(entry, label)
        refusals = self.refusals(entry, label)
        evidence = self.evidence(entry, label)
        return {
            "note": self.note(entry, label),
            "totals": self._quartiles(entry, label, TOTAL),
            "ratios": {} if is_baseline else self._ratios(entry, label, TOTAL),
            "joints": {
                joint: {
                    "values": self._quartiles(entry, label, joint),
                    "ratios": {} if is_baseline else self._ratios(entry, label, joint),
                }
                for joint in entry.joints
            },
            "itae_better": None if is_baseline else evidence.joints_better,
            "worst_last_error": last,
            "is_settled": None if last is None else last < SETTLED,
            "is_certified": not refusals,
            "refusals": refusals,
        }

    def _quartiles(self, entry: StudyEntry, label: str, joint: str) -> dict[str, object]:
        found = {q.key: self.quartiles(entry, label, q, joint) for q in QUANTITIES}
        return {key: plain_quartiles(each) for key, each in found.items() if each is not None}

    def _ratios(self, entry: StudyEntry, label: str, joint: str) -> dict[str, object]:
        found = {q.key: self.ratios(entry, label, q, joint) for q in QUANTITIES}
        return {key: plain_quartiles(each) for key, each in found.items() if each is not None}

    def _claims(self, label: str) -> list[dict[str, object]]:
        evidence = self.all_evidence(label)
        rows: list[dict[str, object]] = []
        for claim in CLAIMS:
            kind, held = verdict(claim, evidence)
            rows.append(
                {
                    "key": claim.key,
                    "claim": claim.text,
                    "verdict": kind.value,
                    "holds_in": list(held),
                    "figures": {name: claim.figure(each) for name, each in evidence.items()},
                }
            )
        return rows

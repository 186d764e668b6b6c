"""A study: its runs, medians and quartiles over seeds, the paper's claims, and its tables.

Source: the paper, Table I and the text around it: over six arm joints IVC 4980 -> 2866, IAVC
541 -> 428, L2 norm of the effort 423.9 -> 329.5, ITAE 24.68 -> 23.37, ITAE lower in most joints.
(Table I has the error's L2 norm twice with opposite winners: held is that it rises by at most
5 %.) The words "smoother", "less effort", "same accuracy" and "less overshoot" are its
conclusions; what each is taken to mean is said beside it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from rich.box import SIMPLE

from hpid_bench.experiment.batch import (
    BATCH_QUANTITIES,
    LAST_ERROR,
    TOTAL,
    Quartiles,
    Runner,
    RunRecord,
    RunTable,
)
from hpid_bench.experiment.result_folder import ResultFolder, versions
from hpid_bench.experiment.study_plan import (
    JOURNAL,
    JournalEntry,
    RunKey,
    StudyEntry,
    StudyPlan,
    kept_records,
    read_journal,
)
from hpid_bench.report.table import (
    NO_NUMBER,
    WideTable,
    columns_of,
    spaced,
    tables_markdown,
    tables_text,
)
from hpid_ros.base.errors import ResultExistsError
from hpid_ros.base.text import csv_text
from hpid_ros.base.units import unit_over
from hpid_ros.metrics.quantities import (
    EFFORT_L2,
    ERROR_L2,
    IAVC,
    ITAE,
    IVC,
    OVERSHOOT,
    PAPER,
    Quantity,
)
from hpid_ros.metrics.texts import format_ratio, format_values, slides_note
from hpid_ros.stability.gain_check import DegreeChecker

JOINTS_SHARE = 4.0 / 6.0  # the paper's four of six joints


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


class PaperClaim(NamedTuple):
    key: str  # name in files
    text: str  # the claim in words
    holds: Callable[
        [Evidence], bool | None
    ]  # whether evidence supports it; None if it says nothing
    figure: Callable[[Evidence], str]  # the figures of the evidence that decide


def _limits_claim(key: str, text: str, limits: Mapping[Quantity, float]) -> PaperClaim:
    """Return the claim that some ratios are at most so large."""

    def holds(evidence: Evidence) -> bool | None:
        if any(quantity.key not in evidence.ratios for quantity in limits):
            return None
        return all(evidence.ratios[q.key] <= limit for q, limit in limits.items())

    def figure(evidence: Evidence) -> str:
        known = {q.symbol: evidence.ratios[q.key] for q in limits if q.key in evidence.ratios}
        if len(limits) == 1:
            return "".join(map(format_ratio, known.values()))
        return ", ".join(f"{symbol} {format_ratio(each)}" for symbol, each in known.items())

    return PaperClaim(key, text, holds, figure)


def _ratio_claim(key: str, quantity: Quantity, limit: float) -> PaperClaim:
    text = f"{quantity.symbol}, {quantity.meaning}: at most {limit:g} of the PID's"
    return _limits_claim(key, text, {quantity: limit})


NUMERIC_CLAIMS = (
    _ratio_claim("ivc", IVC, 0.575),
    _ratio_claim("iavc", IAVC, 0.79),
    _ratio_claim("effort_l2", EFFORT_L2, 0.777),
    _ratio_claim("itae", ITAE, 0.947),
    _ratio_claim("error_l2", ERROR_L2, 1.05),
    PaperClaim(
        "joints",
        "ITAE lower in at least 4 of 6 joints",
        lambda each: each.joints_better >= each.joints_wanted if each.joint_itae else None,
        lambda each: f"{each.joints_better} of {len(each.joint_itae)}",
    ),
)


def _all_hold(evidence: Evidence) -> bool | None:
    answers = [claim.holds(evidence) for claim in NUMERIC_CLAIMS]
    return None if None in answers else all(answers)


def _count(evidence: Evidence) -> str:
    held = sum(claim.holds(evidence) is True for claim in NUMERIC_CLAIMS)
    return f"{held} of {len(NUMERIC_CLAIMS)}"


_BELOW_ONE = math.nextafter(1.0, 0.0)

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


def claim_verdict(
    claim: PaperClaim, evidence: Mapping[str, Evidence]
) -> tuple[str, tuple[str, ...]]:
    """Return what experiments say of a claim, and in which of them it holds."""
    answers = {name: claim.holds(each) for name, each in evidence.items()}
    known = [name for name, answer in answers.items() if answer is not None]
    held = tuple(name for name in known if answers[name])
    if not known:
        return "not measured", held
    if len(held) == len(known):
        return "holds", held
    return ("holds only when" if held else "does not hold"), held


SETTLED_ERROR = 0.01  # [rad] below which a settled controller stays in the last second


def _is_claimed(entry: StudyEntry, label: str) -> bool:
    """Return whether a controller of an experiment is homogeneous, with the baseline's gains."""
    loops = entry.experiment.controllers.get(label, ())
    gains = [each.gains for each in entry.experiment.controllers[entry.baseline]]
    is_homogeneous = label != entry.baseline and any(each.is_homogeneous for each in loops)
    return is_homogeneous and [each.gains for each in loops] == gains


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
            {e.row(k): self.plan.seeds(e) for e in entries for k in e.experiment.controllers},
            {e.row(label): e.row(e.baseline) for e in entries for label in e.others},
            self.records,
        )

    def evidence(self, entry: StudyEntry, label: str) -> Evidence:
        """Return what an experiment says of a controller, by medians."""
        row, table = entry.row(label), self.table
        all_ratios = {q.key: table.ratios(row, q) for q in BATCH_QUANTITIES}
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
        entries = self.plan.entries
        return list(dict.fromkeys(k for e in entries for k in e.others if _is_claimed(e, k)))

    def all_evidence(self, label: str) -> dict[str, Evidence]:
        """Return what each experiment says of a controller of the claims, by experiment."""
        return {
            entry.name: self.evidence(entry, label)
            for entry in self.plan.entries
            if _is_claimed(entry, label) and self.table.seed_ratios(entry.row(label), ITAE)
        }

    def refusals(self, entry: StudyEntry, label: str) -> dict[str, str]:
        """Return why loops are not certified at their degree and inertia, by joint."""
        reasons: dict[str, str] = {}
        for each in entry.experiment.controllers[label]:
            if each.joint in entry.joints:
                unknown = "" if each.plant_inertia > 0.0 else "its inertia is not known"
                reason = unknown or self._checker.refusal(each)
                reasons |= {each.joint: reason} if reason else {}
        return reasons

    def as_mapping(self) -> dict[str, object]:
        """Return everything that the plan determines, ready for JSON."""
        return {
            "versions": versions(),
            "seeds": self.plan.count,
            "runs": {
                "planned": len(self.plan.tasks()),
                "made": len(self.records),
                "failed": self.table.failures,
            },
            "units": {quantity.key: quantity.unit for quantity in BATCH_QUANTITIES},
            "settled_below": SETTLED_ERROR,
            "experiments": {entry.name: self._entry(entry) for entry in self.plan.entries},
            "claims": {label: self._claims(label) for label in self.claimed_labels()},
        }

    def _entry(self, entry: StudyEntry) -> dict[str, object]:
        experiment = entry.experiment
        slides: dict[str, object] = {}
        if any(entry.are_slides):  # and the units of totals
            slides["slides"] = [each for each in entry.joints if each in experiment.slides]
            slides["units"] = {
                q.key: unit_over(q.unit, entry.are_slides) for q in BATCH_QUANTITIES
            }
        return {
            "file": experiment.path.name,
            "sha256": experiment.digest,
            "engine": entry.engine,
            "duration": experiment.duration,
            "joints": list(entry.joints),
            **slides,
            "seeds": list(self.plan.seeds(entry)),
            "baseline": entry.baseline,
            "controllers": {
                label: self._controller(entry, label) for label in experiment.controllers
            },
        }

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
            "is_settled": None if last is None else last < SETTLED_ERROR,
            "is_certified": not refusals,
            "refusals": refusals,
        }

    def _numbers(self, entry: StudyEntry, label: str, joint: str) -> dict[str, object]:
        return {
            name: {
                q.key: each.as_mapping() for q in BATCH_QUANTITIES if (each := of(row, q, joint))
            }
            for name, of in (("values", self.table.quartiles), ("ratios", self.table.ratios))
            for row in (entry.row(label),)
        }

    def _claims(self, label: str) -> list[dict[str, object]]:
        evidence = self.all_evidence(label)
        rows: list[dict[str, object]] = []
        for claim in CLAIMS:
            kind, held = claim_verdict(claim, evidence)
            figures = {name: claim.figure(each) for name, each in evidence.items()}
            row = {"key": claim.key, "claim": claim.text, "verdict": kind}
            rows.append({**row, "holds_in": list(held), "figures": figures})
        return rows


def tables(result: StudyResult) -> list[WideTable]:
    """Return all tables: claims, loops, of each experiment totals and joints."""
    entries = result.plan.entries
    found = [_claims(result, label) for label in result.claimed_labels()]
    found.append(_loops(result))
    for entry in entries:
        found += [_totals(result, entry), _joints(result, entry)]
    return found


def _claims(result: StudyResult, label: str) -> WideTable:
    evidence = result.all_evidence(label)
    rows = []
    for claim in CLAIMS:
        kind, held = claim_verdict(claim, evidence)
        says = f"{kind}: {', '.join(held)}" if kind.endswith("when") else kind
        figures = [claim.figure(each) or NO_NUMBER for each in evidence.values()]
        rows.append((claim.text, says, *figures))
    return WideTable.of_rows(
        ("claim", "verdict", *evidence),
        rows,
        texts=2,
        key=f"claims {label}",
        title=f"The paper's claims, {label} over the PID of the same gains",
        note=f"Medians over {_seeds(result)} of the ratio to the baseline with the same seed.",
        box=SIMPLE,
    )


def _loops(result: StudyResult) -> WideTable:
    rows = []
    every = [each for entry in result.plan.entries for each in entry.are_slides]
    heading = f"last |e| [{unit_over('rad', every)}]"
    for entry in result.plan.entries:
        for label in entry.experiment.controllers:
            last = result.worst_last_error(entry, label)
            refusals = result.refusals(entry, label)
            settled = NO_NUMBER if last is None else "yes" if last < SETTLED_ERROR else "no"
            rows.append((entry.name, label, _error(last), settled, _certified(refusals)))
    headings = ("experiment", "controller", heading, f"below {SETTLED_ERROR:g}", "certified")
    columns = columns_of(headings, rows, ("experiment", "controller", "certified"))
    return WideTable(
        columns[:2],
        columns[2:],
        key="loops",
        title="Settled and certified",
        note="Largest error of the last second over joints and seeds. Certified: the linear law "
        "by Routh and Hurwitz, the homogeneous law at its degree, at the nominal inertia.",
        box=SIMPLE,
    )


def _totals(result: StudyResult, entry: StudyEntry) -> WideTable:
    """Return every index of the baseline, then value and ratio of each other controller."""
    table, labels = result.table, entry.experiment.controllers
    headings = ["index", entry.baseline]
    for label in entry.others:
        headings += [label, "ratio"]
    rows = []
    for quantity in (*PAPER, OVERSHOOT):
        own = [table.quartiles(entry.row(label), quantity) for label in labels]
        if any(own):
            baseline, *values = _values(own)
            cells = [f"{quantity.symbol} [{unit_over(quantity.unit, entry.are_slides)}]", baseline]
            for label, value in zip(entry.others, values, strict=True):
                cells += [value, _ratio_cell(table.ratios(entry.row(label), quantity))]
            rows.append(tuple(cells))
    wins = [_wins(result, entry, label) for label in entry.others]
    rows.append(
        ("ITAE lower in", NO_NUMBER, *(cell for each in wins for cell in (each, NO_NUMBER)))
    )
    notes = [table.note(entry.row(label)) for label in labels]
    if any(notes):
        rows.append(("note", notes[0], *(cell for each in notes[1:] for cell in (each, ""))))
    are_all = entry.joints == entry.experiment.world.joints
    joints = f"all {len(entry.joints)} joints" if are_all else ", ".join(entry.joints)
    return WideTable.of_rows(
        headings,
        rows,
        key=f"totals {entry.name}",
        title=f"{entry.name}: totals over {joints}",
        note=f"Medians with quartiles over {_seeds(result)}; ratio to {entry.baseline} with the "
        f"same seed.{_slides(entry)}",
        box=SIMPLE,
    )


def _joints(result: StudyResult, entry: StudyEntry) -> WideTable:
    unit = unit_over("rad", entry.are_slides)
    rows = [
        (label, joint, *ratios, _error(result.worst_last_error(entry, label, joint)))
        for label in entry.others
        for joint in entry.joints
        for ratios in ([_median(result.table.ratios(entry.row(label), q, joint)) for q in PAPER],)
    ]
    return WideTable.of_rows(
        ("controller", "joint", *(q.symbol for q in PAPER), f"last |e| [{unit}]"),
        rows,
        names=2,
        texts=2,
        key=f"joints {entry.name}",
        title=f"{entry.name}: ratios to {entry.baseline}, joint by joint",
        note=_slides(entry).strip(),
        box=SIMPLE,
    )


def _slides(entry: StudyEntry) -> str:
    """Return what follows a note where joints of unlike units stand beside each other."""
    note = slides_note(entry.joints, entry.experiment.slides)
    return f" {note}" if note else ""


def _error(value: float | None) -> str:
    return NO_NUMBER if value is None else f"{value:.4f}"


def _values(quartiles: Sequence[Quartiles | None]) -> list[str]:
    """Return medians with quartiles, the points of a column in line."""
    numbers = iter(format_values([x for each in quartiles if each for x in each]))
    texts = [None if each is None else [next(numbers) for _ in each] for each in quartiles]
    return [NO_NUMBER if each is None else _spread(*each) for each in texts]


def _ratio_cell(quartiles: Quartiles | None) -> str:
    if quartiles is None:
        return NO_NUMBER
    return _spread(*map(format_ratio, quartiles))


def _median(quartiles: Quartiles | None) -> str:
    return NO_NUMBER if quartiles is None else format_ratio(quartiles.median)


def _spread(low: str, middle: str, high: str) -> str:
    """Return a median with its quartiles, where they can be told from it."""
    return middle if low == high else f"{middle} ({low}..{high})"


def _wins(result: StudyResult, entry: StudyEntry, label: str) -> str:
    if not result.table.seed_ratios(entry.row(label), ITAE):
        return NO_NUMBER
    return f"{result.evidence(entry, label).joints_better} of {len(entry.joints)}"


def _certified(refusals: dict[str, str]) -> str:
    if not refusals:
        return "yes"
    joint, reason = next(iter(refusals.items()))
    more = f" and {len(refusals) - 1} more" if len(refusals) > 1 else ""
    return f"no: {joint}{more}: {reason}"


def _seeds(result: StudyResult) -> str:
    count = result.plan.count
    return f"{count} seed{'s' * (count > 1)}"


def study_folder(
    path: Path, *, force: bool = False, resume: bool = False, inputs: Iterable[Path] = ()
) -> ResultFolder:
    """Return the folder of a study, made again or carried on."""
    if resume and path.exists():
        if not (path / JOURNAL).is_file():
            raise ResultExistsError(f"{path} is not a study that could be carried on")
        return ResultFolder.reopen(path)
    return ResultFolder.create(path, force=force, inputs=inputs)


def run_study(
    plan: StudyPlan, folder: ResultFolder, run: Runner, advanced: Callable[[RunRecord], None]
) -> StudyResult:
    """Run every controller of every experiment with every seed that the folder does not have.

    What was run is kept as it ends, and saved as a whole at the end, also when interrupted; the
    files are the same wherever the runs are made.
    """
    digests, wanted = plan.digests, plan.tasks()
    records = kept_records(plan, folder.path)
    tasks = {key: task for key, task in wanted.items() if key not in records}
    result = StudyResult(plan, records)
    journal = read_journal(folder.path / JOURNAL)

    def others() -> list[JournalEntry]:
        """Return what was there before, until it has been run again."""
        return [each for each in journal if each.key not in records]

    _begin(result, folder, others())
    try:
        with (
            folder.file(JOURNAL).open("a", encoding="utf-8") as lines,
            closing(run(tasks)) as batch,
        ):
            for key, record in batch:
                records[key] = record
                digest = digests[key.experiment, key.engine]
                lines.write(JournalEntry(key, digest, record).line() + "\n")
                lines.flush()
                advanced(record)
    finally:
        save_study(result, folder, others())
    return result


def save_study(result: StudyResult, folder: ResultFolder, others: Iterable[JournalEntry]) -> None:
    """Write the experiments, the numbers of all runs, the summary and the tables."""
    _begin(result, folder, others)
    folder.write("runs.csv", runs_csv(result))
    folder.write("study.json", json.dumps(result.as_mapping(), indent=2) + "\n")
    folder.write("tables.txt", tables_text(spaced(tables(result))))
    folder.write("tables.md", tables_markdown(tables(result)))


def runs_csv(result: StudyResult) -> str:
    """Return every number of every run: of all judged joints, then joint by joint."""
    keys = [quantity.key for quantity in BATCH_QUANTITIES]
    rows: list[list[object]] = [[*RunKey._fields, "joint", *keys, "failure"]]
    for key in result.plan.tasks():
        record = result.records.get(key)
        if record is None:
            continue
        for joint in record.numbers or [TOTAL]:
            numbers = record.numbers.get(joint, {})
            name = "all" if joint == TOTAL else joint
            values = [numbers.get(each, "") for each in keys]
            rows.append([*key, name, *values, record.failure])
    return csv_text(rows)


def _begin(result: StudyResult, folder: ResultFolder, others: Iterable[JournalEntry]) -> None:
    """Write the experiments, and the journal in the plan's order, however the runs ended."""
    plan, records, digests = result.plan, result.records, result.plan.digests
    for entry in plan.entries:
        folder.write(f"experiments/{entry.experiment.name}.yaml", entry.experiment.text)
    made = [
        JournalEntry(key, digests[key.experiment, key.engine], records[key])
        for key in plan.tasks()
        if key in records
    ]
    folder.write(JOURNAL, "".join(f"{each.line()}\n" for each in (*made, *others)))

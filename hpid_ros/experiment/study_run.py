"""Runs a study, keeps every run as it ends, and writes its tables."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from pathlib import Path

from hpid_ros.base.errors import ResultExistsError, SettingError
from hpid_ros.base.text import csv_text
from hpid_ros.base.units import unit_over
from hpid_ros.experiment.batch import (
    PAPER_QUANTITIES,
    TOTAL,
    Outcome,
    Quartiles,
    Runner,
    RunRecord,
    joint_numbers,
)
from hpid_ros.experiment.result_folder import ResultFolder
from hpid_ros.experiment.study_plan import (
    QUANTITIES,
    JournalEntry,
    RunKey,
    StudyEntry,
    StudyPlan,
    read_journal,
)
from hpid_ros.experiment.study_result import CLAIMS, SETTLED, ClaimVerdict, StudyResult, verdict
from hpid_ros.metrics.quantities import ITAE, OVERSHOOT, Quantity
from hpid_ros.report.export import engine_grids, engines_csv
from hpid_ros.report.table import (
    Grid,
    format_ratio,
    format_values,
    grids_markdown,
    grids_text,
    slides_note,
)

NOTHING = "-"
_SHOWN = (*PAPER_QUANTITIES, OVERSHOOT)


def grids(result: StudyResult) -> list[Grid]:
    """Return all tables of a study: claims, loops, then of each experiment totals and joints.

    What was run in both engines is compared after the claims.
    """
    entries = result.plan.entries
    found = [_claims(result, label) for label in result.claimed_labels()]
    totals = result.engine_totals()
    if totals:
        found += engine_grids(totals, f"Totals over the judged joints, {_seeds(result)}.")
    found.append(_loops(result))
    for entry in entries:
        found += [_totals(result, entry), _joints(result, entry)]
    return found


def study_text(result: StudyResult) -> str:
    return grids_text(grids(result))


def study_markdown(result: StudyResult) -> str:
    """Return all tables as Markdown, each between comments that name it."""
    return grids_markdown(grids(result))


def _claims(result: StudyResult, label: str) -> Grid:
    evidence = result.all_evidence(label)
    rows = []
    for claim in CLAIMS:
        kind, held = verdict(claim, evidence)
        says = (
            f"{kind.value}: {', '.join(held)}" if kind is ClaimVerdict.HOLDS_WHEN else kind.value
        )
        figures = [claim.figure(each) or NOTHING for each in evidence.values()]
        rows.append((claim.text, says, *figures))
    return Grid(
        f"claims {label}",
        f"The paper's claims, {label} over the PID of the same gains",
        ("claim", "verdict", *evidence),
        tuple(rows),
        f"Medians over {_seeds(result)} of the ratio to the baseline with the same seed.",
    )


def _loops(result: StudyResult) -> Grid:
    rows = []
    every = [each for entry in result.plan.entries for each in entry.are_slides]
    heading = f"last |e| [{unit_over('rad', every)}]"
    for entry in result.plan.entries:
        for label in (entry.baseline, *entry.others):
            last = result.worst_last_error(entry, label)
            refusals = result.refusals(entry, label)
            settled = NOTHING if last is None else "yes" if last < SETTLED else "no"
            rows.append((entry.name, label, _error(last), settled, _certified(refusals)))
    return Grid(
        "loops",
        "Settled and certified",
        ("experiment", "controller", heading, f"below {SETTLED:g}", "certified"),
        tuple(rows),
        "Largest error of the last second over joints and seeds. Certified: the linear law by "
        "Routh and Hurwitz, the homogeneous law at its degree, at the nominal inertia.",
    )


def _totals(result: StudyResult, entry: StudyEntry) -> Grid:
    """Return every index of the baseline, then value and ratio of each other controller."""
    headings = ["index", entry.baseline]
    for label in entry.others:
        headings += [label, "ratio"]
    rows = []
    for quantity in _SHOWN:
        own = [
            result.table.quartiles(entry.row(label), quantity)
            for label in (entry.baseline, *entry.others)
        ]
        if any(own):
            baseline, *values = _values(own)
            cells = [f"{quantity.symbol} [{unit_over(quantity.unit, entry.are_slides)}]", baseline]
            for label, value in zip(entry.others, values, strict=True):
                cells += [value, _ratio(result.table.ratios(entry.row(label), quantity))]
            rows.append(tuple(cells))
    wins = [_wins(result, entry, label) for label in entry.others]
    rows.append(("ITAE lower in", NOTHING, *(cell for each in wins for cell in (each, NOTHING))))
    notes = [result.table.note(entry.row(label)) for label in (entry.baseline, *entry.others)]
    if any(notes):
        rows.append(("note", notes[0], *(cell for each in notes[1:] for cell in (each, ""))))
    return Grid(
        f"totals {entry.name}",
        f"{entry.name}: totals over {_enumerated(entry)}",
        tuple(headings),
        tuple(rows),
        f"Medians with quartiles over {_seeds(result)}; ratio to {entry.baseline} with the same "
        f"seed.{_slides(entry)}",
    )


def _joints(result: StudyResult, entry: StudyEntry) -> Grid:
    quantities: tuple[Quantity, ...] = PAPER_QUANTITIES
    unit = unit_over("rad", entry.are_slides)
    rows = [
        (
            label,
            joint,
            *(_median(result.table.ratios(entry.row(label), q, joint)) for q in quantities),
            _error(result.worst_last_error(entry, label, joint)),
        )
        for label in entry.others
        for joint in entry.joints
    ]
    return Grid(
        f"joints {entry.name}",
        f"{entry.name}: ratios to {entry.baseline}, joint by joint",
        ("controller", "joint", *(q.symbol for q in quantities), f"last |e| [{unit}]"),
        tuple(rows),
        _slides(entry).strip(),
    )


def _slides(entry: StudyEntry) -> str:
    """Return what follows a note where joints of unlike units stand beside each other."""
    note = slides_note(entry.joints, entry.experiment.slides)
    return f" {note}" if note else ""


def _error(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.4f}"


def _values(quartiles: Sequence[Quartiles | None]) -> list[str]:
    """Return medians with quartiles, the points of a column in line."""
    numbers = iter(format_values([x for each in quartiles if each for x in each]))
    texts = [None if each is None else [next(numbers) for _ in each] for each in quartiles]
    return [NOTHING if each is None else _spread(*each) for each in texts]


def _ratio(quartiles: Quartiles | None) -> str:
    if quartiles is None:
        return NOTHING
    return _spread(*map(format_ratio, quartiles))


def _median(quartiles: Quartiles | None) -> str:
    return NOTHING if quartiles is None else format_ratio(quartiles.median)


def _spread(low: str, middle: str, high: str) -> str:
    """Return a median with its quartiles, where they can be told from it."""
    return middle if low == high else f"{middle} ({low}..{high})"


def _wins(result: StudyResult, entry: StudyEntry, label: str) -> str:
    if not result.table.seed_ratios(entry.row(label), ITAE):
        return NOTHING
    return f"{result.evidence(entry, label).joints_better} of {len(entry.joints)}"


def _certified(refusals: dict[str, str]) -> str:
    if not refusals:
        return "yes"
    joint, reason = next(iter(refusals.items()))
    more = f" and {len(refusals) - 1} more" if len(refusals) > 1 else ""
    return f"no: {joint}{more}: {reason}"


def _enumerated(entry: StudyEntry) -> str:
    if entry.joints == entry.experiment.world.joints:
        return f"all {len(entry.joints)} joints"
    return ", ".join(entry.joints)


def _seeds(result: StudyResult) -> str:
    count = result.plan.count
    return f"{count} seed{'s' * (count > 1)}"


JOURNAL = "runs.jsonl"


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
    plan: StudyPlan,
    folder: ResultFolder,
    run: Runner,
    advanced: Callable[[Outcome], None],
) -> StudyResult:
    """Run every controller of every experiment with every seed that the folder does not have.

    What was run is kept as it ends, and saved as a whole at the end, also when interrupted; the
    files are the same wherever the runs are made.
    """
    digests = _digests(plan)
    wanted = plan.tasks()
    records = kept_records(plan, folder.path)
    tasks = {key: task for key, task in wanted.items() if key not in records}
    keys = tuple(tasks)
    result = StudyResult(plan, records)
    others = [each for each in read_journal(folder.path / JOURNAL) if each.key not in wanted]
    _begin(result, folder, others)
    try:
        with (
            folder.file(JOURNAL).open("a", encoding="utf-8") as lines,
            closing(run(tuple(tasks.values()))) as batch,
        ):
            for outcome in batch:
                key = keys[outcome.place]
                numbers = joint_numbers(outcome.indices, QUANTITIES)
                record = RunRecord(numbers, outcome.failure)
                records[key] = record
                digest = digests[key.experiment, key.engine]
                lines.write(JournalEntry(key, digest, record).line() + "\n")
                lines.flush()
                advanced(outcome)
    finally:
        save(result, folder, others)
    return result


def merged(plan: StudyPlan, parts: Sequence[Path]) -> StudyResult:
    """Put the runs of several studies together."""
    for part in parts:
        if not (part / JOURNAL).is_file():
            raise SettingError(f"{part} is no study: it has no {JOURNAL}")
    records = kept_records(plan, *parts)
    missing = [key for key in plan.tasks() if key not in records]
    if missing:
        first = missing[0]
        raise SettingError(
            f"{len(missing)} of {len(plan.tasks())} runs are in none of the parts, or failed, or "
            f"were made of other files, seeds or versions; the first is {first.experiment} "
            f"{first.controller} seed={first.seed} in {first.engine}"
        )
    return StudyResult(plan, records)


def kept_records(plan: StudyPlan, *folders: Path) -> dict[tuple[object, ...], RunRecord]:
    """Return the runs in folders that are still those of the plan and did not fail."""
    digests = _digests(plan)
    wanted = set(plan.tasks())
    records: dict[tuple[object, ...], RunRecord] = {}
    for journal in (folder / JOURNAL for folder in folders):
        for entry in read_journal(journal):
            key, record = entry.key, entry.record
            if key not in wanted or record.failure:
                continue
            if entry.digest != digests[key.experiment, key.engine]:
                continue
            if records.setdefault(key, record) != record:
                raise SettingError(
                    f"{journal}: {key.experiment} {key.controller} seed={key.seed} in "
                    f"{key.engine} is there with other numbers than before; one of the two is "
                    "wrong, or made on a machine that computes differently"
                )
    return records


def save(result: StudyResult, folder: ResultFolder, others: Iterable[JournalEntry] = ()) -> None:
    """Write the experiments, the numbers of all runs, the summary and the tables."""
    _begin(result, folder, others)
    folder.write("runs.csv", runs_csv(result))
    folder.write("study.json", json.dumps(result.as_mapping(), indent=2) + "\n")
    folder.write("tables.txt", study_text(result))
    folder.write("tables.md", study_markdown(result))
    totals = result.engine_totals()
    if totals:
        folder.write("engines.csv", engines_csv(totals))


def runs_csv(result: StudyResult) -> str:
    """Return every number of every run: of all judged joints, then joint by joint."""
    keys = [quantity.key for quantity in QUANTITIES]
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


def _digests(plan: StudyPlan) -> dict[tuple[str, str], str]:
    return {(each.experiment.name, each.engine): each.digest for each in plan.entries}


def _begin(result: StudyResult, folder: ResultFolder, others: Iterable[JournalEntry]) -> None:
    """Write the experiments, and the journal in the plan's order, however the runs ended."""
    plan, records, digests = result.plan, result.records, _digests(result.plan)
    for entry in plan.entries:
        folder.write(f"experiments/{entry.experiment.name}.yaml", entry.experiment.text)
    made = [
        JournalEntry(key, digests[key.experiment, key.engine], records[key])
        for key in plan.tasks()
        if key in records
    ]
    folder.write(JOURNAL, "".join(f"{each.line()}\n" for each in (*made, *others)))

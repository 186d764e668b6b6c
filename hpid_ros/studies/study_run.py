"""Runs a study, keeps every run as it ends, and leaves its folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

from hpid_ros.base.errors import ResultExistsError, SettingError
from hpid_ros.base.foreign_text import csv_text
from hpid_ros.experiment.result.folder import ResultFolder
from hpid_ros.report.tables.engine_tables import engines_csv
from hpid_ros.studies.batch import Outcome, Runner
from hpid_ros.studies.study_plan import (
    QUANTITIES,
    TOTAL,
    RunKey,
    RunRecord,
    StudyPlan,
    read_journal,
)
from hpid_ros.studies.study_result import StudyResult
from hpid_ros.studies.study_tables import study_markdown, study_text

JOURNAL = "runs.jsonl"


def study_folder(
    path: Path, *, force: bool = False, resume: bool = False, inputs: Iterable[Path] = ()
) -> ResultFolder:
    """Return the folder of a study, made anew or carried on."""
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
    records = kept_records(plan, folder.path)
    tasks = {key: task for key, task in plan.tasks().items() if key not in records}
    keys = tuple(tasks)
    result = StudyResult(plan, records)
    wanted = plan.tasks().keys()
    others = [each for each in read_journal(folder.path / JOURNAL) if each.key not in wanted]
    _begin(plan, folder, records, others)
    try:
        with (
            folder.file(JOURNAL).open("a", encoding="utf-8") as lines,
            closing(run(tuple(tasks.values()))) as batch,
        ):
            for outcome in batch:
                key = keys[outcome.place]
                digest = digests[key.experiment, key.engine]
                record = RunRecord.of(key, digest, outcome.indices, outcome.failure)
                records[key] = record
                lines.write(record.line() + "\n")
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


def kept_records(plan: StudyPlan, *folders: Path) -> dict[RunKey, RunRecord]:
    """Return the runs in folders that are still those of the plan and did not fail."""
    digests = _digests(plan)
    wanted = set(plan.tasks())
    records: dict[RunKey, RunRecord] = {}
    for journal in (folder / JOURNAL for folder in folders):
        for record in read_journal(journal):
            key = record.key
            if key not in wanted or record.failure:
                continue
            if record.digest != digests[key.experiment, key.engine]:
                continue
            if records.setdefault(key, record) != record:
                raise SettingError(
                    f"{journal}: {key.experiment} {key.controller} seed={key.seed} in "
                    f"{key.engine} is there with other numbers than before; one of the two is "
                    "wrong, or made on a machine that computes differently"
                )
    return records


def save(result: StudyResult, folder: ResultFolder, others: Iterable[RunRecord] = ()) -> None:
    """Write the experiments, the numbers of all runs, the summary and the tables."""
    _begin(result.plan, folder, result.records, others)
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
    """Return what decides the numbers of each experiment in each engine."""
    return {(each.experiment.name, each.engine): each.digest for each in plan.entries}


def _begin(
    plan: StudyPlan,
    folder: ResultFolder,
    records: Mapping[RunKey, RunRecord],
    others: Iterable[RunRecord],
) -> None:
    """Write the experiments, and the journal in the plan's order, however the runs ended."""
    for entry in plan.entries:
        folder.write(f"experiments/{entry.experiment.name}.yaml", entry.experiment.text)
    kept = [records[key] for key in plan.tasks() if key in records]
    folder.write(JOURNAL, "".join(f"{each.line()}\n" for each in (*kept, *others)))

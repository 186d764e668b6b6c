"""Runs a sweep and leaves its folder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing

from hpid_ros.experiment.batch import Outcome, run_batch
from hpid_ros.experiment.result_folder import EXPERIMENT, ResultFolder
from hpid_ros.experiment.sweep import Sweep
from hpid_ros.experiment.sweep_result import SweepResult
from hpid_ros.experiment.sweep_table import sweep_text


def run_sweep(
    sweep: Sweep, folder: ResultFolder, jobs: int | None, advanced: Callable[[Outcome], None]
) -> SweepResult:
    """Run every row with every seed, and save what was run, also when interrupted.

    Args:
        sweep: What to run.
        folder: Where to save it.
        jobs: As for :func:`~hpid_ros.experiment.batch.run_batch`.
        advanced: Is told of every run that has ended.

    Raises:
        SettingError: As for :func:`~hpid_ros.experiment.batch.run_batch`.
        RunError: A process died.
    """
    folder.write(EXPERIMENT, sweep.experiment.text)
    tasks = sweep.tasks()
    keys = tuple(tasks)
    outcomes: dict[tuple[int, int], Outcome] = {}
    result = SweepResult(sweep, outcomes)
    try:
        with closing(run_batch(tuple(tasks.values()), jobs)) as batch:
            for outcome in batch:
                outcomes[keys[outcome.place]] = outcome
                advanced(outcome)
    finally:
        save(result, folder)
    return result


def save(result: SweepResult, folder: ResultFolder) -> None:
    """Write every run, the summary and the table.

    Args:
        result: The result.
        folder: Its folder.
    """
    folder.write("sweep.csv", result.runs_csv())
    folder.write("sweep.json", result.json())
    folder.write("table.txt", sweep_text(result))

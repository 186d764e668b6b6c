"""``hpid study``: experiments over many seeds, and what becomes of the paper's claims."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from rich.console import Console

from hpid_ros.base.console import TextConsole
from hpid_ros.base.errors import SettingError
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import (
    chosen_engines,
    chosen_runner,
    output_folder,
    print_engine_note,
    result_announced,
    run_progress,
)
from hpid_ros.cli.terminal import output_console
from hpid_ros.experiment.study import (
    StudyResult,
    grids,
    merged,
    run_study,
    runs_csv,
    save,
    study_folder,
)
from hpid_ros.experiment.study_plan import (
    ALL,
    JOURNAL,
    StudyPlan,
    default_files,
    is_robot_installed,
    kept_records,
    plan_study,
    shard_of,
)
from hpid_ros.report.table import grids_markdown, grids_text


def run(options: argparse.Namespace) -> int:
    """Run the study and print its tables."""
    if options.resume and (options.force or options.output is None):
        raise SettingError("--resume needs the study's folder as --output, and not --force")
    plan = _plan(options)
    console = TextConsole(stderr=True)
    if options.merge:
        return _merge(options, plan, console)
    with chosen_runner(options, console) as runner:
        folder = study_folder(
            output_folder(options, "study"),
            force=options.force,
            resume=options.resume,
            inputs=plan.inputs,
        )
        print_engine_note(entry.experiment for entry in plan.entries)
        with result_announced(console, folder, "what was run"):
            runs = len(plan.tasks()) - len(kept_records(plan, folder.path))
            with folder, run_progress(console, runs) as ended:
                result = run_study(plan, folder, runner, ended)
            _print(result, options.format)
    return FAILED if result.table.failures else DONE


def _plan(options: argparse.Namespace) -> StudyPlan:
    if options.merge and (options.shard or options.resume):
        raise SettingError("--merge makes no run: neither --shard nor --resume goes with it")
    engines = chosen_engines(options)
    files = options.experiments or _shipped_files()
    return plan_study(
        files,
        joints=options.joint,
        seeds=options.seeds,
        engines=engines,
        shard=shard_of(options.shard) if options.shard else ALL,
    )


def _merge(options: argparse.Namespace, plan: StudyPlan, console: Console) -> int:
    result = merged(plan, options.merge)
    inputs = [*plan.inputs, *(part / JOURNAL for part in options.merge)]
    path = output_folder(options, "study")
    with study_folder(path, force=options.force, inputs=inputs) as folder:
        save(result, folder)
    _print(result, options.format)
    console.print(f"result: {folder.path}", soft_wrap=True)
    return DONE


def _shipped_files() -> list[Path]:
    """Return this package's experiments whose robots are installed, and say which are not."""
    files = default_files()
    missing = [file for file in files if not is_robot_installed(file)]
    if missing:
        names = ", ".join(file.stem for file in missing)
        print(f"hpid: left out, because their robots are not installed: {names}", file=sys.stderr)
    return [file for file in files if file not in missing]


def _print(result: StudyResult, form: str) -> None:
    is_table = form in ("table", "text")
    if is_table and sys.stdout.isatty():
        console = output_console()
        for grid in grids(result):
            console.print(grid)
    elif form == "json":
        print(json.dumps(result.as_mapping(), indent=2))
    elif form == "csv":
        print(runs_csv(result), end="")
    else:
        print((grids_text if is_table else grids_markdown)(grids(result)), end="")

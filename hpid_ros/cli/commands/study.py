"""``hpid study``: experiments over many seeds, and what becomes of the paper's claims."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import SettingError
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import (
    add_engine,
    add_jobs,
    add_joints,
    add_output,
    chosen_engines,
    chosen_runner,
    output_folder,
    print_engine_note,
    result_announced,
    run_progress,
)

if TYPE_CHECKING:
    from rich.console import Console

    from hpid_ros.experiment.study import StudyResult
    from hpid_ros.experiment.study_plan import StudyPlan


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "study",
        description="Run every controller of every experiment with many seeds, without ROS, on "
        "every core. Prints medians with quartiles, ratios to each experiment's first "
        "controller, and for every claim of the paper whether it holds.",
        epilog="A run that fails is named, the others go on, and the exit code is 1. An "
        "interrupt leaves what was run; --resume carries on. The numbers are those of hpid "
        "compare, to the last bit, with any number of jobs.",
    )
    parser.add_argument(
        "experiments",
        nargs="*",
        metavar="FILE",
        help="experiment files (all of this package but the bricks)",
    )
    add_joints(parser, "judge this joint; may be repeated (those that each experiment judges)")
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="runs of each controller (20)"
    )
    add_engine(parser, or_both=True)
    add_jobs(parser)
    add_output(parser, "study")
    parser.add_argument(
        "--resume", action="store_true", help="carry on the study in the output folder"
    )
    parser.add_argument(
        "--shard", metavar="K/N", help="make only the K-th of N parts of the runs (all)"
    )
    parser.add_argument(
        "--merge",
        action="append",
        type=Path,
        metavar="FOLDER",
        help="run nothing: put the shards of the same study together; once for each",
    )
    parser.add_argument(
        "--table",
        choices=("text", "docs", "csv", "json"),
        default="text",
        help="of the output; docs is Markdown",
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run the study and print its tables."""
    from hpid_ros.base.console import TextConsole
    from hpid_ros.experiment.study import run_study, study_folder
    from hpid_ros.experiment.study_plan import kept_records

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
            _print(result, options.table)
    return FAILED if result.table.failures else DONE


def _plan(options: argparse.Namespace) -> StudyPlan:
    from hpid_ros.experiment.study_plan import ALL, plan_study, shard_of

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
    from hpid_ros.experiment.study import merged, save, study_folder
    from hpid_ros.experiment.study_plan import JOURNAL

    result = merged(plan, options.merge)
    inputs = [*plan.inputs, *(part / JOURNAL for part in options.merge)]
    path = output_folder(options, "study")
    with study_folder(path, force=options.force, inputs=inputs) as folder:
        save(result, folder)
    _print(result, options.table)
    console.print(f"result: {folder.path}", soft_wrap=True, highlight=False)
    return DONE


def _shipped_files() -> list[Path]:
    """Return this package's experiments whose robots are installed, and say which are not."""
    from hpid_ros.experiment.study_plan import default_files, is_robot_installed

    files = default_files()
    missing = [file for file in files if not is_robot_installed(file)]
    if missing:
        names = ", ".join(file.stem for file in missing)
        print(f"hpid: left out, because their robots are not installed: {names}", file=sys.stderr)
    return [file for file in files if file not in missing]


def _print(result: StudyResult, form: str) -> None:
    import json

    from hpid_ros.cli.terminal import output_console
    from hpid_ros.experiment.study import grids, runs_csv, study_markdown, study_text

    if form == "text" and sys.stdout.isatty():
        console = output_console()
        for grid in grids(result):
            console.print(grid)
    elif form == "json":
        print(json.dumps(result.as_mapping(), indent=2))
    else:
        texts = {"text": study_text, "docs": study_markdown, "csv": runs_csv}
        print(texts[form](result), end="")

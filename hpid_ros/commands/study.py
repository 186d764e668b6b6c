"""``hpid study``: experiments over many seeds, and what becomes of the paper's claims."""

from __future__ import annotations

import argparse
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.commands import DONE, FAILED
from hpid_ros.commands.batch_progress import batch_progress
from hpid_ros.errors import SettingError

if TYPE_CHECKING:
    from hpid_ros.experiment.study_result import StudyResult


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "study",
        help="run experiments over many seeds and hold the paper's claims to them",
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
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="NAME",
        help="judge this joint; may be repeated (those that each experiment judges)",
    )
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="runs of each controller (20)"
    )
    parser.add_argument(
        "-j", "--jobs", type=int, metavar="N", help="processes (one for each processor)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="folder (results/study-TIME)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing result")
    parser.add_argument(
        "--resume", action="store_true", help="carry on the study in the output folder"
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
    from rich.console import Console

    from hpid_ros.experiment.study_plan import default_files, plan_study
    from hpid_ros.experiment.study_run import kept_records, run_study, study_folder

    if options.jobs is not None and options.jobs < 1:
        raise SettingError(f"--jobs must be at least 1, not {options.jobs}")
    if options.resume and (options.force or options.output is None):
        raise SettingError("--resume needs the study's folder as --output, and not --force")
    files = options.experiments or default_files()
    plan = plan_study(files, joints=options.joint, seeds=options.seeds)
    path = options.output or Path("results") / f"study-{datetime.now():%Y%m%d-%H%M%S}"
    folder = study_folder(path, force=options.force, resume=options.resume)
    told = Console(stderr=True)
    try:
        runs = len(plan.tasks()) - len(kept_records(plan, folder))
        with batch_progress(told, runs) as advanced:
            result = run_study(plan, folder, options.jobs, advanced)
    except KeyboardInterrupt:
        told.print(f"what was run: {folder.path}", soft_wrap=True, highlight=False)
        raise
    _print(result, options.table)
    told.print(f"result: {folder.path}", soft_wrap=True, highlight=False)
    return FAILED if result.failures else DONE


def _print(result: StudyResult, form: str) -> None:
    import json

    from rich.console import Console

    from hpid_ros.experiment.study_run import runs_csv
    from hpid_ros.experiment.study_tables import grids, study_markdown, study_text

    if form == "text" and sys.stdout.isatty():
        console = Console()
        for grid in grids(result):
            console.print(grid)
    elif form == "json":
        print(json.dumps(result.as_mapping(), indent=2))
    else:
        texts = {"text": study_text, "docs": study_markdown, "csv": runs_csv}
        print(texts[form](result), end="")

"""``hpid sweep``: a grid over the parameters of one controller, on every core."""

from __future__ import annotations

import argparse
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.commands import DONE, FAILED
from hpid_ros.commands.batch_progress import batch_progress
from hpid_ros.commands.compare import DEFAULT_EXPERIMENT
from hpid_ros.resources import find_resource

if TYPE_CHECKING:
    from hpid_ros.experiment.sweep_result import SweepResult


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "sweep",
        help="run a controller over a grid of its parameters, without ROS, on every core",
        description="Run one controller of an experiment over a grid of parameters and seeds, "
        "without ROS, and compare every point with the experiment's first controller as it "
        "stands. The numbers are those of hpid compare, to the last bit.",
        epilog="A point that a loop refuses stays in the table with the reason; a run that "
        "fails is named there, the others go on, and the exit code is 1. An interrupt ends at "
        "once and leaves what was run.",
    )
    parser.add_argument(
        "experiment", nargs="?", metavar="FILE", help="experiment file (the paper's comparison)"
    )
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        required=True,
        metavar="NAME=VALUES",
        help="START:STOP:COUNT or VALUE,VALUE,... of a controller parameter, or of payload, "
        "physics_steps or encoder_counts; several make a grid",
    )
    parser.add_argument(
        "--controller", metavar="LABEL", help="which (the first after the baseline)"
    )
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="NAME",
        help="vary and judge this joint only; may be repeated",
    )
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="runs of each point (20)"
    )
    parser.add_argument(
        "-j", "--jobs", type=int, metavar="N", help="processes (one for each processor)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="folder (results/NAME-sweep-TIME)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing result")
    parser.add_argument(
        "--format", choices=("table", "csv", "json"), default="table", help="of the output"
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run the sweep and print its table."""
    from rich.console import Console

    from hpid_ros.errors import SettingError
    from hpid_ros.experiment.description import load_experiment
    from hpid_ros.experiment.result_folder import ResultFolder
    from hpid_ros.experiment.sweep import plan_sweep
    from hpid_ros.experiment.sweep_axes import Axis
    from hpid_ros.experiment.sweep_run import run_sweep

    axes = [Axis.parse(text) for text in options.vary]
    if options.jobs is not None and options.jobs < 1:
        raise SettingError(f"--jobs must be at least 1, not {options.jobs}")
    experiment = load_experiment(options.experiment or find_resource(DEFAULT_EXPERIMENT))
    sweep = plan_sweep(
        experiment,
        axes,
        controller=options.controller,
        joints=options.joint,
        seeds=options.seeds,
    )
    name = f"{experiment.name}-sweep-{datetime.now():%Y%m%d-%H%M%S}"
    path = options.output or Path("results") / name
    folder = ResultFolder.create(path, force=options.force, parts=())
    told = Console(stderr=True)
    try:
        with batch_progress(told, len(sweep.tasks())) as advanced:
            result = run_sweep(sweep, folder, options.jobs, advanced)
    except KeyboardInterrupt:
        told.print(f"what was run: {folder.path}", soft_wrap=True, highlight=False)
        raise
    _print(result, options.format)
    told.print(f"result: {folder.path}", soft_wrap=True, highlight=False)
    return FAILED if result.failures else DONE


def _print(result: SweepResult, form: str) -> None:
    from rich.console import Console

    from hpid_ros.experiment.sweep_table import SweepTable, sweep_text

    if form == "table" and sys.stdout.isatty():
        Console().print(SweepTable(result))
    else:
        texts = {"table": sweep_text, "csv": type(result).summary_csv, "json": type(result).json}
        print(texts[form](result), end="")

"""``hpid sweep``: a grid over the parameters of one controller, on every core."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import (
    add_engine,
    add_experiment,
    add_jobs,
    add_joints,
    add_output,
    chosen_runner,
    experiment_to_run,
    output_folder,
    print_engine_note,
    result_announced,
    run_progress,
)

if TYPE_CHECKING:
    from hpid_ros.experiment.sweep import SweepResult


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "sweep",
        description="Run one controller of an experiment over a grid of parameters and seeds, "
        "without ROS, and compare every point with the experiment's first controller as it "
        "stands. The numbers are those of hpid compare, to the last bit.",
        epilog="A point that a loop refuses stays in the table with the reason; a run that "
        "fails is named there, the others go on, and the exit code is 1. An interrupt ends at "
        "once and leaves what was run.",
    )
    add_experiment(parser)
    add_engine(parser)
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
    add_joints(parser, "vary and judge this joint only; may be repeated")
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="runs of each point (20)"
    )
    add_jobs(parser)
    add_output(parser, "NAME-sweep")
    parser.add_argument(
        "--format", choices=("table", "csv", "json"), default="table", help="of the output"
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run the sweep and print its table."""
    from hpid_ros.base.console import TextConsole
    from hpid_ros.experiment.result_folder import ResultFolder
    from hpid_ros.experiment.sweep import Axis, plan_sweep, run_sweep

    axes = [Axis.parse(text) for text in options.vary]
    experiment = experiment_to_run(options)
    sweep = plan_sweep(
        experiment,
        axes,
        controller=options.controller,
        joints=options.joint,
        seeds=options.seeds,
    )
    console = TextConsole(stderr=True)
    with chosen_runner(options, console) as runner:
        path = output_folder(options, f"{experiment.name}-sweep")
        folder = ResultFolder.create(path, force=options.force, inputs=experiment.inputs)
        print_engine_note([experiment])
        with result_announced(console, folder, "what was run"):
            with folder, run_progress(console, len(sweep.tasks())) as ended:
                result = run_sweep(sweep, folder, runner, ended)
            _print(result, options.format)
    return FAILED if result.table.failures else DONE


def _print(result: SweepResult, form: str) -> None:
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.experiment.sweep import SweepTable, sweep_text

    if form == "table" and sys.stdout.isatty():
        output_console().print(SweepTable(result))
    else:
        texts = {"table": sweep_text, "csv": type(result).summary_csv, "json": type(result).json}
        print(texts[form](result), end="")

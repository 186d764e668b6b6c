"""``hpid sweep``: a grid over the parameters of one controller, on every core."""

from __future__ import annotations

import argparse
import sys

from hpid_ros.base.console import TextConsole
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import (
    chosen_runner,
    experiment_to_run,
    output_folder,
    print_engine_note,
    result_announced,
    run_progress,
)
from hpid_ros.cli.terminal import output_console
from hpid_ros.experiment.result_folder import ResultFolder
from hpid_ros.experiment.sweep import (
    Axis,
    SweepResult,
    SweepTable,
    plan_sweep,
    run_sweep,
    sweep_text,
)


def run(options: argparse.Namespace) -> int:
    """Run the sweep and print its table."""
    axes = [Axis.parse(text) for text in options.vary]
    experiment = experiment_to_run(options)
    sweep = plan_sweep(
        experiment, axes, controller=options.controller, joints=options.joint, seeds=options.seeds
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
    if form == "table" and sys.stdout.isatty():
        output_console().print(SweepTable(result))
    else:
        texts = {"table": sweep_text, "csv": type(result).summary_csv, "json": type(result).json}
        print(texts[form](result), end="")

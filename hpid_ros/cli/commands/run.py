"""``hpid run``: one controller of an experiment on the graph, and how its time was spent."""

from __future__ import annotations

import argparse

from hpid_ros.cli.commands import DONE
from hpid_ros.cli.options import experiment_to_run, output_folder
from hpid_ros.cli.terminal import (
    RunProgress,
    output_console,
    print_notes,
    print_result_places,
    print_timing,
)
from hpid_ros.experiment.compare import run_controller
from hpid_ros.experiment.graph_run import GraphOptions
from hpid_ros.report.table import ComparisonTable


def run(options: argparse.Namespace) -> int:
    """Run the controller and print what it gave."""
    graph = GraphOptions(
        processes=options.processes,
        is_recorded=not options.no_record,
        is_realtime=options.realtime,
        realtime_priority=options.realtime_priority,
    )
    experiment = experiment_to_run(options)
    label = options.controller or list(experiment.controllers)[-1]
    output = output_folder(options, experiment.name)
    console = output_console()
    with RunProgress(console, experiment, [label]) as progress:
        report, result = run_controller(
            *(experiment, label, output, progress, graph),
            force=options.force,
            is_tried=not options.no_trial,
        )
    if result:
        console.print(ComparisonTable(result.comparison))
        print_notes(console, result.notes)
    print_timing(console, report, experiment.duration)
    print_result_places(console, {"result": output})
    return DONE

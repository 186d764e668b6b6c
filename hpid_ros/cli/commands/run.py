"""``hpid run``: one controller of an experiment on the graph, and how its time was spent."""

from __future__ import annotations

import argparse
from typing import Any

from hpid_ros.cli.commands import DONE
from hpid_ros.cli.options import (
    add_engine,
    add_experiment,
    add_output,
    experiment_to_run,
    output_folder,
)


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "run",
        description="Run one controller of an experiment on the real ROS 2 graph, record it, and "
        "end with its indices and with a table of periods, compute times, latencies and losses.",
    )
    add_experiment(parser)
    add_engine(parser)
    parser.add_argument(
        "--controller", metavar="LABEL", help="which of its controllers (the last one)"
    )
    spread = parser.add_mutually_exclusive_group()
    for option, processes, text in (
        ("--composed", "composed", "all controllers in one process, not one each"),
        ("--single-process", "single", "controllers and robot in one process"),
    ):
        spread.add_argument(
            option, dest="processes", action="store_const", const=processes, help=text
        )
    parser.add_argument(
        "--realtime", action="store_true", help="paced by the wall clock, not in lock-step"
    )
    parser.add_argument(
        "--no-trial",
        action="store_true",
        help="with --realtime: begin at once, without a second in lock-step that tells what rate "
        "the machine holds",
    )
    parser.add_argument(
        "--realtime-priority",
        type=int,
        default=0,
        metavar="N",
        help="SCHED_FIFO priority of the control loop, 1 to 99",
    )
    parser.add_argument("--no-record", action="store_true", help="leave no bag and no indices")
    add_output(parser, "NAME")
    parser.set_defaults(command=run, processes="each")


def run(options: argparse.Namespace) -> int:
    """Run the controller and print what it gave."""
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

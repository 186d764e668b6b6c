"""``hpid compare``: run the controllers of an experiment and compare them."""

from __future__ import annotations

import argparse
from typing import Any

from hpid_ros.cli.commands import DONE
from hpid_ros.cli.commands.options import (
    add_engine,
    add_experiment,
    add_output,
    named_experiment,
    output_folder,
)


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "compare",
        help="run the controllers of an experiment, one process per joint, and compare them",
        description="Run the controllers of an experiment on the real ROS 2 graph, one process "
        "per joint, record everything, and leave tables, figures and a report.",
    )
    add_experiment(parser)
    add_engine(parser)
    add_output(parser, "NAME")
    parser.add_argument(
        "--in-process", action="store_true", help="run without ROS; the numbers are the same"
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Run the comparison and print what it gave."""
    # Imported here, as in every command: --help and errors do not wait for them.
    from hpid_ros.cli.terminal import RunProgress, output_console, print_notes, print_reports
    from hpid_ros.experiment.compare import compare
    from hpid_ros.report.tables.table import ComparisonTable

    experiment = named_experiment(options.experiment, options.engine)
    output = output_folder(options, experiment.name)
    console = output_console()
    period = experiment.world.control_period_ns * 1e-9
    labels = tuple(experiment.controllers)
    with RunProgress(console, experiment.duration, labels, period) as progress:
        compared = compare(
            experiment, output, progress, in_process=options.in_process, force=options.force
        )
    console.print(ComparisonTable(compared.result.comparison))
    print_notes(console, compared.result.notes)
    print_reports(console, compared.reports, experiment.duration, compared.folder.path)
    return DONE

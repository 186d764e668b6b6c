"""``hpid``: the umbrella command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from rich.console import Console

from hpid_ros import __version__
from hpid_ros.errors import HpidError, RunError
from hpid_ros.interrupts import heed_interrupts
from hpid_ros.resources import find_resource
from hpid_ros.terminal import RunProgress, print_reports

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done; something failed while running; unusable input; interrupted."""

DEFAULT_EXPERIMENT = "config/experiments/paper.yaml"


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        args: Arguments after the program's name; None for those of the process.
    """
    options = _parser().parse_args(args)
    heed_interrupts()
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except RunError as error:
        print(f"hpid: {error}", file=sys.stderr)
        return FAILED
    except HpidError as error:
        print(f"hpid: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("hpid: interrupted", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hpid", description="Linear and homogeneous PID, joint by joint, on ROS 2."
    )
    parser.add_argument("--version", action="version", version=f"hpid_ros {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_compare(commands)
    _add_metrics(commands)
    return parser


def _add_compare(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    compare = commands.add_parser(
        "compare",
        help="run the controllers of an experiment, one process per joint, and compare them",
        description="Run the controllers of an experiment on the real ROS 2 graph, one process "
        "per joint, record everything, and leave tables, figures and a report.",
    )
    compare.add_argument(
        "experiment", nargs="?", metavar="FILE", help="experiment file (the paper's comparison)"
    )
    compare.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="result folder (results/NAME-TIME)"
    )
    compare.add_argument("--force", action="store_true", help="replace an existing result")
    compare.add_argument(
        "--in-process", action="store_true", help="run without ROS; the numbers are the same"
    )
    compare.set_defaults(command=_compare)


def _add_metrics(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    metrics = commands.add_parser(
        "metrics",
        help="compute the indices of recorded bags",
        description="Compute IVC, IAVC, ITAE and the L2 norms of bags, the first the baseline.",
    )
    metrics.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="bag folder or file")
    metrics.add_argument("--labels", nargs="+", metavar="LABEL", help="one for each bag")
    metrics.add_argument("--joints", nargs="+", metavar="JOINT", help="only these joints")
    metrics.add_argument(
        "--format",
        choices=("table", "csv", "json", "latex"),
        default="table",
        help="of the output",
    )
    metrics.set_defaults(command=_metrics)


def _compare(options: argparse.Namespace) -> int:
    from hpid_ros.analysis.table import ComparisonTable
    from hpid_ros.experiment.compare import compare
    from hpid_ros.experiment.description import load_experiment

    experiment = load_experiment(options.experiment or find_resource(DEFAULT_EXPERIMENT))
    output = (
        options.output or Path("results") / f"{experiment.name}-{datetime.now():%Y%m%d-%H%M%S}"
    )
    console = Console()
    period = experiment.world.control_period_ns * 1e-9
    labels = tuple(experiment.controllers)
    with RunProgress(console, experiment.duration, labels, period) as progress:
        compared = compare(
            experiment, output, progress, in_process=options.in_process, force=options.force
        )
    console.print(ComparisonTable(compared.result.comparison))
    print_reports(console, compared.reports, experiment.duration, compared.folder.path)
    return DONE


def _metrics(options: argparse.Namespace) -> int:
    from hpid_ros.analysis.formats import FORMATS
    from hpid_ros.analysis.table import ComparisonTable
    from hpid_ros.bags.comparison import compare_bags

    comparison = compare_bags(options.bags, options.labels or (), options.joints)
    if options.format == "table" and sys.stdout.isatty():
        Console().print(ComparisonTable(comparison))
    else:
        print(FORMATS[options.format](comparison), end="")
    return DONE


if __name__ == "__main__":
    sys.exit(main())

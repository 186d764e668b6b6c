"""``hpid metrics``: the indices of recorded bags."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from hpid_ros.commands import DONE


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "metrics",
        help="compute the indices of recorded bags",
        description="Compute IVC, IAVC, ITAE and the L2 norms of bags, the first the baseline.",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="bag folder or file")
    parser.add_argument("--labels", nargs="+", metavar="LABEL", help="one for each bag")
    parser.add_argument("--joints", nargs="+", metavar="JOINT", help="only these joints")
    parser.add_argument(
        "--format",
        choices=("table", "csv", "json", "latex"),
        default="table",
        help="of the output",
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Read the bags and print their indices."""
    from rich.console import Console

    from hpid_ros.analysis.formats import FORMATS
    from hpid_ros.analysis.table import ComparisonTable
    from hpid_ros.bags.comparison import compare_bags

    comparison = compare_bags(options.bags, options.labels or (), options.joints)
    if options.format == "table" and sys.stdout.isatty():
        Console().print(ComparisonTable(comparison))
    else:
        print(FORMATS[options.format](comparison), end="")
    return DONE

"""``hpid repair``: make a recording whole again that was cut off or damaged."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.cli.commands import DONE

_EXAMPLES = """\
examples:
  hpid repair my_bag                  the readable part into my_bag_repaired
  hpid repair my_bag.mcap -o saved    of one file that lost its folder

The old bag is never changed. Exit codes: 0 a bag was written (what was lost is
listed), 2 nothing could be read or written.
"""


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "repair",
        description="Write every message that can be read into a new bag, with its index and\n"
        "metadata.yaml, and say what was saved and what was lost.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="a bag folder, or one file of it")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FOLDER",
        help="the new bag, which must not exist; BAG_repaired next to BAG if not given",
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Repair a bag and say what came of it."""
    from hpid_ros.base.processes import raise_if_interrupted
    from hpid_ros.messages.writer import repair_bag

    bag: Path = options.bag
    target = options.output or bag.resolve().with_name(f"{bag.resolve().stem}_repaired")
    repair = repair_bag(bag, target, lambda share: raise_if_interrupted())
    for name, count in sorted(repair.saved.items()):
        print(f"saved: {count} messages on {name}")
    if repair.span_ns is not None:
        first, last = (time_ns / NANOSECONDS for time_ns in repair.span_ns)
        print(f"saved: {last - first:.3f} s, from {first:.3f} s to {last:.3f} s")
    for line in repair.unreadable or ["nothing"]:
        print(f"lost: {line}")
    print(f"written: {repair.target}")
    return DONE

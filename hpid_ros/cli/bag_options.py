"""Options that say what is read from a bag."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hpid_ros.bags.selection import BagSelection, Reference


def add_topics(group: Any) -> None:
    """Add ``--namespace``, ``--states``, ``--commands`` and ``--command-topic``."""
    group.add_argument("--namespace", metavar="NAME", help="which of several robots")
    group.add_argument(
        "--states",
        action="append",
        metavar="TOPIC",
        help="of the joint states; once for each topic of one robot",
    )
    group.add_argument(
        "--commands",
        metavar="TOPIC",
        help="of the efforts; effort: *_controller/commands are efforts, the topic of the states: "
        "measured ones, none: none (found by name and type, else the measured ones)",
    )
    group.add_argument(
        "--command-topic",
        action="append",
        default=[],
        metavar="JOINT=TOPIC[INDEX]",
        help="of one joint's efforts; may be given several times",
    )


def add_time(group: Any) -> None:
    """Add ``--clock``, ``--start`` and ``--end``."""
    group.add_argument(
        "--clock", default="header", metavar="CLOCK", help="header or receive (header)"
    )
    group.add_argument("--start", type=float, metavar="S", help="seconds after the first state")
    group.add_argument("--end", type=float, metavar="S", help="seconds after the first state")


def bag_selection(
    options: argparse.Namespace,
    joints: Sequence[str] | None,
    reference: Reference = "auto",
    separates_runs: bool = False,
) -> BagSelection:
    """Return what the options choose."""
    from hpid_ros.bags.selection import BagSelection, parse_command_topics

    return BagSelection(
        joints=joints,
        namespace=options.namespace,
        states=options.states,
        commands=options.commands,
        command_topics=parse_command_topics(options.command_topic),
        reference=reference,
        clock=options.clock,
        start=options.start,
        end=options.end,
        separates_runs=separates_runs,
    )

"""``hpid repair``: make a recording whole again that was cut off or damaged."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.cli.commands import DONE
from hpid_ros.cli.terminal import reading
from hpid_ros.messages.writer import repair_bag


def run(options: argparse.Namespace) -> int:
    """Repair a bag and say what came of it."""
    bag: Path = options.bag
    found = bag.resolve()
    name = found.name if found.is_dir() else found.stem
    target = options.output or found.with_name(f"{name}_repaired")
    with reading() as tell:
        repair = repair_bag(bag, target, partial(tell, bag.name))
    for name, count in sorted(repair.saved.items()):
        print(f"saved: {count} messages on {name}")
    if repair.span_ns is not None:
        first, last = (time_ns / NANOSECONDS for time_ns in repair.span_ns)
        print(f"saved: {last - first:.3f} s, from {first:.3f} s to {last:.3f} s")
    for line in repair.unreadable or ["nothing"]:
        print(f"lost: {line}")
    print(f"written: {repair.target}")
    return DONE

"""What a merger adds: the time from a state to the efforts of nine joints, with and without it.

    python -m benchmarks.merging [--rounds 3] [--seconds 5] [--rate 1000] [--joints 9]
        [--realtime-priority 50]

Nine controllers, each in its process or all in one, answer the states of a robot that waits for
nobody. Without a merger the last of nine messages counts, with one the last of those for the same
state. The four forms take turns, so that what the machine does meanwhile happens to all alike.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from benchmarks.processes import Scripts
from hpid_bench.experiment.processes import NodeGroup, closed_environment, own_domain
from hpid_ros.base.errors import RunError
from hpid_ros.base.names import controller_name

_WITHIN = 90.0  # [s] for nodes to find each other, beside the time that is measured
_LOOP = {
    "law": "pid",
    "gains.p": "10.0",
    "gains.d": "3.0",
    "state_timeout": "1.0",
    "certify": "false",
}
_MERGER = {"command_interface": "joint_state", "command_timeout": "1.0"}


class Form(NamedTuple):
    """How the controllers are spread, and whether there is a merger."""

    is_composed: bool  # whether they are in one process
    is_merged: bool  # whether their commands are merged


FORMS = {
    "a process each": Form(is_composed=False, is_merged=False),
    "a process each, and a merger": Form(is_composed=False, is_merged=True),
    "one process": Form(is_composed=True, is_merged=False),
    "one process, merged in it": Form(is_composed=True, is_merged=True),
}


def _arguments(parameters: Mapping[str, str]) -> list[str]:
    return [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]


class Load(NamedTuple):
    """What all forms are measured with."""

    joints: list[str]  # names of the joints
    rate: float  # states in a second
    seconds: float  # how long
    priority: int  # real-time priority of all processes; 0 for none


def _start(nodes: NodeGroup, form: Form, load: Load) -> None:
    joints, common = load.joints, _LOOP | {"realtime_priority": str(load.priority)}
    order = {"joints": f"[{', '.join(joints)}]"}
    if form.is_composed:
        merger = {"merge": "true", **_MERGER} if form.is_merged else {}
        name = "joint_controllers"
        nodes.start(name, name, _arguments(common | order | merger), is_renamed=False)
        return
    for joint in joints:
        arguments = _arguments(common | {"joint": joint})
        nodes.start(controller_name(joint), "joint_controller", arguments)
    if form.is_merged:
        parameters = order | _MERGER | {"realtime_priority": str(load.priority)}
        nodes.start("joint_command_merger", "joint_command_merger", _arguments(parameters))


def measure(form: Form, load: Load) -> Mapping[str, float]:
    """Run one form once.

    Returns:
        ``median`` and ``p99`` of the time from a state to the last effort that answers it, in
        [us]; ``answered``, the part of the states that this is known of; ``messages`` a state.
    """
    with (
        tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder,
        own_domain() as domain,
        NodeGroup(closed_environment(domain), Path(folder)) as nodes,
        Scripts(closed_environment(domain), Path(folder)) as scripts,
    ):
        pace = [
            "--states",
            str(round(load.rate * load.seconds)),
            "--rate",
            str(load.rate),
            "--realtime-priority",
            str(load.priority),
            "--joints",
            *load.joints,
        ]
        scripts.start("pacer", "pacer", pace + ["--merged"] * form.is_merged)
        _start(nodes, form, load)
        result = scripts.result("pacer", _WITHIN + load.seconds)
    if "median" not in result:
        raise RunError("no state was answered by all joints")
    return {name: float(value) for name, value in result.items()}


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="states in a second")
    parser.add_argument("--joints", type=int, default=9)
    parser.add_argument("--realtime-priority", type=int, default=0, help="of all processes")
    options = parser.parse_args()
    joints = [f"joint_{number}" for number in range(options.joints)]
    load = Load(joints, options.rate, options.seconds, options.realtime_priority)
    found: dict[str, list[Mapping[str, float]]] = {name: [] for name in FORMS}
    for _ in range(options.rounds):
        for name, form in FORMS.items():
            try:
                found[name].append(measure(form, load))
            except RunError as error:
                print(f"{name}: {error}", file=sys.stderr)
                return 1
    _print(found)
    return 0


def _print(found: Mapping[str, list[Mapping[str, float]]]) -> None:
    """Print medians over the rounds, and what a merger adds within each."""
    print(f"{'form':<30} {'median':>7} {'99 %':>7} {'answered':>9} {'messages':>9}  [us], a state")
    for name, rounds in found.items():
        middle = {key: statistics.median(each[key] for each in rounds) for key in rounds[0]}
        print(
            f"{name:<30} {middle['median']:7.0f} {middle['p99']:7.0f} "
            f"{middle['answered']:9.3f} {middle['messages']:9.2f}"
        )
    names = list(found)
    for without, merged in zip(names[::2], names[1::2], strict=True):
        added, ratios = [], []
        for before, after in zip(found[without], found[merged], strict=True):
            added.append(after["median"] - before["median"])
            ratios.append(after["median"] / before["median"])
        print(
            f"{merged}: {statistics.median(added):+.0f} us in the median "
            f"({min(added):+.0f} to {max(added):+.0f}), {statistics.median(ratios):.2f} times "
            f"({min(ratios):.2f} to {max(ratios):.2f})"
        )


if __name__ == "__main__":
    sys.exit(main())

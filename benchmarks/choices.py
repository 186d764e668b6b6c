"""The worth of each choice of the node path: the closed loop with and without it.

    python -m benchmarks.choices [--rounds 5] [--seconds 4]

Eight controllers in their processes, one physics step a cycle, no recorder. Every variant undoes
one choice, or adds one that is off by default; the variants take turns.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

from benchmarks.tracking import tracking
from hpid_ros.base.errors import RunError
from hpid_ros.experiment import graph_run
from hpid_ros.experiment import processes as node_process
from hpid_ros.experiment.graph_run import GraphNodes, GraphOptions
from hpid_ros.experiment.in_process import NoProgress

_WITHOUT_EVENTS = Path(__file__).parent / "without_events_executor"
_PRIORITY = 50
_TOPICS = ("joint_states", "joint_commands")


@contextmanager
def _as_it_is() -> Iterator[GraphOptions]:
    yield GraphOptions("each", is_recorded=False)


@contextmanager
def _wait_set_executor() -> Iterator[GraphOptions]:
    path = os.pathsep.join(filter(None, [str(_WITHOUT_EVENTS), os.environ.get("PYTHONPATH")]))
    with mock.patch.dict(os.environ, PYTHONPATH=path):
        yield GraphOptions("each", is_recorded=False)


@contextmanager
def _qos(side: str, policy: str) -> Iterator[GraphOptions]:
    """Override a policy of the publishers or of the subscriptions."""
    names = [f"qos_overrides./{topic}.{side}.{policy}" for topic in _TOPICS]
    extra = [argument for name in names for argument in ("-p", name)]
    ordinary = GraphNodes.bridge_arguments, GraphNodes.controller_arguments
    with (
        mock.patch.object(GraphNodes, "bridge_arguments", lambda s: ordinary[0](s) + extra),
        mock.patch.object(GraphNodes, "controller_arguments", lambda s: ordinary[1](s) + extra),
    ):
        yield GraphOptions("each", is_recorded=False)


@contextmanager
def _ordinary_scheduling() -> Iterator[GraphOptions]:
    group = partial(node_process.NodeGroup)
    with mock.patch.object(graph_run, "NodeGroup", lambda *args, is_batch: group(*args)):
        yield GraphOptions("each", is_recorded=False)


@contextmanager
def _realtime_priority() -> Iterator[GraphOptions]:
    yield GraphOptions("each", is_recorded=False, realtime_priority=_PRIORITY)


VARIANTS: dict[str, Callable[[], AbstractContextManager[GraphOptions]]] = {
    "as it is": _as_it_is,
    "wait-set executor instead of EventsExecutor": _wait_set_executor,
    "ordinary instead of batch scheduling": _ordinary_scheduling,
    "reliable instead of best-effort subscriptions": partial(
        _qos, "subscription", "reliability:=reliable"
    ),
    "best-effort instead of reliable publishers": partial(
        _qos, "publisher", "reliability:=best_effort"
    ),
    "publishers of depth 64 instead of 4000": partial(_qos, "publisher", "depth:=64"),
    f"SCHED_FIFO {_PRIORITY}": _realtime_priority,
}
"""What the closed loop is run with."""


def rate(variant: str, seconds: float) -> float:
    """Return the cycles per second of one run."""
    experiment = replace(tracking(physics_steps=1), duration=seconds)
    with TemporaryDirectory(prefix="hpid_bench_") as folder, VARIANTS[variant]() as options:
        report = graph_run.run_on_graph(
            experiment, "hPID", None, Path(folder), NoProgress(), options
        )
    return report.rate


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0, help="of simulated time in a run")
    options = parser.parse_args()
    rates: dict[str, list[float]] = {name: [] for name in VARIANTS}
    for _ in range(options.rounds):
        for name in VARIANTS:
            try:
                rates[name].append(rate(name, options.seconds))
            except RunError as error:
                print(f"{name}: {error}", file=sys.stderr)
    base = rates["as it is"]
    print(f"{'variant':<48} {'cycles/s':>8} {'ratio':>6}   lowest to highest")
    for name, found in rates.items():
        ratios = sorted(a / b for a, b in zip(found, base, strict=False))
        if ratios:
            middle = statistics.median(ratios)
            print(
                f"{name:<48} {statistics.median(found):8.0f} {middle:6.2f}   "
                f"{ratios[0]:.2f} to {ratios[-1]:.2f}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())

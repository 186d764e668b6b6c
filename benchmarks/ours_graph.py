"""The package's closed loop on the graph, measured from outside."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader

from hpid_bench.experiment.description import Experiment
from hpid_bench.experiment.graph_run import GraphOptions, run_on_graph
from hpid_bench.experiment.in_process import Progress, RunReport
from hpid_ros.base.errors import RunError


class Clock:
    """Progress that notes when a run was how far.

    The rate is that between the first and the last note: it holds neither the start of a run
    nor its end, in which processes come and go.
    """

    def __init__(self) -> None:
        self._notes: list[tuple[float, float]] = []

    def phase(self, label: str, what: str) -> None:
        """Take no note of phases."""

    def note(self, line: str) -> None:
        """Take no note of lines."""

    def advanced(self, label: str, simulated: float) -> None:
        """Note a simulated time in [s]."""
        self._notes.append((time.perf_counter(), simulated))

    def rate(self, period: float) -> float:
        """Return the control periods in a second of wall time."""
        if len(self._notes) < 2:
            raise RunError("the run was too short to tell its rate")
        (begin, first), (end, last) = self._notes[0], self._notes[-1]
        return (last - first) / period / (end - begin)


def run_ours(experiment: Experiment, label: str, options: GraphOptions) -> Mapping[str, float]:
    """Run the closed loop once.

    Returns:
        ``rate`` in control periods per second; ``latency``, the median over the joints of their
        median from a state's publication to the arrival of the answer, in [us].
    """
    clock = Clock()
    report = run_checked(experiment, label, options, clock)
    latencies = [joint["latency"]["median"] for joint in timing_of(report)]
    rate = clock.rate(experiment.world.control_period_ns * 1e-9)
    return {"rate": rate, "latency": statistics.median(latencies)}


def run_checked(
    experiment: Experiment, label: str, options: GraphOptions, progress: Progress
) -> RunReport:
    """Run the closed loop once and see that nothing went otherwise than planned."""
    with tempfile.TemporaryDirectory(prefix="hpid_bench_") as name:
        folder = Path(name)
        bag = folder / "bag" if options.is_recorded else None
        report = run_on_graph(experiment, label, bag, folder, progress, options)
        if report.warnings:
            raise RunError("; ".join(report.warnings))
        if bag is not None:
            _require_everything(bag, report.states, len(experiment.world.joints))
    return report


def timing_of(report: RunReport) -> Collection[Mapping[str, Any]]:
    """Return what the nodes measured of each joint."""
    if report.timing is None or not report.timing["joints"]:
        raise RunError("the nodes told nothing about their timing")
    joints: Collection[Mapping[str, Any]] = report.timing["joints"].values()
    return joints


def _require_everything(bag: Path, states: int, joints: int) -> None:
    """Make sure that a bag holds every state and the answer of every joint."""
    with Reader(bag) as reader:
        counts = {name: summary.msgcount for name, summary in reader.topics.items()}
    expected = {"/joint_states": states, "/joint_commands": states * joints}
    lost = {topic: count - counts.get(topic, 0) for topic, count in expected.items()}
    if any(count > 0 for count in lost.values()):
        raise RunError(f"messages not recorded: {lost}")

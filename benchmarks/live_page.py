"""What watching costs: ``python -m benchmarks.live_page [--phases N] [--seconds S]``.

Runs the paper's robot in MuJoCo at 1 kHz by the wall clock with its eight controllers, each a
process, and by turns nobody looks at them, or a process of its own takes their samples 30 times a
second as the live page does. Says how much processor that process takes, and how many states
controllers miss with it and without.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.in_process import write_run_files
from hpid_bench.experiment.processes import NodeGroup, closed_environment, own_domain
from hpid_bench.live.graph_client import GraphClient
from hpid_ros.base.names import controller_name
from hpid_ros.base.resources import share_folder
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.process import end

_RATE = 30.0  # [Hz]
_FOREVER = 1e5  # [s]
_SETTLES = 2.5  # [s]; controllers report once a second


def watch(seconds: float) -> None:
    """Watch all controllers for some seconds and print what that cost, as JSON."""
    rclpy.init(args=[])
    node = ClosingNode("watcher")
    graph = GraphClient(node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    while len(graph.controllers()) < 8 or not all(
        each.lifecycle == "active" for each in graph.controllers().values()
    ):
        time.sleep(0.1)
    graph.watch(list(graph.controllers()))
    time.sleep(1.0)
    graph.take()
    counts = dict.fromkeys(graph.controllers(), (0, 0))
    took = 0.0
    begun, computed = time.monotonic(), time.process_time()
    frames = round(seconds * _RATE)
    for frame in range(frames):
        time.sleep(max(0.0, begun + frame / _RATE - time.monotonic()))
        at = time.thread_time()
        taken = graph.take()
        took += time.thread_time() - at
        for name, samples in taken.items():
            states, efforts = counts[name]
            counts[name] = states + len(samples.states), efforts + len(samples.efforts)
    spent = time.monotonic() - begun
    share = (time.process_time() - computed) / spent
    totals = [sum(each) / spent for each in zip(*counts.values(), strict=True)]
    print(json.dumps({"share": share, "take_ms": 1e3 * took / frames, "rates": totals}))
    end(0)


class _Counts(Node):  # type: ignore[misc]  # rclpy has no types
    """Takes what controllers say of their samples."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("counter", context=context)
        self.counts: dict[str, tuple[int, int]] = {}
        self.create_subscription(DiagnosticArray, "/diagnostics", self._take, 50)

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            figures = {each.key: each.value for each in status.values}
            if "missed samples" in figures:
                samples, missed = int(figures["samples"]), int(figures["missed samples"])
                self.counts[status.name] = samples, missed

    def total(self) -> tuple[int, int]:
        """Return samples and missed ones of all controllers."""
        samples, missed = zip(*self.counts.values(), strict=True)
        return sum(samples), sum(missed)


def measure(phases: int, seconds: float) -> None:
    """Run the robot, and print a line for each phase."""
    paper = str(share_folder() / "config" / "experiments" / "paper.yaml")
    experiment = replace(load_experiment(paper, "mujoco"), duration=_FOREVER)
    settings = list(experiment.controllers.values())[-1]
    with own_domain() as domain, tempfile.TemporaryDirectory() as folder:
        environment = closed_environment(domain)
        os.environ.update(environment)  # before the middleware is loaded
        controllers, bridge = write_run_files(Path(folder), experiment, settings)
        with NodeGroup(environment, Path(folder)) as group:
            for each in settings:
                group.start(
                    controller_name(each.joint),
                    "joint_controller",
                    ["--params-file", str(controllers)],
                )
            arguments = ["mode:=realtime", f"wait_for_subscribers:={len(settings)}"]
            flags = [text for each in arguments for text in ("-p", each)]
            group.start("mujoco_bridge", "mujoco_bridge", ["--params-file", str(bridge), *flags])
            _phases(domain, environment, phases, seconds, len(settings))


def _phases(
    domain: int, environment: dict[str, str], phases: int, seconds: float, joints: int
) -> None:
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    counter = _Counts(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(counter)

    def wait(until: float) -> None:
        while time.monotonic() < until:
            executor.spin_once(timeout_sec=0.1)

    while len(counter.counts) < joints or counter.total()[0] < 1000:
        executor.spin_once(timeout_sec=0.1)
    for _ in range(phases):
        for is_watched in (False, True):
            watcher = None
            if is_watched:
                watcher = subprocess.Popen(
                    [sys.executable, "-m", "benchmarks.live_page", "--watch", str(seconds + 15.0)],
                    env=environment,
                    stdout=subprocess.PIPE,
                    text=True,
                )
                wait(time.monotonic() + 8.0)
            wait(time.monotonic() + _SETTLES)
            samples, missed = counter.total()
            wait(time.monotonic() + seconds)
            after, missed_after = counter.total()
            line = f"{'watched' if is_watched else 'alone':8} samples {after - samples:7d}  "
            line += f"missed {missed_after - missed:6d}"
            if watcher is not None:
                told = json.loads(watcher.communicate()[0])
                line += f"  processor {told['share']:.3f}  take {told['take_ms']:.2f} ms  "
                states, efforts = told["rates"]
                line += f"states and efforts taken {states:.0f} and {efforts:.0f} a second"
            print(line, flush=True)
    rclpy.shutdown(context=context)


def main(args: Sequence[str] | None = None) -> int:
    """Run the measurement."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live_page")
    parser.add_argument("--phases", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--watch", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args(args)
    if options.watch:
        watch(options.watch)
    else:
        measure(options.phases, options.seconds)
    return 0


if __name__ == "__main__":
    sys.exit(main())

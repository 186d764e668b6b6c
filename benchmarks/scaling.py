"""The cost of a control cycle over the number of joints and of processes.

    python -m benchmarks.scaling [--joints 2 8 16 32] [--rounds 3]

Pendulums on a fixed beam, one physics step in each period of 1 ms, in lock-step, not recorded:
on the graph with a process for every node, with the controllers composed in one process, with
everything in one process, and in the in-process engine without ROS. All forms are measured in
turn. Writes every measurement to ``benchmarks/results/MACHINE_scaling.csv``, the medians with
versions to the JSON file beside it, and draws ``docs/figures/scaling.png``.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from benchmarks import results
from benchmarks.figures import Measure, Middle, middle
from benchmarks.measuring import Tell, measure_in_turn, time_per_item
from benchmarks.ours_graph import run_ours
from benchmarks.pendulums import LABEL, pendulum_experiment
from benchmarks.processes import ROOT
from benchmarks.scaling_plot import draw
from hpid_ros.base.processes import heed_interrupts
from hpid_ros.experiment.description import Experiment, following_loops
from hpid_ros.experiment.graph_run import GraphOptions
from hpid_ros.simulation.engine import Sample, run_in_process
from hpid_ros.simulation.world import World

JOINTS = (2, 8, 16, 32)
ROUNDS = 3
SECONDS: Mapping[str, float] = {"each": 2.0, "composed": 3.0, "single": 4.0, "in_process": 3.0}
"""The forms, and the simulated time of one run of each in [s]."""

_FAILED, _INTERRUPTED = 1, 130

Rates = dict[tuple[str, int], list[float]]
"""Cycles per second of each round, by form and number of joints."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write, draw.

    Args:
        arguments: Those of the command line; None for the process's own.

    Returns:
        The exit code: 0 measured, 1 something could not be measured, 130 interrupted.
    """
    options = _parser().parse_args(arguments)
    errors = Console(stderr=True)
    heed_interrupts()
    try:
        rates, failures = measure(options.joints, options.rounds, errors.print)
    except KeyboardInterrupt:
        return _INTERRUPTED
    for line in failures:
        errors.print(line, style="red", highlight=False, soft_wrap=True)
    if rates:
        medians = {key: middle(values) for key, values in rates.items()}
        _print(medians)
        _write(options.output / f"{results.slug()}_scaling", rates, medians)
        options.figure.parent.mkdir(parents=True, exist_ok=True)
        draw(medians, results.machine(), options.figure)
    return _FAILED if failures else 0


def measure(joints: Sequence[int], rounds: int, tell: Tell) -> tuple[Rates, list[str]]:
    """Measure every form with every number of joints.

    Args:
        joints: Numbers of joints.
        rounds: How often each is measured.
        tell: Is told what is being measured.

    Returns:
        The rates, and a line for each combination that could not be measured.
    """
    rates: Rates = {}
    failures: list[str] = []
    for count in joints:
        with tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder:
            contenders: dict[str, Measure] = {}
            for form, seconds in SECONDS.items():
                place = Path(folder) / form
                place.mkdir()
                experiment = pendulum_experiment(place, count, seconds)
                contenders[f"{form}, {count} joints"] = partial(_measure_of(form), experiment)
            measured = measure_in_turn(contenders, rounds, tell)
        for form in SECONDS:
            name = f"{form}, {count} joints"
            if name in measured.failures:
                failures.append(measured.failures[name])
            else:
                rates[form, count] = [each["rate"] for each in measured[name]]
    return rates, failures


def _measure_of(form: str) -> Callable[[Experiment], Mapping[str, float]]:
    if form == "in_process":
        return _in_process
    options = GraphOptions(processes=form, is_recorded=False)
    return lambda experiment: run_ours(experiment, LABEL, options)


def _in_process(experiment: Experiment) -> Mapping[str, float]:
    loops = following_loops(experiment.controllers[LABEL], experiment.trajectory)
    with World(experiment.world) as world:
        periods = experiment.periods
        seconds = time_per_item(lambda: run_in_process(world, loops, periods, _ignore), periods)
    return {"rate": 1.0 / seconds}


def _ignore(sample: Sample) -> None:
    """Take a sample and keep nothing of it."""


def _print(medians: Mapping[tuple[str, int], Middle]) -> None:
    print(f"{'form':12} {'joints':>6} {'cycles/s':>9} {'+-':>5} {'us/cycle':>9}")
    for (form, count), rate in medians.items():
        print(f"{form:12} {count:6} {rate.median:9.0f} {100.0 * rate.spread:4.0f}% "
              f"{1e6 / rate.median:9.0f}")  # fmt: skip


def _write(base: Path, rates: Rates, medians: Mapping[tuple[str, int], Middle]) -> None:
    """Write the CSV file of all measurements and the JSON file of the medians."""
    base.parent.mkdir(parents=True, exist_ok=True)
    with base.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["form", "joints", "round", "cycles_per_second"])
        for (form, count), values in rates.items():
            writer.writerows([form, count, k + 1, f"{v:.1f}"] for k, v in enumerate(values))
    document = {
        "machine": results.machine(),
        "versions": results.all_versions(),
        "unit": "cycles/s",
        "medians": [
            {"form": form, "joints": count, "rate": round(rate.median, 1),
             "spread": [round(rate.low, 1), round(rate.high, 1)]}
            for (form, count), rate in medians.items()
        ],
    }  # fmt: skip
    text = json.dumps(document, indent=2) + "\n"
    base.with_suffix(".json").write_text(text, encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--joints", type=int, nargs="+", default=JOINTS, metavar="N")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results")
    parser.add_argument(
        "--figure", type=Path, default=ROOT / "docs" / "figures" / "scaling.png", metavar="FILE"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())

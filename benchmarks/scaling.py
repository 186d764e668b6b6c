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
from typing import Any
from xml.etree import ElementTree

import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from rich.console import Console

from benchmarks import results
from benchmarks.figures import Measure, Middle, middle
from benchmarks.measuring import Tell, measure_in_turn, time_per_item
from benchmarks.ours_graph import run_ours
from benchmarks.processes import ROOT
from hpid_bench.experiment.description import Experiment, following_loops, load_experiment
from hpid_bench.experiment.graph_run import GraphOptions
from hpid_bench.report.figures import RUN_STYLES
from hpid_bench.report.plots import DOTS_PER_INCH, MARKERS, figure_style
from hpid_ros.base.processes import heed_interrupts
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
    """Measure, write, draw."""
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


LABEL = "hPID"

_MASS = 0.5  # [kg]
_LENGTH = 0.3  # [m], a rod that hangs from its end
_WIDTH = 0.02  # [m]
_GAP = 0.1  # [m] between neighbours
_EFFORT = 20.0  # [N m]
_INERTIA = _MASS * _LENGTH**2 / 3.0  # [kg m^2] about the joint
_POLE = 10.0  # [rad/s]; three of them, as in tracking.yaml


def pendulum_experiment(folder: Path, joints: int, duration: float) -> Experiment:
    """Write robot and experiment into a folder, and load the experiment.

    Every joint swings up by 0.4 rad and back, under the homogeneous PID. There is one physics
    step in each control period of 1 ms.
    """
    names = [f"joint_{k + 1}" for k in range(joints)]
    (folder / "pendulums.urdf").write_text(_urdf(names), encoding="utf-8")
    file = folder / "pendulums.yaml"
    file.write_text(yaml.safe_dump(_document(names, duration), sort_keys=False), encoding="utf-8")
    return load_experiment(file)


def _urdf(names: list[str]) -> str:
    robot = ElementTree.Element("robot", name="pendulums")
    _add_link(robot, "beam", 1.0)
    for k, name in enumerate(names):
        joint = ElementTree.SubElement(robot, "joint", name=name, type="revolute")
        ElementTree.SubElement(joint, "parent", link="beam")
        ElementTree.SubElement(joint, "child", link=f"rod_{k + 1}")
        ElementTree.SubElement(joint, "origin", xyz=f"0 {_GAP * k:g} 0")
        ElementTree.SubElement(joint, "axis", xyz="0 1 0")
        ElementTree.SubElement(
            joint, "limit", lower="-3", upper="3", effort=str(_EFFORT), velocity="20"
        )
        _add_link(robot, f"rod_{k + 1}", _MASS)
    return ElementTree.tostring(robot, encoding="unicode")


def _add_link(robot: ElementTree.Element, name: str, mass: float) -> None:
    """Add a rod that hangs down from its frame."""
    link = ElementTree.SubElement(robot, "link", name=name)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=f"0 0 {-0.5 * _LENGTH:g}")
    ElementTree.SubElement(inertial, "mass", value=str(mass))
    across, along = mass * (_LENGTH**2 + _WIDTH**2) / 12.0, mass * _WIDTH**2 / 6.0
    moments = {"ixx": across, "iyy": across, "izz": along, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
    ElementTree.SubElement(
        inertial, "inertia", {key: str(value) for key, value in moments.items()}
    )


def _document(names: list[str], duration: float) -> dict[str, object]:
    gains = {
        "p": 3.0 * _POLE**2 * _INERTIA,
        "i": _POLE**3 * _INERTIA,
        "d": 3.0 * _POLE * _INERTIA,
    }
    norm = {"type": "weighted", "error_scale": 0.4, "rate_weight": 0.2}
    return {
        "name": f"{len(names)} pendulums",
        "duration": duration,
        "seed": 1,
        "robot": {"description": "pendulums.urdf", "fixed_base": True},
        "control": {"rate": 1000, "answer_timeout": 60.0},
        "simulation": {"physics_steps": 1},
        "sensors": {"encoder_counts": 16384},
        "reference": {
            "kind": "minimum_jerk",
            "times": [0.0, 0.5 * duration, duration],
            "positions": {name: [0.0, 0.4, 0.0] for name in names},
        },
        "controllers": {
            "common": {
                **{"velocity_source": "filtered", "norm": norm},
                **{"gains": gains, "inertia": _INERTIA},
            }
        },
        "compare": {LABEL: {"law": "hpid", "mu": -0.1}},
    }


NAMES = {
    "each": "a process for each controller",
    "composed": "controllers composed in one process",
    "single": "everything in one process",
    "in_process": "in-process engine, without ROS",
}
_SIZE_IN = (9.0, 4.0)
_MILLISECONDS = 1e3  # in a second


def draw(
    medians: Mapping[tuple[str, int], Middle], machine: Mapping[str, Any], file: Path
) -> None:
    """Draw rate and time of a cycle over the number of joints."""
    with figure_style():
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        rates, times = figure.subplots(1, 2)
        counts = sorted({count for _, count in medians})
        for k, (form, name) in enumerate(NAMES.items()):
            points = [(n, medians[form, n]) for n in counts if (form, n) in medians]
            _line(rates, k, name, points, lambda rate: rate)
            _line(times, k, name, points, lambda rate: _MILLISECONDS / rate)
        rates.set(xscale="log", yscale="log", ylabel="control cycles per second [1/s]")
        rates.margins(x=0.06)
        times.set(ylabel="time of a cycle [ms]", ylim=(0.0, None), xlim=(0.0, 1.05 * counts[-1]))
        for axes in (rates, times):
            axes.set_xlabel("joints")
            axes.set_xticks(counts)
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        rates.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
        figure.legend(
            *rates.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False
        )
        cores = machine["cores"]
        figure.suptitle(f"Lock-step with physics, {machine['cpu']}, {cores} cores", fontsize=9)
        figure.savefig(file, dpi=DOTS_PER_INCH)


def _line(axes: Axes, k: int, name: str, points: Any, of: Any) -> None:
    """Draw one form: medians as a line, the range of the rounds as bars."""
    style = RUN_STYLES[k]
    x = [count for count, _ in points]
    y = [of(rate.median) for _, rate in points]
    ends = [sorted((of(rate.low), of(rate.high))) for _, rate in points]
    below = [value - low for value, (low, _) in zip(y, ends, strict=True)]
    above = [high - value for value, (_, high) in zip(y, ends, strict=True)]
    axes.errorbar(
        x,
        y,
        yerr=(below, above),
        label=name,
        color=style.color,
        marker=MARKERS[k],
        markersize=5,
        linewidth=style.width,
        linestyle="-" if style.dashes is None else (0, style.dashes),
        elinewidth=0.8,
        capsize=2,
    )


if __name__ == "__main__":
    sys.exit(main())

"""What a person waits for: whole commands, beside the simulation in them."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from hpid_bench.cli.options import DEFAULT_EXPERIMENT
from hpid_bench.experiment.description import Experiment, load_experiment
from hpid_bench.experiment.in_process import NoProgress, run_without_ros
from hpid_ros.base.errors import RunError
from hpid_ros.base.resources import find_resource
from hpid_ros.simulation.settings import installed_engines

_HPID = (sys.executable, "-m", "hpid_bench.cli.main")
_ROUNDS = 3
_GRAPH_MOST = {"mujoco": 1.2, "pybullet": 1.6}


def group(quick: bool) -> Group:
    """Return the figures of whole commands."""
    contenders: dict[str, Measure] = {
        "hpid compare": _compare_here,
        "its simulation": _simulation,
        "hpid metrics": _metrics,
        "numpy": lambda: {"wall": _wall([sys.executable, "-c", "import numpy"])},
    }
    figures = [
        Figure("answers.compare", "s of processor time", Source("hpid compare", "cpu"),
               Source("its simulation", "cpu"), "its two simulations (in process, MuJoCo)",
               (Bound("ratio", most=1.8),)),
        Figure("answers.metrics", "s", Source("hpid metrics", "wall"), Source("numpy", "wall"),
               "an interpreter that imports numpy", (Bound("ours", most=0.5),)),
    ]  # fmt: skip
    for engine in () if quick else installed_engines():
        ours = f"hpid compare on the graph, {engine}"
        contenders[ours] = partial(_compare_on_graph, engine)
        contenders["simulated time"] = lambda: {"wall": _simulated()}
        figures.append(
            Figure(f"answers.graph.{engine}", "s", Source(ours, "wall"),
                   Source("simulated time", "wall"), "the simulated time of its two runs",
                   (Bound("ratio", most=_GRAPH_MOST[engine]),), ("starting",))
        )  # fmt: skip
    return Group(contenders, tuple(figures), _ROUNDS)


@cache
def _experiment() -> Experiment:
    experiment = load_experiment(find_resource(DEFAULT_EXPERIMENT))
    return replace(experiment, world=replace(experiment.world, engine="mujoco"))


def _simulated() -> float:
    return _experiment().duration * len(_experiment().controllers)


def _wall(command: list[str]) -> float:
    begun = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RunError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr.strip()}")
    return time.perf_counter() - begun


def _compare_here() -> Mapping[str, float]:
    with tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder:
        command = [*_HPID, "compare", "--in-process", "--engine", "mujoco", "-o", f"{folder}/it"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        _wall(command)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"cpu": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}


def _simulation() -> Mapping[str, float]:
    """Run what :func:`_compare_here` simulates, here."""
    experiment, begun = _experiment(), time.process_time()
    with tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder:
        for label in experiment.controllers:
            run_without_ros(experiment, label, Path(folder) / label, NoProgress())
    return {"cpu": time.process_time() - begun}


def _compare_on_graph(engine: str) -> Mapping[str, float]:
    """Time the whole command, and how long its runs took to start."""
    with tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder:
        wall = _wall([*_HPID, "compare", "--engine", engine, "-o", f"{folder}/it"])
        runs = json.loads(Path(folder, "it", "timing.json").read_text())["runs"].values()
    return {"wall": wall, "starting": max(run["spent"]["starting"] for run in runs)}


@cache
def _bags() -> tempfile.TemporaryDirectory[str]:
    """Record two bags once; they go with the process."""
    folder = tempfile.TemporaryDirectory(prefix="hpid_bench_")
    for label in _experiment().controllers:
        run_without_ros(_experiment(), label, Path(folder.name) / label, NoProgress())
    return folder


def _metrics() -> Mapping[str, float]:
    bags = [str(Path(_bags().name) / label) for label in _experiment().controllers]
    return {"wall": _wall([*_HPID, "metrics", *bags])}

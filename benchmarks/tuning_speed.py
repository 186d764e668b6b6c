"""The time of the commands that certify: ``python -m benchmarks.tuning_speed [--against TREE]``.

``hpid gains``, ``check-gains --urdf`` and ``upgrade --urdf`` on the six joints of a shipped arm,
as processes. With another source tree both take turns, and the ratios of wall-clock and processor
time are printed: they survive a busy machine, the times do not.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import yaml

from benchmarks.processes import ROOT
from hpid_ros.experiment.description import load_experiment

EXPERIMENTS = ROOT / "config" / "experiments"


class Cost(NamedTuple):
    """What one command took.

    Attributes:
        wall: In [s].
        processor: Of all its processes, in [s].
    """

    wall: float
    processor: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print a line for each command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="another source tree of this package")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    trees = [ROOT] if options.against is None else [ROOT, options.against.resolve()]
    with tempfile.TemporaryDirectory() as folder:
        for name, command in _commands(Path(folder)).items():
            costs: list[list[Cost]] = [[] for _ in trees]
            for _ in range(options.rounds):
                for tree, own in zip(trees, costs, strict=True):
                    own.append(_cost(command, tree))
            print(name, *(_text(own) for own in costs), _ratios(costs), sep="  ", flush=True)
    return 0


def _commands(folder: Path) -> dict[str, list[str]]:
    """Return the commands' arguments by name; what they read is written to the folder."""
    pid, hpid = folder / "pid.yaml", folder / "hpid.yaml"
    _write_document(EXPERIMENTS / "paper.yaml", 0, pid)
    _write_document(EXPERIMENTS / "tracking.yaml", 1, hpid)
    paper, tracking = (str(EXPERIMENTS / f"{name}.yaml") for name in ("paper", "tracking"))
    rule = ["--rule", "pole-placement", "--closed-loop-time", "0.1"]
    proposal = ["--goal", "smooth", "--force", "-o", str(folder / "new.yaml")]
    return {
        "gains": ["gains", tracking, *rule],
        "check-gains --urdf": ["check-gains", str(hpid), "--urdf", tracking],
        "upgrade --urdf": ["upgrade", str(pid), "--urdf", paper, *proposal],
    }


def _write_document(experiment: Path, place: int, file: Path) -> None:
    """Write the arm's loops of an experiment's controller, inertias unknown."""
    loops = list(load_experiment(experiment).controllers.values())[place]
    nodes = {}
    for loop in loops:
        if loop.joint.startswith("arm"):
            parameters = {k: v for k, v in loop.to_parameters().items() if k != "inertia"}
            nodes[f"{loop.joint}_controller"] = {"ros__parameters": parameters}
    file.write_text(yaml.safe_dump(nodes), encoding="utf-8")


def _cost(command: Sequence[str], tree: Path) -> Cost:
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "hpid_ros.cli.main", *command],
        cwd=tree,
        env=environment,
        capture_output=True,
        check=True,
    )
    wall, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(wall, used)


def _text(costs: Sequence[Cost]) -> str:
    wall, processor = (median(column) for column in zip(*costs, strict=True))
    return f"{wall:.1f} s ({processor:.1f} s of processor time)"


def _ratios(costs: Sequence[Sequence[Cost]]) -> str:
    if len(costs) == 1:
        return ""
    pairs = list(zip(*costs, strict=True))
    wall, processor = (
        median(other[k] / own[k] for own, other in pairs) for k in range(len(Cost._fields))
    )
    return f"ratio {wall:.2f} (processor time {processor:.2f})"


if __name__ == "__main__":
    sys.exit(main())

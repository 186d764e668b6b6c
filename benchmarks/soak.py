"""Hours at full rate: ``python -m benchmarks.soak [--minutes M] [--warm-up M] [--seed N]``.

Runs the robot and eight controllers in lock-step for M minutes of wall time while parameters are
set and controllers are killed, ended and frozen. Says of every process how its memory grew after
the warm-up, which samples were missed outside of the faults, and what was left behind; a line a
minute on standard error tells how it stands. Exit codes: 0 all kept, 1 something was not, 2
unusable arguments, 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.disturbed_graph import DisturbedGraph, Fault
from benchmarks.episodes import LABEL, is_planned, sines
from benchmarks.processes import FAILED, Scripts, exit_code
from benchmarks.surroundings import loopback_environment
from hpid_bench.experiment.processes import NodeGroup, own_domain
from hpid_ros.base.errors import SettingError
from hpid_ros.base.processes import raise_if_interrupted

GROWTH_AT_MOST = 1.0  # [MiB] of any process after the warm-up
RETUNES = 5.0  # sets of parameters in a second
_FAULTS_APART = 20.0  # [s] of wall time
_LOOK_AT_MEMORY = 1.0  # [s]
_WARM_UP = 5.0  # [min], or a quarter of a run that is short
_WARM_UP_OF_ONE = 30.0  # [s] after its own start, for a controller that was restarted
_FOREVER = 1e5  # [s] of simulated time
_TELL = 60.0  # [s]
_MIB = 1024.0 * 1024.0


@dataclass
class Soak:
    """What came of it."""

    states: int = 0  # states of the run
    faults: Sequence[Fault] = ()  # what was done to controllers
    # sets of parameters by what became of them
    retunes: Mapping[str, int] = field(default_factory=dict)
    # ``(joint, stamp)`` of samples that were missed outside of the faults
    unplanned: Sequence[tuple[str, int]] = ()
    # growth of each process's memory after its warm-up, in [MiB], by name and pid
    growth: Mapping[tuple[str, int], float] = field(default_factory=dict)
    left: Sequence[str] = ()  # a line for each process or thread that was left behind

    def broken(self) -> list[str]:
        """Return a line for each promise that was not kept."""
        lines = [
            f"{name} ({pid}) grew by {growth:.2f} MiB"
            for (name, pid), growth in self.growth.items()
            if growth > GROWTH_AT_MOST
        ]
        lines += [f"{joint} missed the state at {ns * 1e-9:.3f} s" for joint, ns in self.unplanned]
        if wrong := self.retunes.get("wrong", 0):
            lines.append(f"{wrong} sets of parameters were answered wrongly")
        return [*lines, *self.left]


class _Memory:
    """Watches how the memory of processes grows after their warm-up."""

    def __init__(self, warm_up: float) -> None:
        self._warm_until = time.monotonic() + warm_up
        self._first_seen: dict[tuple[str, int], float] = {}
        self._base: dict[tuple[str, int], int] = {}
        self._last: dict[tuple[str, int], int] = {}
        self._next = 0.0

    def look(self, pids: Mapping[str, int]) -> None:
        """Note what every process has, once a second."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + _LOOK_AT_MEMORY
        for each in pids.items():
            seen = self._first_seen.setdefault(each, now)
            if now < max(self._warm_until, seen + _WARM_UP_OF_ONE):
                continue
            size = private_bytes(each[1])
            self._base.setdefault(each, size)
            self._last[each] = size

    def growth(self) -> dict[tuple[str, int], float]:
        """Return the growth of each process that was seen after its warm-up, in [MiB]."""
        return {each: (size - self._base[each]) / _MIB for each, size in self._last.items()}


def soak(minutes: float, warm_up: float, seed: int, folder: Path) -> Soak:
    """Run the graph under faults."""
    result = Soak()
    with _leftovers() as left, own_domain() as domain:
        environment = loopback_environment(domain)
        experiment = sines(folder, 60.0 * minutes, _FOREVER)
        with (
            NodeGroup(environment, folder, is_batch=True) as group,
            Scripts(environment, folder) as scripts,
        ):
            chance = random.Random(seed)
            graph = DisturbedGraph(experiment, LABEL, group, folder, None, chance)
            graph.start()
            arguments = [str(RETUNES), str(seed), *graph.joints]
            scripts.start("retuner", "retuner", arguments)
            memory = _Memory(60.0 * warm_up)
            _run(graph, memory, 60.0 * minutes)
            scripts.processes["retuner"].terminate()
            result.retunes = scripts.result("retuner", 20.0)
            group.stop(patience=10.0)
            graph.take_last_events()
        result.faults, result.growth = graph.faults, memory.growth()
        result.states = graph.events[graph.nodes.bridge, "stopped"]["states"]
        result.unplanned = [miss for miss in graph.misses if not is_planned(miss, graph.faults)]
    result.left = left
    return result


@contextmanager
def _leftovers() -> Iterator[list[str]]:
    """Yield a list that afterwards has a line for each process and thread that was left behind."""
    before, found = _present(), list[str]()
    yield found
    found += [f"left behind: {each}" for each in sorted(_present() - before)]


def _present() -> set[str]:
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    threads = {f"thread {thread.name}" for thread in threading.enumerate()}
    return threads | {f"process {pid}" for pid in children}


def warm_up_of(minutes: float) -> float:
    """Return the warm-up of a run that names none, in [min]."""
    return min(_WARM_UP, minutes / 4.0)


def _run(graph: DisturbedGraph, memory: _Memory, seconds: float) -> None:
    begin = time.monotonic()
    next_fault = begin + min(_FAULTS_APART, seconds / 4.0)
    next_line = begin + _TELL
    while (now := time.monotonic()) < begin + seconds:
        graph.look()
        memory.look(graph.pids())
        if now >= next_line:
            next_line += _TELL
            print(
                f"{(now - begin) / 60.0:.0f} min: {graph.stamp_ns * 1e-9:.0f} s simulated, "
                f"{len(graph.faults)} faults, largest growth {_largest(memory.growth())}",
                file=sys.stderr,
                flush=True,
            )
        if now >= next_fault and graph.disturb_when_due():
            next_fault = time.monotonic() + min(_FAULTS_APART, seconds / 4.0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as long as the arguments say and print what came of it."""
    options = _parser().parse_args(arguments)
    warm_up = warm_up_of(options.minutes) if options.warm_up is None else options.warm_up

    def run() -> int:
        if not options.minutes > 0.0 or not 0.0 <= warm_up < options.minutes:
            raise SettingError("--minutes must be positive and --warm-up shorter")
        with tempfile.TemporaryDirectory(prefix="hpid_soak_") as name:
            result = soak(options.minutes, warm_up, options.seed, Path(name))
            raise_if_interrupted()
        _print(result)
        return FAILED if result.broken() else 0

    return exit_code("soak", run)


def _print(result: Soak) -> None:
    rows: list[tuple[str, Any]] = [
        ("states", result.states),
        ("faults injected", len(result.faults)),
        *((f"sets of parameters {name}", count) for name, count in result.retunes.items()),
        ("samples missed outside of the faults", len(result.unplanned)),
        ("processes watched", len(result.growth)),
        ("largest growth of memory", _largest(result.growth)),
        ("left behind", len(result.left)),
    ]
    for name, value in rows:
        print(f"{name:<40}{value}")
    for line in result.broken():
        print(f"not kept: {line}")


def _largest(growth: Mapping[tuple[str, int], float]) -> str:
    if not growth:
        return "not seen yet"
    (name, _), size = max(growth.items(), key=lambda each: each[1])
    return f"{size:.3f} MiB ({name})"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--minutes", type=float, default=60.0, help="of wall time; 60 if not given"
    )
    parser.add_argument(
        "--warm-up",
        type=float,
        help=f"minutes before memory is compared; {_WARM_UP:g} or a quarter of the run",
    )
    parser.add_argument("--seed", type=int, default=1, help="of faults and retunes")
    return parser


_OWN = ("Private_Dirty:", "Swap:")


def private_bytes(pid: int) -> int:
    """Return the memory that a process has written and shares with no other, in bytes.

    It counts also when it is swapped out. Shared memory of the middleware belongs to all who map
    it; clean pages are those of files, which come and go with other programs that map them.
    """
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except FileNotFoundError:
        raise ProcessLookupError(f"no process {pid}") from None
    return sum(int(line.split()[1]) for line in lines if line.startswith(_OWN)) * 1024


if __name__ == "__main__":
    sys.exit(main())

"""What a Dask cluster costs beside this machine's own processes.

    pip install 'hpid_ros[cluster]' && python -m benchmarks.cluster [--seeds 8] [--rounds 3]

Scheduler and workers are processes of their own that talk TCP on this machine. Printed are the
time that a run costs more than in a process of our own, how much of two processes two workers are
worth, what a task weighs, and how many runs of one period, and tasks that do nothing, pass
through the scheduler in a second: from these follows how many workers it can keep busy.
"""

from __future__ import annotations

import argparse
import pickle
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

from hpid_bench.experiment.batch import Runner, RunTask, run_batch
from hpid_bench.experiment.cluster import Cluster, pack
from hpid_bench.experiment.description import load_experiment
from hpid_ros.base.resources import find_resource


@contextmanager
def dask_processes(workers: int) -> Iterator[str]:
    """Start a scheduler with workers of one thread each, and give its address."""
    with tempfile.TemporaryDirectory() as folder:
        started: list[subprocess.Popen[bytes]] = []

        def start(kind: str, said: str, *options: str) -> str:
            log = Path(folder) / f"{len(started)}.log"
            command = [sys.executable, "-m", "dask", kind, *options, "--no-dashboard"]
            with log.open("wb") as stream:
                started.append(subprocess.Popen(command, stdout=stream, stderr=stream))
            while not (found := re.search(rf"{said}: *(tcp://\S+)", log.read_text())):
                if started[-1].poll() is not None:
                    raise SystemExit(log.read_text())
                time.sleep(0.05)
            return found[1]

        try:
            address = start("scheduler", "Scheduler at", "--host", "127.0.0.1", "--port", "0")
            for _ in range(workers):
                start("worker", "Registered to", address, "--nthreads", "1", "--no-nanny")
            yield address
        finally:
            for process in started:
                process.kill()
                process.wait()


def seconds(run: Runner, tasks: Sequence[RunTask]) -> float:
    """Return how long tasks take, after one that lets everything be loaded."""
    list(run(dict(enumerate(tasks[:2]))))
    begin = time.perf_counter()
    assert all(record.numbers for _, record in run(dict(enumerate(tasks))))
    return time.perf_counter() - begin


def weigh(task: RunTask) -> int:
    """Do nothing with a task."""
    return task.periods


def tasks_a_second(address: str, task: RunTask, count: int = 1000) -> float:
    """Return how many tasks that do nothing a scheduler hands out in a second."""
    from distributed import Client

    with Client(address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
        begin = time.perf_counter()
        client.gather([client.submit(weigh, task, pure=False) for _ in range(count)])
        return count / (time.perf_counter() - begin)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    for name in ("paper", "iiwa"):
        path = find_resource(f"config/experiments/{name}.yaml")
        experiment = load_experiment(path, "mujoco")
        (task,), parcel = pack([RunTask.of(experiment, "hPID")])
        size = sum(map(len, parcel.values()))
        print(f"{name}: a task {len(pickle.dumps(task))} bytes, once {size} bytes of files")
    experiment = load_experiment(find_resource("config/experiments/paper.yaml"), "mujoco")
    task = RunTask.of(experiment, "hPID")
    tasks = [
        replace(task, world=replace(task.world, seed=seed), periods=task.periods // 3)
        for seed in range(options.seeds)
    ]
    empty = [replace(each, periods=1) for each in tasks] * 25
    for count in (1, 2):
        ratios = []
        with dask_processes(count) as address, Cluster(address) as cluster:
            for _ in range(options.rounds):
                far, near = seconds(cluster, tasks), seconds(partial(run_batch, jobs=count), tasks)
                ratios.append(near / far)
                extra = (far - near) * count / len(tasks)
                print(
                    f"{count} worker(s) {far:.2f} s, {count} process(es) {near:.2f} s: "
                    f"{1e3 * extra:.0f} ms more a run, efficiency {near / far:.2f}"
                )
            through = len(empty) / seconds(cluster, empty)
            taken = tasks_a_second(address, tasks[0])
        print(f"{count} worker(s): efficiency {statistics.median(ratios):.2f} (median)")
        print(f"{count} worker(s): {through:.0f} runs of one period a second")
        print(f"{count} worker(s): {taken:.0f} tasks a second that do nothing")


if __name__ == "__main__":
    main()

"""Studies on a Dask cluster and in shards: the numbers of one machine, whatever is lost."""

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from harness.engines import shipped

from hpid_ros.base.errors import RunError
from hpid_ros.base.files import share_folder
from hpid_ros.cli.commands import BAD_INPUT, DONE, FAILED
from hpid_ros.cli.main import main
from hpid_ros.experiment import cluster as client
from hpid_ros.experiment.batch import RunTask, WorldKeeper, run_batch, simulate
from hpid_ros.experiment.cluster import Cluster, differences, pack, traits, unpack, work
from hpid_ros.experiment.description import load_experiment

STEP = share_folder() / "config" / "experiments" / "step.yaml"
WRITTEN = ("runs.csv", "runs.jsonl", "study.json", "tables.txt")


class Processes:
    """A scheduler of Dask and its workers, each a process of its own that talks TCP."""

    def __init__(self, folder):
        self._folder, self._started = folder, []
        self.address = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")

    def worker(self, folder=None):
        """Start a worker of one thread; ``folder`` comes first where it looks for modules."""
        options = ("--nthreads", "1", "--no-nanny")
        self._start("worker", self.address, *options, folder=folder)
        return self._started[-1]

    def _start(self, kind, *options, folder=None):
        """Start a process, and return where it listens."""
        log = self._folder / f"{kind}_{len(self._started)}.log"
        environment = dict(os.environ, PYTHONPATH=f"{folder or ''}:{os.environ['PYTHONPATH']}")
        with log.open("wb") as stream:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", kind, *options, "--no-dashboard"],
                stdout=stream,
                stderr=stream,
                env=environment,
            )
        self._started.append(process)
        said = "Registered to" if kind == "worker" else "Scheduler at"
        deadline = time.monotonic() + 60.0
        while not (found := re.search(rf"{said}: *(tcp://\S+)", log.read_text())):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.05)  # else this loop would take the processor that it waits for
        return found[1]

    def end(self):
        for process in self._started:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    processes = Processes(tmp_path)
    yield processes
    processes.end()


def study(file, folder, *options, seeds=3):
    arguments = [str(file), "--seeds", str(seeds), "-o", str(folder)]
    return main(["study", *arguments, *map(str, options)])


def written(folder):
    return [(folder / name).read_bytes() for name in WRITTEN]


def test_a_cluster_that_loses_a_worker_gives_the_numbers_of_this_machine(
    cluster, experiment_file, tmp_path, capsys, monkeypatch
):
    file = experiment_file(duration=0.1)
    dying = cluster.worker()
    cluster.worker()
    taken = client.Cluster._record

    def kill_one(self, *outcome):
        if dying.poll() is None:
            dying.send_signal(signal.SIGKILL)
            dying.wait()
        return taken(self, *outcome)

    monkeypatch.setattr(client.Cluster, "_record", kill_one)
    assert study(file, tmp_path / "far", "--scheduler", cluster.address) == DONE
    assert f"2 workers at {cluster.address}, 2 runs at once" in capsys.readouterr().err
    assert dying.returncode == -signal.SIGKILL
    assert study(file, tmp_path / "near", "--jobs", 1) == DONE
    assert written(tmp_path / "far") == written(tmp_path / "near")
    monkeypatch.undo()
    leave_early(cluster.address, load_experiment(file))


def leave_early(address, experiment):
    """Close a batch after its first run: the next one has the worker for itself."""
    tasks = [
        replace(RunTask.of(experiment, "PID"), world=replace(experiment.world, seed=k))
        for k in range(40)
    ]
    with Cluster(address) as workers:
        assert list(workers({})) == []
        runs = workers(dict(enumerate(tasks)))
        place, record = next(runs)
        runs.close()
        assert list(run_batch({place: tasks[place]}, 1)) == [(place, record)]
        assert sorted(dict(workers(dict(enumerate(tasks[:3]))))) == [0, 1, 2]


def test_a_lost_scheduler_leaves_what_was_run_and_another_one_carries_on(
    cluster, experiment_file, tmp_path, capsys, monkeypatch
):
    file = experiment_file(duration=0.1)
    cluster.worker()
    taken = client.Cluster._record

    def end_all(self, *outcome):
        found = taken(self, *outcome)
        cluster.end()
        return found

    monkeypatch.setattr(client.Cluster, "_record", end_all)
    assert study(file, tmp_path / "s", "--scheduler", cluster.address) == FAILED
    assert "is lost, and" in capsys.readouterr().err
    assert len((tmp_path / "s" / "runs.jsonl").read_text().splitlines()) >= 1
    monkeypatch.undo()
    assert study(file, tmp_path / "s", "--resume") == DONE
    assert study(file, tmp_path / "near") == DONE
    assert written(tmp_path / "s") == written(tmp_path / "near")


def test_a_worker_with_other_sources_is_refused_by_name(
    cluster, experiment_file, tmp_path, capsys
):
    other = tmp_path / "other"
    other.mkdir()
    (other / "hpid_ros").symlink_to(Path(sys.modules["hpid_ros"].__file__).parent)
    # What python runs first: there the sources are others.
    (other / "sitecustomize.py").write_text(
        "import hpid_ros.experiment.cluster as worker\n"
        "found = dict(worker.traits(()), numpy='1.0')\n"
        "worker.traits = lambda engines: found\n"
    )
    cluster.worker(other)
    file = experiment_file(duration=0.05)
    assert study(file, tmp_path / "s", "--scheduler", cluster.address) == FAILED
    line = capsys.readouterr().err.splitlines()[-1]
    assert "cannot take part: it has numpy 1.0 instead of" in line
    assert not (tmp_path / "s").exists()


def test_a_worker_that_comes_later_is_looked_at_as_it_works(experiment_file):
    (task,), parcel = pack([RunTask.of(load_experiment(experiment_file()), "PID")])
    with pytest.raises(RunError, match=r"it has hpid_ros \S+ instead of 9\.9"):
        work(parcel, dict(traits(("mujoco",)), hpid_ros="9.9"), task)
    with pytest.raises(RunError, match=r"it has no pybullet$"):
        work(parcel, dict(traits(("mujoco",)), pybullet="3.2.7"), task)
    assert differences(traits(()), traits(("mujoco",))) == ""
    assert "mujoco" in traits(("mujoco",))


@pytest.mark.parametrize(
    ("address", "line"),
    [
        ("nobody", "--scheduler must be tcp://HOST:PORT, not 'nobody'"),
        ("127.0.0.1:99999", "--scheduler must be tcp://HOST:PORT, not '127.0.0.1:99999'"),
        ("127.0.0.1:1", "no Dask scheduler answers at 127.0.0.1:1 within 0.5 s"),
        (
            "without",
            "--scheduler needs Dask (import of distributed halted",
        ),
    ],
)
def test_an_address_that_is_none_is_one_line(address, line, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(client, "_ANSWERS_WITHIN", 0.5)
    if address == "without":
        address = "127.0.0.1:8786"
        monkeypatch.setitem(sys.modules, "distributed", None)
    code = study(STEP, tmp_path / "s", "--scheduler", address)
    assert code == (FAILED if "no Dask" in line else BAD_INPUT)
    (told,) = capsys.readouterr().err.splitlines()
    assert told.startswith(f"hpid: {line}")
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(
    "path", shipped([share_folder() / "config" / "experiments" / "iiwa.yaml"])
)
def test_a_robot_travels_with_its_meshes_and_keeps_its_numbers(path):
    experiment = load_experiment(path, "mujoco")
    task = replace(RunTask.of(experiment, "hPID"), periods=20)
    (packed,), parcel = pack([task])
    assert str(experiment.world.robot_description) not in repr(packed)
    there = unpack(parcel, packed)
    with WorldKeeper() as keeper:
        here, away = simulate(task, keeper), simulate(there, keeper)
    for one, other in zip(here.joints, away.joints, strict=True):
        assert one.position.tolist() == other.position.tolist()
        assert one.effort.tolist() == other.effort.tolist()


def test_shards_put_together_are_the_whole(experiment_file, tmp_path, capsys):
    file = experiment_file(duration=0.05)
    parts = [tmp_path / f"part{k}" for k in (1, 2, 3)]
    for k, part in enumerate(parts, 1):
        assert study(file, part, "--shard", f"{k}/3", "--jobs", 1) == DONE
        assert len((part / "runs.jsonl").read_text().splitlines()) == 2
    merge = [word for part in parts for word in ("--merge", part)]
    assert study(file, tmp_path / "all", *merge) == DONE
    assert study(file, tmp_path / "near", "--jobs", 1) == DONE
    assert written(tmp_path / "all") == written(tmp_path / "near")
    capsys.readouterr()
    assert study(file, tmp_path / "few", *merge[:4]) == BAD_INPUT
    assert "2 of 6 runs are in none of the parts" in capsys.readouterr().err
    assert study(file, tmp_path / "few", "--merge", tmp_path) == BAD_INPUT
    assert study(file, tmp_path / "few", "--shard", "4/3") == BAD_INPUT
    assert not (tmp_path / "few").exists()

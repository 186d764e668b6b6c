"""Studies on a Dask cluster: the numbers of one machine, whatever is lost."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import dask.distributed
import pytest
from harness.engines import shipped
from harness.studies import study, wait_until

from hpid_bench.cli.commands import BAD_INPUT, DONE, FAILED
from hpid_bench.experiment import cluster as client
from hpid_bench.experiment.batch import RunTask, WorldKeeper, run_batch, simulate_task
from hpid_bench.experiment.cluster import Cluster, pack, traits, unpack, version_differences, work
from hpid_bench.experiment.description import load_experiment
from hpid_ros.base.errors import RunError
from hpid_ros.base.resources import share_folder

STEP = share_folder() / "config" / "experiments" / "step.yaml"
WRITTEN = ("runs.csv", "runs.jsonl", "study.json", "tables.txt")


class Processes:
    """A scheduler of Dask and its workers, each a process of its own that talks TCP."""

    def __init__(self, folder):
        self._folder, self._started = folder, []
        self.address = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")

    def worker(self, folder=""):
        """Start a worker of one thread; ``folder`` comes first where it looks for modules."""
        options = ("--nthreads", "1", "--no-nanny")
        self._start("worker", self.address, *options, folder=folder)
        return self._started[-1]

    def _start(self, kind, *options, folder=""):
        """Start a process, and return where it listens."""
        log = self._folder / f"{kind}_{len(self._started)}.log"
        path = os.pathsep.join(filter(None, (str(folder), *sys.path)))
        with log.open("wb") as stream:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", kind, *options, "--no-dashboard"],
                stdout=stream,
                stderr=stream,
                env=dict(os.environ, PYTHONPATH=path),
            )
        self._started.append(process)
        said = "Registered to" if kind == "worker" else "Scheduler at"
        place = re.compile(rf"{said}: *(t(?:cp|ls)://\S+)")
        wait_until(lambda: place.search(log.read_text()) or process.poll() is not None)
        found = place.search(log.read_text())
        assert found, log.read_text()
        return found[1]

    def end(self):
        for process in self._started:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path):
    processes = Processes(tmp_path)
    yield processes
    processes.end()


def written(folder):
    return [(folder / name).read_bytes() for name in WRITTEN]


@pytest.mark.faults
def test_what_is_lost_of_a_cluster_changes_no_number(
    cluster, studied, tmp_path, capsys, monkeypatch
):
    """A worker, whose runs go to the others; then the scheduler, after which one carries on."""
    files, near = studied
    dying = cluster.worker()
    cluster.worker()
    taken = client.Cluster._record

    def kill_one(self, *run):
        if dying.poll() is None:
            dying.send_signal(signal.SIGKILL)
            dying.wait()
        return taken(self, *run)

    monkeypatch.setattr(client.Cluster, "_record", kill_one)
    assert study(files, tmp_path / "far", "--scheduler", cluster.address) == DONE
    assert f"2 workers at {cluster.address}" in capsys.readouterr().err
    assert dying.returncode == -signal.SIGKILL
    assert written(tmp_path / "far") == written(near)
    monkeypatch.undo()
    leave_early(cluster.address, load_experiment(files[0]))

    def end_all(self, *run):
        found = taken(self, *run)
        cluster.end()
        return found

    monkeypatch.setattr(client.Cluster, "_record", end_all)
    assert study(files, tmp_path / "l", "--scheduler", cluster.address) == FAILED
    errors = capsys.readouterr().err
    assert "is lost, and" in errors
    assert f"what was run: {tmp_path / 'l'}" in errors
    assert len((tmp_path / "l" / "runs.jsonl").read_text().splitlines()) >= 1
    assert study(files, tmp_path / "l", "--resume") == DONE
    assert written(tmp_path / "l") == written(near)


def leave_early(address, experiment):
    """Close a batch after its first run: the next one has the worker for itself."""
    tasks = {
        seed: RunTask.seeded(experiment, "", seed, experiment.controllers["PID"])
        for seed in range(40)
    }
    with Cluster(address) as workers:
        assert list(workers({})) == []
        runs = workers(tasks)
        seed, record = next(runs)
        runs.close()
        assert list(run_batch({seed: tasks[seed]}, 1)) == [(seed, record)]
        assert set(dict(workers({seed: tasks[seed] for seed in range(3)}))) == {0, 1, 2}


def test_a_worker_with_other_sources_is_refused_by_name(cluster, studied, tmp_path, capsys):
    other = tmp_path / "other"
    other.mkdir()
    for package in ("hpid_ros", "hpid_bench"):
        (other / package).symlink_to(Path(sys.modules[package].__file__).parent)
    # What python runs first: there the sources are others.
    (other / "sitecustomize.py").write_text(
        "import hpid_bench.experiment.cluster as worker\n"
        "found = dict(worker.traits(()), numpy='1.0')\n"
        "worker.traits = lambda engines: found\n"
    )
    cluster.worker(other)
    assert study(studied[0], tmp_path / "r", "--scheduler", cluster.address) == FAILED
    line = capsys.readouterr().err.splitlines()[-1]
    assert "cannot take part: it has numpy 1.0 instead of" in line
    assert not (tmp_path / "r").exists()


def test_a_worker_without_hpid_ros_is_refused_by_name(cluster, studied, tmp_path, capsys):
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['hpid_ros'] = None\n")
    cluster.worker(tmp_path)
    assert study(studied[0], tmp_path / "r", "--scheduler", cluster.address) == FAILED
    line = capsys.readouterr().err.splitlines()[-1]
    assert re.search(r"the worker at tcp://\S+ cannot take part: ModuleNotFoundError", line)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes the certificate")
def test_a_scheduler_is_met_by_tls_with_the_certificates_of_dasks_configuration(
    tmp_path, monkeypatch
):
    of_both = {"cert": "c.pem", "key": "k.pem"}
    tls = {"ca-file": "c.pem", "scheduler": of_both, "client": of_both}
    wanted = {f"distributed.comm.tls.{name}": each for name, each in tls.items()}
    monkeypatch.chdir(tmp_path)
    make = "openssl req -x509 -newkey rsa:2048 -nodes -subj /CN=x -out c.pem -keyout k.pem"
    subprocess.run(make.split(), check=True, capture_output=True)
    with dask.config.set({"distributed.comm.default-scheme": "tls", **wanted}):
        inherited = dask.config.serialize(dask.config.global_config)
        monkeypatch.setenv("DASK_INTERNAL_INHERIT_CONFIG", inherited)
        processes = Processes(tmp_path)
        try:
            with Cluster(processes.address) as workers:
                assert str(workers).startswith(f"no worker yet at {processes.address}")
        finally:
            processes.end()


def test_a_worker_that_comes_later_is_looked_at_as_it_works(experiment_file):
    (task,), parcel = pack([RunTask.of(load_experiment(experiment_file()), "PID")])
    with pytest.raises(RunError, match=r"it has hpid_ros \S+ instead of 9\.9"):
        work(parcel, dict(traits(("mujoco",)), hpid_ros="9.9"), task)
    with pytest.raises(RunError, match=r"it has no pybullet$"):
        work(parcel, dict(traits(("mujoco",)), pybullet="3.2.7"), task)
    assert version_differences(traits(()), traits(("mujoco",))) == ""
    assert {"mujoco", "scipy"} <= traits(("mujoco",)).keys()


def test_a_worker_makes_one_run_at_a_time_whatever_its_threads(experiment_file, monkeypatch):
    (task,), parcel = pack([RunTask.of(load_experiment(experiment_file()), "PID")])
    meeting = threading.Barrier(2)

    def met(*_):
        with suppress(threading.BrokenBarrierError):
            return meeting.wait(0.5) >= 0

    monkeypatch.setattr(client, "attempted", met)
    with ThreadPoolExecutor() as threads:
        assert list(threads.map(work, [parcel] * 2, [{}] * 2, [task] * 2)) == [None, None]


def test_a_run_that_a_cluster_cannot_read_is_one_line():
    unread = Future()
    unread.set_exception(RuntimeError("Error during\ndeserialization"))
    cluster = SimpleNamespace(_address="tcp://h:1")
    line = "at tcp://h:1 cannot take part: RuntimeError: Error during deserialization"
    with pytest.raises(RunError, match=line):
        Cluster._record(cluster, unread, "PID", 0)


@pytest.mark.parametrize(
    ("address", "line"),
    [
        ("nobody", "--scheduler must be tcp://HOST:PORT, not 'nobody'"),
        ("127.0.0.1:99999", "--scheduler must be tcp://HOST:PORT, not '127.0.0.1:99999'"),
        ("tls://127.0.0.1:1", "tls:// needs certificates: distributed.comm.tls in Dask's config"),
        ("127.0.0.1:1", "--scheduler: no Dask scheduler answers at 127.0.0.1:1 within 0.5 s"),
        ("without", "--scheduler needs Dask (import of distributed halted"),
    ],
)
def test_an_address_that_is_none_is_one_line(address, line, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(client, "_ANSWERS_WITHIN", 0.5)
    if address == "without":
        address = "127.0.0.1:8786"
        monkeypatch.setitem(sys.modules, "distributed", None)
    code = study([STEP], tmp_path / "s", "--scheduler", address)
    assert code == BAD_INPUT
    (told,) = capsys.readouterr().err.splitlines()
    assert told.startswith(f"hpid: {line}")
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(
    ("said", "line"),
    [
        (b"", "no Dask scheduler answers at"),
        (b"SSH-2.0-OpenSSH_9.6\r\n", "what answers at"),
        (bytes(4096), "what answers at"),
        ((2**40).to_bytes(8, "little") + b"x", "what answers at"),
    ],
)
def test_whatever_answers_in_place_of_a_scheduler_is_one_line(
    said, line, tmp_path, capfd, monkeypatch
):
    """A port of another service: what distributed makes of its bytes was a traceback."""
    monkeypatch.setattr(client, "_ANSWERS_WITHIN", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=answer_all, args=(server, said), daemon=True).start()
        address = f"127.0.0.1:{server.getsockname()[1]}"
        code = study([STEP], tmp_path / "s", "--scheduler", address)
    assert code == BAD_INPUT
    (told,) = capfd.readouterr().err.splitlines()
    assert told.startswith(f"hpid: --scheduler: {line} {address}")
    assert not (tmp_path / "s").exists()


def answer_all(server, said):
    """Say the same to each client, until the server is closed."""
    clients = []
    with suppress(OSError):
        while True:
            clients.append(server.accept()[0])
            clients[-1].sendall(said)


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
        here, away = simulate_task(task, keeper), simulate_task(there, keeper)
    for one, other in zip(here.joints, away.joints, strict=True):
        assert one.position.tolist() == other.position.tolist()
        assert one.effort.tolist() == other.effort.tolist()

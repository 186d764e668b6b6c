"""What dead processes left in shared memory goes, what living ones hold stays."""

import fcntl
import os
import socket
from pathlib import Path

import pytest

from hpid_bench.experiment.processes import SHARED_MEMORY, clear_dead, own_domain
from hpid_ros.base.errors import RunError

SEGMENT, PORT = "fastrtps_0123456789abcdef", "fastrtps_port7651"


def leave(folder, name, *locks):
    files = [
        folder / name,
        folder / f"sem.{name}_mutex",
        *(folder / (name + lock) for lock in locks),
    ]
    for file in files:
        file.write_bytes(b"x")
    return files


def test_dead_segments_and_ports_go_and_nothing_else(tmp_path):
    other = leave(tmp_path, "somebody_elses", "_el")
    for name, locks in ((SEGMENT, ("_el",)), (PORT, ("_el",)), ("fastrtps_port7650", ("_sl",))):
        leave(tmp_path, name, *locks)
    assert clear_dead(tmp_path, least_age=0.0) == 3
    assert sorted(tmp_path.iterdir()) == sorted(other)


@pytest.mark.parametrize(("lock", "kind"), [("_el", fcntl.LOCK_EX), ("_sl", fcntl.LOCK_SH)])
def test_what_is_held_stays(tmp_path, lock, kind):
    files = leave(tmp_path, PORT, lock)
    with (tmp_path / (PORT + lock)).open("rb+") as held:
        fcntl.flock(held, kind)
        assert clear_dead(tmp_path, least_age=0.0) == 0
        assert sorted(tmp_path.iterdir()) == sorted(files)  # nor does anything come
    assert clear_dead(tmp_path, least_age=0.0) == 1


@pytest.mark.parametrize("file", [f"{SEGMENT}_el", f"{PORT}_sl", f"sem.{PORT}_mutex"])
def test_what_is_left_of_a_segment_or_port_goes(tmp_path, file):
    (tmp_path / file).write_bytes(b"")
    assert clear_dead(tmp_path, least_age=0.0) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("lock", ["_el", "_sl"])
def test_who_begins_before_a_lock_could_be_made_keeps_it(tmp_path, monkeypatch, lock):
    files, begun = leave(tmp_path, PORT), []

    def opened(path, *others):
        if not begun and str(path).endswith(lock):
            begun.append(os.dup(os_open(path, os.O_RDWR | os.O_CREAT, 0o644)))
            fcntl.flock(begun[0], fcntl.LOCK_EX)
        return os_open(path, *others)

    os_open = os.open
    monkeypatch.setattr(os, "open", opened)
    assert clear_dead(tmp_path, least_age=0.0) == 0
    assert sorted(tmp_path.iterdir()) == sorted([*files, tmp_path / f"{PORT}{lock}"])
    os.close(begun[0])


def test_who_begins_while_a_port_is_removed_does_not_get_it(tmp_path, monkeypatch):
    """Who only writes makes a port without a lock; its reader may come at any time."""
    files, unlink, refused = leave(tmp_path, PORT), Path.unlink, []

    def listen(path, missing_ok=False):
        with (tmp_path / f"{PORT}_el").open("wb") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                refused.append(path)
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", listen)
    assert clear_dead(tmp_path, least_age=0.0) == 1
    assert refused[: len(files)] == files


def test_what_was_just_made_stays(tmp_path):
    leave(tmp_path, SEGMENT)
    assert clear_dead(tmp_path) == 0
    assert clear_dead(tmp_path / "nowhere") == 0


@pytest.mark.alone  # whoever just starts in another process would lose what it holds no lock of
def test_a_living_node_keeps_its_shared_memory_and_a_killed_one_does_not(harness):
    process = harness.start_controller(gains__p=1.0, gains__d=1.0, law="pid").process
    harness.ask(0, 0.0)

    def mapped(pid):
        lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
        found = {line.split()[-1] for line in lines if f"{SHARED_MEMORY}/fastrtps_" in line}
        return {Path(path) for path in found}

    alive = mapped(process.pid)
    clear_dead(least_age=0.0)
    assert alive
    assert all(path.exists() for path in alive)
    harness.ask(1_000_000, 0.1)
    process.kill()
    process.wait()
    clear_dead(least_age=0.0)
    assert not all(path.exists() for path in alive)
    # The test's own node lives on.
    assert any(path.exists() for path in mapped(os.getpid()))


def test_a_domain_in_which_somebody_listens_is_nobody_elses(tmp_path, monkeypatch):
    """A robot's graph has reserved none. No other test has one of these two."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("hpid_bench.experiment.processes._DOMAINS", (222, 223))
    monkeypatch.setattr("hpid_bench.experiment.processes.SHARED_MEMORY", tmp_path)
    with own_domain() as first, own_domain() as second:
        assert (first, second) == (222, 223)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("127.0.0.1", 7400 + 250 * 222 + 10))
        with own_domain() as domain:
            assert domain == 223
        leave(tmp_path, f"fastrtps_port{7400 + 250 * 223}", "_sl")
        with pytest.raises(RunError), own_domain():
            pass

"""Nobody gets into a closed graph: not from another host, not as another user, not by sockets."""

import json
import os
import subprocess
import sys

import pytest
from harness.places import ROOT

from hpid_bench.experiment.processes import CLOSED_MODE, NodeGroup, module_of, require_no_sockets

INTRUDER = ROOT / "test" / "harness" / "intruder.py"
NOBODY = 65534
TRIES_FOR = 10.0  # [s]; whoever is let in needs a fraction of a second, on a busy machine 3 s

# What somebody sets who wants to reach a robot.
OPEN = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    "ROS_STATIC_PEERS": "127.0.0.1",
}
OF_ANOTHER_USER = {"HOME": "/tmp", "ROS_LOG_DIR": "/tmp"}


def permitted(*command):
    try:
        run = subprocess.run(command, capture_output=True, check=False, timeout=20)
    except FileNotFoundError:
        return False
    return run.returncode == 0


def can_be_nobody():
    """Tell whether a process may become another user."""
    code = f"import os; os.setgroups([]); os.setgid({NOBODY}); os.setuid({NOBODY})"
    return permitted(sys.executable, "-c", code)


NAMESPACES = ("unshare", "--net", "--ipc", "--mount", "--")
needs_namespaces = pytest.mark.skipif(
    not permitted(*NAMESPACES, "mount", "-t", "tmpfs", "none", "/dev/shm"),
    reason="this system permits no network and mount namespaces",
)
needs_another_user = pytest.mark.skipif(
    not can_be_nobody(), reason="this user may not become another one"
)


def intrude(environment, before=(), arguments=None, seconds=TRIES_FOR, until="all"):
    """Run the intruder and return what it reached."""
    arguments = map(str, (seconds, until, *(arguments or [os.getuid()])))
    command = [*before, sys.executable, str(INTRUDER), *arguments]
    run = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


@pytest.fixture
def controller(harness):
    process = harness.start_controller(law="pid", gains__p=10.0)
    require_no_sockets([process.pid])
    harness.ask(0, 0.5)
    assert harness.ask(1_000_000, 0.25) == 2.5
    return process


def gain(harness):
    """Return the proportional gain that is in force, by what it does."""
    stamp_ns = max(command.stamp_ns for command in harness.commands) + 1_000_000
    return harness.ask(stamp_ns, 0.4) / (0.5 - 0.4)


def test_the_intruder_gets_in_where_it_may(harness, controller):
    """Without this the others would prove nothing."""
    reached = intrude(dict(os.environ), seconds=20.0)
    assert reached["listeners"] >= 1
    assert reached["set"] is True
    assert gain(harness) == pytest.approx(999.0)


@needs_another_user
def test_another_user_gets_in_where_the_graph_is_open(harness, tmp_path):
    """What DDS without security exposes, and why experiments run in the closed mode."""
    environment = {**os.environ, **OPEN}
    with NodeGroup(environment, tmp_path) as group:
        arguments = ["-p", "joint:=elbow", "-p", "gains.p:=10.0"]
        group.start("elbow_controller", "joint_controller", arguments)
        reached = intrude(
            {**environment, **OF_ANOTHER_USER}, arguments=[NOBODY], seconds=30.0, until="set"
        )
    assert reached["set"] is True


@needs_namespaces
@pytest.mark.parametrize("mode", [OPEN, {**CLOSED_MODE}], ids=["open", "closed"])
def test_another_host_finds_nobody(harness, controller, faults, mode):
    """A network and memory of its own is what a process on another host has."""
    environment = {**os.environ, **mode}
    before = [*NAMESPACES, "sh", "-c", 'mount -t tmpfs none /dev/shm; exec "$@"', "sh"]
    reached = intrude(environment, before)
    faults.count("intrusions tried, none succeeded")
    assert (reached["listeners"], reached["set"]) == (0, False)
    assert gain(harness) == pytest.approx(10.0)
    assert all(abs(command.effort[0]) != 99.0 for command in harness.commands)


@needs_another_user
@pytest.mark.parametrize("mode", [OPEN, {**CLOSED_MODE}], ids=["open", "closed"])
def test_another_user_of_this_machine_finds_nobody(harness, controller, faults, mode):
    reached = intrude({**os.environ, **mode, **OF_ANOTHER_USER}, arguments=[NOBODY])
    faults.count("intrusions tried, none succeeded")
    assert reached == {"listeners": 0, "set": False, "user": NOBODY}
    assert gain(harness) == pytest.approx(10.0)
    assert all(abs(command.effort[0]) != 99.0 for command in harness.commands)


@pytest.mark.parametrize("node", ["mujoco_bridge", "joint_controller -p joint:=a"])
def test_security_that_is_asked_for_and_missing_is_said(harness, tmp_path, node):
    """With these wheels the variable alone changes nothing: it must not lull anybody."""
    environment = {**os.environ, "ROS_SECURITY_ENABLE": "true"}
    name, *arguments = node.split()
    command = [sys.executable, "-m", module_of(name), "--ros-args", *arguments]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        try:
            harness.wait(
                lambda: b"built without security" in (tmp_path / "log").read_bytes(),
                what="the warning",
            )
        finally:
            process.kill()
            process.wait()

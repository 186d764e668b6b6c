"""Nodes that are forked from a server: they are like others, and end with whoever started them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from harness.graph import ros_arguments

from hpid_ros.base.errors import RunError
from hpid_ros.experiment.forking import Beginning, ForkServer
from hpid_ros.experiment.processes import NodeGroup

GONE_WITHIN = 30.0


@pytest.fixture
def group(harness, tmp_path):
    with NodeGroup(harness.environment, tmp_path, is_forked=True) as group:
        yield group


def wait_until_gone(pids):
    deadline = time.monotonic() + GONE_WITHIN
    while any(is_running(pid) for pid in pids):
        assert time.monotonic() < deadline, [
            Path(f"/proc/{pid}/status").read_text() for pid in pids
        ]
        time.sleep(0.01)


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_forked_node_works_leads_a_session_and_ends_by_a_signal(harness, group):
    arguments = ros_arguments(joint="elbow")
    node = group.start("elbow_controller", "joint_controller", arguments)
    harness.wait(lambda: harness.states.get_subscription_count() == 1, what="the controller")
    assert os.getsid(node.pid) == node.pid
    assert node.process.poll() is None
    environment = Path(f"/proc/{node.pid}/stat").read_text()
    assert environment.split()[3] == str(os.getpid())  # its parent
    with pytest.raises(subprocess.TimeoutExpired):
        node.process.wait(0.01)
    node.process.terminate()
    assert node.process.wait(GONE_WITHIN) == 0
    assert node.process.poll() == 0
    second = group.start("second", "joint_controller", arguments)
    second.process.kill()
    assert second.process.wait(GONE_WITHIN) == -signal.SIGKILL


def test_what_a_forked_node_refuses_is_its_last_line_and_its_exit_code(group):
    node = group.start("elbow_controller", "joint_controller", ros_arguments(joint="a", mu=1.0))
    assert node.process.wait(GONE_WITHIN) == 2
    assert "mu" in node.last_words()
    missing = group.start("missing", "no_such_node", [])
    assert missing.process.wait(GONE_WITHIN) == 1
    assert "no_such_node" in missing.last_words()


PROGRAM = """
import os, sys, time
from pathlib import Path
from hpid_ros.base.errors import RunError
from hpid_ros.experiment.forking import Beginning, ForkServer
from hpid_ros.experiment.processes import NodeGroup
group = NodeGroup(os.environ, Path(sys.argv[1]), is_forked=True)
node = group.start("a", "joint_controller", ["-p", "joint:=a"])
server = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
print(node.pid, *server, flush=True)
time.sleep(600)
"""


def test_forked_nodes_and_their_server_end_when_their_starter_is_killed(harness, tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path)],
        env=harness.environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as starter:
        pids = [int(pid) for pid in starter.stdout.readline().split()]
        assert len(set(pids)) == 2
        assert all(map(is_running, pids))
        starter.kill()
    wait_until_gone(pids)


def test_without_its_server_no_node_is_started_and_one_line_says_so(group):
    server = ForkServer(os.environ)
    server._process.kill()
    server._process.wait()
    with pytest.raises(RunError, match="what forks nodes has ended"):
        server.fork("hpid_ros.nodes.joint_controller", [], {}, Beginning(signal.SIGTERM), {})

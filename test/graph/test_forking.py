"""Nodes that are forked from a server are like others; that all end together: test_graph_run."""

import os
import signal
import subprocess
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


def test_without_its_server_no_node_is_started_and_one_line_says_so(group):
    server = ForkServer(os.environ)
    server._process.kill()
    server._process.wait()
    with pytest.raises(RunError, match="what forks nodes has ended"):
        server.fork("hpid_ros.nodes.joint_controller", [], {}, Beginning(signal.SIGTERM), {})

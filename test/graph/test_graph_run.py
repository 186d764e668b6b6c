"""Comparisons on the real graph: equal to the in-process engine, closed, robust; forked nodes."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from harness.experiments import write_experiment
from harness.graph import ros_arguments
from harness.studies import children_of, is_alive, wait_until
from mcap_ros2.reader import read_ros2_messages

from hpid_bench.experiment import graph_run
from hpid_bench.experiment.compare import run_comparison
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.forking import Beginning, ForkServer
from hpid_bench.experiment.graph_run import GraphOptions, run_on_graph
from hpid_bench.experiment.in_process import NoProgress
from hpid_bench.experiment.processes import NodeGroup, network_sockets, require_no_sockets
from hpid_ros.base.errors import RunError
from hpid_ros.messages.run import read_run


def run_compare(experiment, folder, **options):
    """Return the result's folder."""
    each = GraphOptions(processes="each")
    run_comparison(experiment, folder, NoProgress(), options=each, **options)
    return folder


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Return an experiment and the result of its comparison on the graph."""
    folder = tmp_path_factory.mktemp("compared")
    # What an observer knows of the efforts is what was sent, noise and all.
    observer = {"degree": -0.2, "feed_disturbance": True}
    law = {"law": "hpid", "mu": -0.1, "velocity_source": "observer", "observer": observer}
    unit_gains = {"p": 300.0, "i": 1000.0, "d": 30.0}  # three poles at -10 rad/s
    model = {"compensation": "decoupling", "gains": unit_gains, "model": {"payload": 0.4}}
    changes = {"compare__observer": law, "compare__model": {"law": "hpid", "mu": -0.1, **model}}
    file = write_experiment(folder, sensors__noise=2e-4, **changes)
    experiment = load_experiment(file)
    return experiment, run_compare(experiment, folder / "result")


def test_graph_and_in_process_engine_agree_to_the_last_bit(compared, tmp_path):
    """Also where nine processes each compute the model that one shares between the joints."""
    experiment, there = compared
    folders = there, run_compare(experiment, tmp_path / "here", in_process=True)
    first, other = [(each / "result.json").read_bytes() for each in folders]
    assert other == first
    for label in experiment.controllers:
        bags = [each / "bags" / label for each in folders]
        for one, other in zip(*(read_run(bag, "run").joints for bag in bags), strict=True):
            assert np.array_equal(one.position, other.position)
            assert np.array_equal(one.effort, other.effort)


def test_another_reader_finds_every_state_and_its_eight_commands(compared):
    experiment, folder = compared
    reports = json.loads((folder / "timing.json").read_text())["runs"].values()
    assert [(each["processes"], each["warnings"]) for each in reports] == [(10, [])] * 4
    (mcap,) = (folder / "bags" / "hPID").glob("*.mcap")
    states, commands = [], {}
    for message in read_ros2_messages(mcap):
        stamp = message.ros_msg.header.stamp
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        if message.channel.topic == "/joint_states":
            states.append(stamp_ns)
        elif message.channel.topic == "/joint_commands":
            commands.setdefault(stamp_ns, []).extend(message.ros_msg.name)
    assert states == [k * 1_000_000 for k in range(301)]
    assert list(commands) == states
    joints = sorted(experiment.world.joints)
    assert all(sorted(set(names)) == joints for names in commands.values())


class KillerOf(NoProgress):
    """Kills a node of the running graph when the simulation has come far enough."""

    def __init__(self, node, when):
        self._node, self._when, self.killed_at = node, when, None

    def advanced(self, label, simulated):
        if self.killed_at is None and simulated >= self._when:
            self.killed_at = simulated
            os.kill(child_of(self._node), signal.SIGKILL)


def children():
    """Return the names of this process's children that write a log, by pid."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            log = (path / "fd" / "1").readlink()
        except OSError:  # it has ended, or is not ours
            continue
        if parent == os.getpid() and log.suffix == ".log":
            found[int(path.name)] = log.stem
    return found


def child_of(node):
    return next(pid for pid, name in children().items() if name == node)


def test_controllers_get_a_process_each_where_every_process_has_a_core():
    for processes, kind in ((None, ("composed", "each")), ("each", ("each", "each"))):
        options = GraphOptions(processes)
        assert tuple(options.for_joints(8, cores).processes for cores in (8, 9)) == kind


@pytest.mark.faults
def test_a_killed_controller_leaves_the_others_at_work(experiment_file, tmp_path):
    """Its joint gets no effort, the run says so, and nobody else misses a sample."""
    experiment = load_experiment(
        experiment_file(duration=1.0, control={"rate": 1000, "answer_timeout": 0.5})
    )
    folder = tmp_path / "nodes"
    folder.mkdir()
    killer = KillerOf("arm_joint_2_controller", 0.2)
    each = GraphOptions(processes="each")
    report = run_on_graph(experiment, "hPID", tmp_path / "bag", folder, killer, each)
    assert killer.killed_at is not None
    assert report.states == 1001
    silent = " ".join(line for line in report.warnings if "no command" in line)
    assert "arm_joint_2" in silent
    assert any("arm_joint_2_controller ended" in line for line in report.warnings)
    run = read_run(tmp_path / "bag", "run")
    for series in run.joints:
        lost = run.losses[series.joint].unanswered_states
        if series.joint == "arm_joint_2":
            assert lost == 1001 - len(series.effort) > 0
        elif series.joint not in silent:  # a busy machine may be late, and says so
            assert (lost, len(series.effort)) == (0, 1001)
    (mcap,) = (tmp_path / "bag").glob("*.mcap")
    *_, last = read_ros2_messages(mcap, topics=["/joint_states"])
    assert last.ros_msg.effort[last.ros_msg.name.index("arm_joint_2")] == 0.0


@pytest.mark.faults
@pytest.mark.parametrize("node", ["mujoco_bridge", "bag_recorder"])
def test_a_run_that_loses_what_it_cannot_do_without_fails_in_one_line(
    experiment_file, tmp_path, node
):
    experiment = load_experiment(experiment_file(duration=5.0))
    folder = tmp_path / "nodes"
    folder.mkdir()
    # In lock-step the recorder is in the bridge's process.
    options = GraphOptions(is_realtime=node == "bag_recorder")
    with pytest.raises(RunError, match=f"{node} ended with code -9") as failure:
        run_on_graph(experiment, "hPID", tmp_path / "bag", folder, KillerOf(node, 0.1), options)
    assert "\n" not in str(failure.value)
    assert not children()


class SlowRecorder:
    """A recorder that has written one state more at each look, 6 s after the one before."""

    name, pid, is_open = "bag_recorder", os.getpid(), False
    process = SimpleNamespace(poll=lambda: None)

    def __init__(self, monkeypatch, most):
        self._looks, self._most = 0, most
        monkeypatch.setattr(graph_run.time, "monotonic", lambda: 6.0 * self._looks)
        monkeypatch.setattr(graph_run, "require_no_sockets", lambda processes: None)

    def read_events(self):
        self._looks += 1
        return [{"event": "recorded", "counts": {"/joint_states": min(self._looks, self._most)}}]


@pytest.mark.parametrize("most", [9, 5])
def test_a_recorder_is_waited_for_as_long_as_it_gets_on(monkeypatch, most):
    recorder = SlowRecorder(monkeypatch, most)
    nodes = SimpleNamespace(bridge="bridge", recorder=recorder.name, topics=())
    group = SimpleNamespace(nodes={recorder.name: recorder})
    run = graph_run._GraphRun(nodes, "PID", group, NoProgress())
    run.events["bridge", "finished"] = {"states": 9, "commands": 0}
    if most == 9:
        run.wait_until_recorded(10.0)
    else:
        line = r"timed out after 10 s: the recorder lacks \{'/joint_states': 4\}"
        with pytest.raises(RunError, match=line):
            run.wait_until_recorded(10.0)


def heed_interrupts():
    """Undo what a shell without job control does to what it runs in the background."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.faults
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_whatever_ends_a_comparison_ends_its_nodes_and_leaves_a_readable_bag(
    experiment_file, tmp_path, number
):
    folder = tmp_path / "result"
    command = [sys.executable, "-m", "hpid_bench.cli.main", "compare", "--separate", "-o", folder]
    hpid = subprocess.Popen(
        [*command, experiment_file(duration=100.0)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        preexec_fn=heed_interrupts,
    )
    try:
        mcap = folder / "bags" / "PID" / "PID.mcap"
        wait_until(lambda: mcap.exists() and mcap.stat().st_size > 200_000, 60.0)
        nodes = children_of(hpid.pid)
        assert len(nodes) == 11  # with the server that forked them
        hpid.send_signal(number)
        hpid.wait(timeout=60)
        wait_until(lambda: not any(map(is_alive, nodes)))
    finally:
        hpid.kill()
        hpid.wait()
    run = read_run(folder / "bags" / "PID", "PID")
    assert len(run.joints) == 8
    assert len(run.joints[0].position) > 10  # a slow machine flushes few at a time
    if number == signal.SIGINT:
        assert hpid.returncode == 130
        assert b"Traceback" not in hpid.stderr.read()


def test_the_self_check_sees_a_network_socket():
    """Each setting of the closed mode alone leaves the door open; the check must notice."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        assert "udp" in network_sockets(os.getpid())
        with pytest.raises(RunError, match=r"not closed: .*\(.*udp"):
            require_no_sockets([os.getpid()])


# --- nodes that are forked from a server are like others

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

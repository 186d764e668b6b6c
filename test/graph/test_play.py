"""``hpid play``: robot, controllers and page by one command, and nothing of them after it."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import HTTPCookieProcessor, build_opener, urlopen

import pytest

from hpid_bench.cli.commands import play as play_command
from hpid_bench.experiment.description import load_experiment
from hpid_bench.report.console import TextConsole

EXPERIMENT = "extends: config/experiments/paper.yaml\nname: mine\nsimulation: {engine: mujoco}\n"
ENDED_WITHIN = 60.0


@pytest.fixture
def play(harness, tmp_path):
    """Return a function that starts it and gives the process and what it printed."""
    file = tmp_path / "mine.yaml"
    file.write_text(EXPERIMENT)
    started = []

    def begin(*options):
        process = subprocess.Popen(
            [sys.executable, "-m", "hpid_bench.cli.main", "play", str(file), *options],
            env=harness.environment | {"DISPLAY": ""},  # that is none
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        lines = []
        while not lines or not lines[-1].startswith("Ctrl-C"):
            lines.append(process.stdout.readline())
            assert lines[-1], process.stderr.read()
        return process, lines

    yield begin
    for process in started:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=ENDED_WITHIN)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def nodes_of(process):
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return {int(pid): Path(f"/proc/{pid}/cmdline").read_text().split("\0")[2] for pid in children}


def test_one_command_starts_robot_controllers_and_page_and_ends_them(harness, play):
    process, lines = play("--port", "0", "--no-browser", "--no-window")
    page = next(line.split()[1] for line in lines if line.startswith("page:"))
    with build_opener(HTTPCookieProcessor()).open(page, timeout=20.0) as answer:
        assert answer.status == 200
    root = page.partition("?")[0]
    assert root.startswith("http://127.0.0.1:")
    with pytest.raises(HTTPError):  # who has neither token nor cookie
        urlopen(root, timeout=20.0)
    harness.wait(lambda: len({each.names[0] for each in harness.commands}) == 8, what="all joints")
    assert harness.set_parameters("arm_joint_6_controller", mu=0.2)[0]
    assert not harness.set_parameters("arm_joint_6_controller", mu=0.6)[0]
    nodes = nodes_of(process)
    assert len(nodes) >= 3
    process.send_signal(signal.SIGINT)
    assert process.wait(ENDED_WITHIN) == 0
    assert not any(Path(f"/proc/{pid}").exists() for pid in nodes)
    assert "Traceback" not in process.stderr.read()


@pytest.mark.faults
@pytest.mark.parametrize("name", ["mujoco_bridge", "trajectory_publisher"])
def test_a_node_that_dies_ends_the_others_with_one_line(harness, play, name):
    process, lines = play("--no-page")
    assert not any("no page" in line or line.startswith("page:") for line in lines)
    nodes = nodes_of(process)
    node = next(pid for pid, module in nodes.items() if module.endswith(name))
    os.kill(node, signal.SIGKILL)
    assert process.wait(ENDED_WITHIN) == 1
    (line,) = process.stderr.read().splitlines()
    assert line.startswith(f"hpid: {name} ended with code -9")
    assert not any(Path(f"/proc/{pid}").exists() for pid in nodes)


@pytest.mark.parametrize(
    ("chosen", "where"),
    [
        ({}, "this computer alone"),
        ({"ROS_LOCALHOST_ONLY": "1"}, "this computer alone"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, "this computer alone"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "the network"),
        ({"ROS_LOCALHOST_ONLY": "0"}, "the network"),
        ({"ROS_STATIC_PEERS": "10.0.0.2"}, "the network"),
    ],
)
def test_where_the_nodes_are_seen_is_told_as_the_environment_says(
    monkeypatch, capsys, experiment_file, chosen, where
):
    for name in play_command._CHOSEN:
        monkeypatch.delenv(name, raising=False)
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    experiment = load_experiment(experiment_file())
    play_command._print(TextConsole(), experiment, "PID", is_page_missing=False)
    assert f", on {where}" in capsys.readouterr().out

"""``hpid run``: the same numbers in however many processes, and a true account of the time."""

import json

import numpy as np
import pytest

from hpid_bench.cli.main import main
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.graph_run import trial_line
from hpid_bench.experiment.in_process import NoProgress, run_without_ros
from hpid_ros.messages.run import read_run


def run(file, folder, *options):
    return main(["run", str(file), "-o", str(folder), "--controller", "hPID", *options])


@pytest.mark.parametrize(("option", "processes"), [("--composed", 3), ("--single-process", 2)])
def test_processes_change_nothing_of_the_numbers(
    experiment_file, tmp_path, capsys, option, processes
):
    """Against the engine in one process; a process for each joint is in test_graph_run.py."""
    file, folder = experiment_file(), tmp_path / "graph"
    assert run(file, folder, option) == 0
    assert "arm_joint_6" in capsys.readouterr().out
    timing = json.loads((folder / "timing.json").read_text())["runs"]["hPID"]
    assert timing["processes"] == processes
    assert timing["warnings"] == []
    assert len(timing["timing"]["joints"]) == 8
    for joint in timing["timing"]["joints"].values():
        assert joint["samples"] == 301
        assert joint["missed"] == joint["unanswered"] == 0
        assert joint["period"]["samples"] == 300
        for name in ("compute", "latency"):
            assert 0 < joint[name]["median"] <= joint[name]["maximum"]
    assert main(["replay", str(folder / "bags" / "hPID")]) == 0
    assert "every one of 2 408 commands is the law's" in capsys.readouterr().out
    run_without_ros(load_experiment(file), "hPID", tmp_path / "here", NoProgress())
    bags = (folder / "bags" / "hPID", tmp_path / "here")
    for one, other in zip(*(read_run(bag, "hPID").joints for bag in bags), strict=True):
        assert np.array_equal(one.position, other.position)
        assert np.array_equal(one.effort, other.effort)


def test_realtime_keeps_the_wall_clock(experiment_file, tmp_path, capsys):
    """The bridge's own clock, not a guess from outside: no state comes early."""
    folder = tmp_path / "run"
    file = experiment_file(control__rate=100)
    assert run(file, folder, "--single-process", "--realtime", "--no-record") == 0
    assert "trial of 31 states: a cycle takes" in capsys.readouterr().out
    timing = json.loads((folder / "timing.json").read_text())["runs"]["hPID"]
    assert timing["wall_time"] >= 0.29
    assert timing["timing"]["cycle"]["median"] >= 5_000.0
    assert not (folder / "bags" / "hPID").exists()
    assert not (folder / "result.json").exists()


def test_a_trial_says_whether_the_rate_can_be_held():
    can, at_times, never = (
        trial_line(1001, *times, 1.0) for times in ((0.4, 0.9), (0.8, 1.1), (2, 3))
    )
    assert can.endswith("1 ms (1000 Hz) can be held")
    assert "at most 1.10 ms: more than 1 ms (1000 Hz), so that some states" in at_times
    assert "most states will be late" in never


@pytest.mark.parametrize(
    ("options", "said"),
    [(["--controller", "hPIDD"], "'hPIDD'"), (["--realtime-priority", "100"], "[0, 99], not 100")],
)
def test_bad_input_is_one_line(experiment_file, tmp_path, refused, options, said):
    assert said in refused("run", experiment_file(), "-o", tmp_path / "run", *options)
    assert not (tmp_path / "run").exists()

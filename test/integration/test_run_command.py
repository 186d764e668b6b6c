"""``hpid run``: the same numbers in however many processes, and a true account of the time."""

import json

import numpy as np
import pytest

from hpid_ros.cli.main import main
from hpid_ros.experiment.graph_run import trial_line
from hpid_ros.messages.run import read_run

FORMS = {"each": [], "composed": ["--composed"], "single": ["--single-process"]}
PROCESSES = {"each": 11, "composed": 4, "single": 2}


def run(file, folder, *options):
    return main(["run", str(file), "-o", str(folder), "--controller", "hPID", *options])


def test_processes_change_nothing_of_the_numbers(experiment_file, tmp_path, capsys):
    file = experiment_file()
    runs = {}
    for form, options in FORMS.items():
        folder = tmp_path / form
        assert run(file, folder, *options) == 0
        assert "arm_joint_6" in capsys.readouterr().out
        timing = json.loads((folder / "timing.json").read_text())["runs"]["hPID"]
        assert timing["processes"] == PROCESSES[form]
        assert timing["warnings"] == []
        joints = timing["timing"]["joints"]
        assert len(joints) == 8
        for joint in joints.values():
            assert joint["samples"] == 301
            assert joint["missed"] == joint["unanswered"] == 0
            assert joint["period"]["samples"] == 300
            assert 0 < joint["compute"]["median"] <= joint["compute"]["maximum"]
            assert 0 < joint["latency"]["median"] <= joint["latency"]["maximum"]
        assert main(["replay", str(folder / "bags" / "hPID")]) == 0
        assert "every one of 2 408 commands is the law's" in capsys.readouterr().out
        runs[form] = read_run(folder / "bags" / "hPID", "hPID").joints
    for form in ("composed", "single"):
        for one, other in zip(runs["each"], runs[form], strict=True):
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
    [
        (["--controller", "hPIDD"], "'hPIDD'"),
        (["--realtime-priority", "100"], "[0, 99], not 100"),
    ],
)
def test_bad_input_is_one_line(experiment_file, tmp_path, capsys, options, said):
    assert run(experiment_file(), tmp_path / "run", *options) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()

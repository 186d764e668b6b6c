"""A joint that does not follow is named, and leaves no trace where all follow."""

import numpy as np
import pytest

from hpid_bench.experiment.compare import ExperimentResult, save_numbers
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.result_folder import ResultFolder
from hpid_ros.messages.quality import DataQuality, RecordingQuality, StampQuality
from hpid_ros.messages.quality_lines import quality_lines, unfollowed, unfollowed_lines
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics import Comparison, run_indices

TIME = np.linspace(0.0, 4.0, 4001)
MOVE = np.clip(TIME - 1.0, 0.0, 0.5)  # at rest, half a radian in half a second, at rest
SWING = 0.5 * np.sin(3.0 * TIME)


def series(joint, reference, position):
    stamps = np.round(TIME * 1e9).astype(np.int64)
    return JointSeries(joint, stamps, position, reference, stamps, np.zeros_like(TIME))


def late(signal, samples):
    return np.concatenate([np.full(samples, signal[0]), signal[:-samples]])


@pytest.mark.parametrize(
    ("reference", "position", "error"),
    [
        (MOVE, np.zeros_like(TIME), 0.5),  # stays where it was
        (np.zeros_like(TIME), np.full_like(TIME, -0.4), 0.4),  # at rest beside its reference
        (SWING, np.full_like(TIME, 2.0), 1.5),
    ],
)
def test_a_joint_whose_error_stays_large_is_found_with_that_error(reference, position, error):
    run = RunSeries("hPID", (series("elbow", reference, position), series("wrist", MOVE, MOVE)))
    assert unfollowed(run) == {"elbow": pytest.approx(error, abs=0.35)}
    (line,) = unfollowed_lines([run])
    assert "'hPID'" in line
    assert "elbow (" in line
    assert "wrist" not in line
    assert line in list(quality_lines(run))


@pytest.mark.parametrize(
    ("reference", "position"),
    [
        (MOVE, late(MOVE, 700)),  # slow, but it arrives
        (MOVE, MOVE + 0.04),  # an offset that gravity leaves to a PD
        (40.0 * TIME, 40.0 * TIME - 3.0),  # a wheel behind its reference
        (np.zeros_like(TIME), np.where(TIME < 3.0, 0.4, 0.0)),  # gets there in the end
    ],
)
def test_a_joint_that_follows_late_or_with_an_offset_is_not_named(reference, position):
    run = RunSeries("PID", (series("elbow", reference, position),))
    assert unfollowed(run) == {}
    assert not list(unfollowed_lines([run]))


def test_a_joint_that_moves_though_all_of_its_efforts_are_zero_is_named():
    def lines(**efforts):
        joints = []
        for name, effort in efforts.items():
            stamps = np.round(TIME * 1e9).astype(np.int64)
            position = MOVE if name.startswith("moved") else np.zeros_like(TIME)
            joints.append(JointSeries(name, stamps, position, position, stamps, effort))
        return [
            line for line in quality_lines(RunSeries("PID", tuple(joints))) if "effort" in line
        ]

    none, some = np.zeros_like(TIME), np.where(TIME > 3.99, 0.1, 0.0)
    (line,) = lines(moved_idle=none, moved_driven=some, rested_idle=none)
    assert "every effort of moved_idle is 0" in line
    assert lines(moved_driven=some, rested_idle=none) == []


def test_efforts_of_a_part_of_the_time_are_named():
    for begin, is_named in ((0.3, False), (3.0, True)):
        states, commands = (StampQuality(99, 0.1, each, 10.0) for each in (0.0, begin))
        quality = RecordingQuality(joints={"elbow": DataQuality(states, commands)})
        run = RunSeries("PID", (series("elbow", MOVE, MOVE),), quality=quality)
        assert any("efforts of elbow begin" in each for each in quality_lines(run)) is is_named


def test_a_comparison_names_the_joint_below_the_table_and_in_the_result(experiment_file, tmp_path):
    experiment = load_experiment(experiment_file())

    def result(**offsets):
        runs = [
            RunSeries(label, (series("elbow", MOVE, MOVE + offset),))
            for label, offset in offsets.items()
        ]
        return ExperimentResult(
            experiment, runs, Comparison(tuple(run_indices(run) for run in runs))
        )

    followed, not_followed = result(PID=0.0, hPID=0.01), result(PID=0.0, hPID=0.4)
    assert not followed.notes
    assert "unfollowed" not in followed.as_mapping()
    assert not_followed.as_mapping()["unfollowed"] == {"hPID": {"elbow": pytest.approx(0.4)}}
    with ResultFolder.create(tmp_path / "result") as folder:
        save_numbers(not_followed, folder, [], "nothing")
    assert "run 'hPID': these joints do not follow" in (folder.path / "table.txt").read_text()

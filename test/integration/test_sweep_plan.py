"""Grids as a person means them: axes, combinations, baselines, and ratios over them."""

import numpy as np
import pytest

from hpid_ros.base.errors import SettingError
from hpid_ros.experiment.batch import TOTAL, RunRecord, run_batch
from hpid_ros.experiment.sweep import Axis, SweepResult, plan_sweep
from hpid_ros.metrics.quantities import IVC


def planned(experiment, *texts, **options):
    return plan_sweep(experiment, [Axis.parse(text) for text in texts], **options)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("mu=-0.3:0.3:7", (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)),
        ("norm.error_scale = 0.1, 0.3,1", (0.1, 0.3, 1.0)),
        ("gains.p=1e2:2e2:2", (100.0, 200.0)),
        ("norm.type=weighted,canonical", ("weighted", "canonical")),
        ("payload=0:2:5", (0.0, 0.5, 1.0, 1.5, 2.0)),
    ],
)
def test_axes_are_what_a_person_means(text, values):
    assert Axis.parse(text).values == values


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mu", "must be NAME=START:STOP:COUNT"),
        ("=1", "must be NAME="),
        ("mu=0.1,", "'' is not a number"),
        ("mu=small", "'small' is not a number"),
        ("mu=0.1:0.3", "must be START:STOP:COUNT"),
        ("mu=0.1:0.3:1", "for one value write NAME=VALUE"),
        ("mu=0.1:0.3:1e9", "from 2 to 10000"),
        ("mu=0.1:0.1:2", "0.1 is there twice"),
        ("mu=nan", "not finite"),
        ("muu=0.1", "did you mean 'mu'"),
        ("joint=elbow", "unknown parameter 'joint'"),
        ("law=pdi", "one of hpid, pid"),
    ],
)
def test_bad_axes_are_refused_in_a_line_that_repeats_them(text, words):
    with pytest.raises(SettingError) as refusal:
        Axis.parse(text)
    assert words in str(refusal.value)
    assert repr(text) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("texts", "options", "words"),
    [
        ([], {}, "nothing is varied"),
        (["mu=0.1", "mu=0.2"], {}, "mu is varied twice"),
        (["mu=0.1"], {"controller": "hPI"}, "did you mean 'hPID'"),
        (["mu=0.1"], {"controller": "PID"}, "no effect on controller 'PID'"),
        (["mu=0.1"], {"joints": ["arm_joint_7"]}, "unknown joint 'arm_joint_7'"),
        (["mu=0.1"], {"seeds": 0}, "seeds must be at least 1"),
        (["mu=-0.4:0.4:9999"], {"seeds": 1000}, "9999000 runs are too many"),
        (["mu=0.5:0.9:3"], {}, r"no point can run; hPID mu=0.5: .*\(-0.5, 0.5\)"),
    ],
)
def test_grids_that_make_no_sense_are_refused(experiment, texts, options, words):
    with pytest.raises(SettingError, match=words):
        planned(experiment, *texts, **options)


def test_a_grid_is_every_combination_with_every_seed(experiment):
    sweep = planned(experiment, "mu=-0.1,0.1", "norm.error_scale=0.2,0.3,0.4", seeds=3)
    assert sweep.seeds == (1, 2, 3)
    baseline, *points = sweep.rows
    assert baseline.loops == experiment.controllers["PID"]
    assert [tuple(row.values.values()) for row in points] == [
        (mu, scale) for mu in (-0.1, 0.1) for scale in (0.2, 0.3, 0.4)
    ]
    for row in points:
        assert {(e.mu, e.norm.error_scale) for e in row.loops} == {tuple(row.values.values())}
    tasks = sweep.tasks()
    assert len(tasks) == len({task.label for task in tasks.values()}) == 7 * 3
    assert all(task.world.seed == seed for (_, seed), task in tasks.items())


def test_named_joints_alone_are_varied_and_judged(experiment):
    sweep = planned(experiment, "mu=0.2", joints=["arm_joint_2"], seeds=1)
    changed = {each.joint for each in sweep.rows[1].loops if each.mu == 0.2}
    assert changed == {"arm_joint_2"}
    ((_, record), _) = run_batch(sweep.tasks(), 1)
    assert list(record.numbers) == ["arm_joint_2", TOTAL]
    assert record.numbers[TOTAL]["ivc"] == record.numbers["arm_joint_2"]["ivc"]


def test_each_robot_has_its_own_baseline(experiment):
    sweep = planned(experiment, "payload=0,2", "encoder_counts=0,1000,1.5", "mu=0.1", seeds=1)
    robots = [row for row in sweep.rows if row.baseline is None]
    assert len(robots) == 6
    for row in sweep.rows:
        if row.values["encoder_counts"] == 1.5:
            assert "whole number" in row.refusal
            continue
        assert row.world.payload_mass == row.values["payload"]
        counts = row.values["encoder_counts"]
        resolution = 2.0 * np.pi / counts if counts else 0.0
        assert {each.encoder.resolution for each in row.loops} == {resolution}
        if row.baseline is not None:
            against = sweep.rows[row.baseline]
            assert against.world == row.world
            assert against.loops[0].law == "pid"


def test_gains_that_a_loop_refuses_stay_in_the_table_with_the_reason(experiment):
    sweep = planned(experiment, "gains.i=132,9e5", joints=["arm_joint_1"], seeds=1)
    fine, refused = sweep.rows[1:]
    assert not fine.refusal
    assert refused.refusal.startswith("arm_joint_1: ")
    assert "unstable" in refused.refusal
    result = SweepResult(sweep, {})
    assert refused.refusal in result.note(2)
    assert refused.refusal in result.runs_csv()
    assert refused.refusal in result.summary_csv()
    assert [place for place, _ in sweep.tasks()] == [0, 1]


def test_ratios_are_taken_seed_by_seed_before_the_median(experiment):
    sweep = planned(experiment, "mu=0.1", seeds=5)
    values = [(1.0, 10.0, 100.0, 4.0, 5.0), (2.0, 10.0, 50.0, 12.0)]
    records = {
        (place, seed): RunRecord({TOTAL: {IVC.key: ivc}})
        for place, row in enumerate(values)
        for seed, ivc in enumerate(row, 1)
    }
    result = SweepResult(sweep, records)
    assert result.table.quartiles((0,), IVC) == (4.0, 5.0, 10.0)
    assert result.table.quartiles((1,), IVC) == (8.0, 11.0, 21.5)
    assert result.table.ratios((0,), IVC) is None
    assert result.table.ratios((1,), IVC) == (0.875, 1.5, 2.25)
    assert "1 of 5 runs were not made" in result.note(1)

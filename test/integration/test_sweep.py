"""Batches and sweeps: grids as a person means them, every run as on its own, nothing lost."""

import csv
import io
import json
import math
import os
import random
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from harness.studies import children_of, is_alive, wait_until

from hpid_bench.cli.commands import BAD_INPUT, DONE, FAILED, INTERRUPTED
from hpid_bench.experiment.batch import (
    TOTAL,
    Quartiles,
    RunRecord,
    RunTask,
    WorldKeeper,
    run_batch,
    simulated,
)
from hpid_bench.experiment.compare import compute
from hpid_bench.experiment.description import following_loops, load_experiment
from hpid_bench.experiment.in_process import NoProgress, run_without_ros
from hpid_bench.experiment.sweep import Axis, SweepResult, plan_sweep
from hpid_ros.base.errors import SettingError
from hpid_ros.metrics.quantities import INDICES, IVC, PAPER
from hpid_ros.motion import JointTrajectory, TrajectoryPoint
from hpid_ros.simulation.engine import run_in_process
from hpid_ros.simulation.world import World


def seeded(experiment, label, count):
    """Return runs of a controller, by seed."""
    task = RunTask.of(experiment, label)
    return {
        k: replace(task, label=f"seed={k}", world=replace(experiment.world, seed=k))
        for k in range(count)
    }


def test_numbers_are_those_of_the_comparison_to_the_last_bit(experiment_file, tmp_path):
    experiment = load_experiment(experiment_file(duration=0.3))
    bags = {label: tmp_path / label for label in experiment.controllers}
    for label, bag in bags.items():
        run_without_ros(experiment, label, bag, NoProgress())
    for compared in compute(experiment, bags).comparison.runs:
        with WorldKeeper() as keeper:
            found = simulated(RunTask.of(experiment, compared.label), keeper)
        for joint in compared.joints:
            values = {each.key: compared.value(each, joint) for each in INDICES}
            assert values.items() <= found.numbers[joint].items()
        totals = {each.key: compared.value(each) for each in PAPER}
        assert totals.items() <= found.numbers[TOTAL].items()


def trace(world, experiment):
    """Return everything that a controlled run shows of a world."""
    loops = following_loops(experiment.controllers["hPID"], experiment.trajectory)
    seen = []

    def look(sample):
        base = (world.base_pose(), world.base_velocity())
        seen.append((*sample, world.true_positions(), world.true_velocities(), *base))

    run_in_process(world, loops, 200, look)
    return seen


@pytest.mark.parametrize("changes", [{}, {"payload_mass": 2.0}, {"fixed_base": True}], ids=str)
def test_a_reset_world_is_a_fresh_one_whatever_happened_to_it(experiment, changes):
    settings = replace(experiment.world, seed=7, **changes)
    with World(settings) as world:
        fresh = trace(world, experiment)
    chance = random.Random(1)
    with World(replace(settings, seed=3)) as world:
        for _ in range(2):
            world.set_payload(1.3)
            world.apply_wrench("payload", (0.0, 40.0, 400.0), (30.0, 0.0, 0.0), 200_000_000)
            for _ in range(300):
                world.step([chance.uniform(-50.0, 50.0) for _ in settings.joints])
            world.reset(seed=7)
            assert world.time_ns == 0
            assert trace(world, experiment) == fresh


def test_a_world_is_kept_for_another_seed_alone(experiment):
    with WorldKeeper() as keeper:
        world = keeper.at_start(experiment.world)
        assert keeper.at_start(replace(experiment.world, seed=7)) is world
        assert keeper.at_start(replace(experiment.world, payload_mass=1.0)) is not world


def test_records_depend_neither_on_the_processes_nor_on_the_order(experiment):
    """Also where a run fails, which is named, and the others go on."""
    tasks = seeded(experiment, "hPID", 4) | {"PID": RunTask.of(experiment, "PID")}
    of_one_joint = JointTrajectory(("wheel_left_joint",), (TrajectoryPoint(0, (0.0,)),))
    tasks[1] = replace(tasks[1], trajectory=of_one_joint)
    alone = dict(run_batch(tasks, 1))
    assert list(alone) == list(tasks)
    assert [key for key in tasks if alone[key].failure] == [1]
    assert "unknown joint 'wheel_right_joint'" in alone[1].failure
    assert not alone[1].numbers
    assert dict(run_batch(dict(reversed(tasks.items())), 2)) == alone
    assert list(run_batch({}, 2)) == []


def test_leaving_a_batch_early_ends_its_processes_and_is_nothing_to_warn_of(experiment, recwarn):
    outcomes = run_batch(seeded(experiment, "hPID", 50), 2)
    next(outcomes)
    before = workers(os.getpid())
    assert len(before) == 2
    outcomes.close()
    wait_until(lambda: not any(is_alive(each) for each in before))
    assert not recwarn.list


def workers(parent):
    """Return the processes of a batch."""
    with suppress(OSError):  # one has just ended
        found = children_of(parent)
        return [k for k in found if b"LokyProcess" in Path(f"/proc/{k}/cmdline").read_bytes()]
    return []


def blocked_signals(process):
    status = Path(f"/proc/{process}/status").read_text().splitlines()
    (mask,) = [int(line.split()[1], 16) for line in status if line.startswith("SigBlk:")]
    return [number for number in signal.valid_signals() if mask >> (number - 1) & 1]


@pytest.mark.parametrize(("started", "is_warm"), [(1, False), (2, True)], ids=["first", "at work"])
def test_an_interrupt_ends_every_process_and_leaves_what_was_run(
    experiment_file, tmp_path, started, is_warm
):
    folder = tmp_path / "sweep"
    command = [
        sys.executable,
        "-m",
        "hpid_bench.cli.main",
        "sweep",
        experiment_file(duration=20.0),
    ]
    command += ["--vary", "mu=-0.2:0.2:50", "--jobs", "2", "-o", folder]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    wait_until(lambda: len(workers(process.pid)) >= started)
    children = workers(process.pid)
    assert children
    if is_warm:  # they have begun to compute, in one thread each
        wait_until(lambda: all("mujoco" in Path(f"/proc/{k}/maps").read_text() for k in children))
        for each in children:
            assert b"OMP_NUM_THREADS=1\0" in Path(f"/proc/{each}/environ").read_bytes()
            assert signal.SIGINT in blocked_signals(each)  # so that none of them says anything
    os.killpg(process.pid, signal.SIGINT)  # to all, as a terminal does
    out, err = process.communicate(timeout=60.0)
    assert process.returncode == INTERRUPTED
    assert err.splitlines() == [f"what was run: {folder}", "hpid: interrupted"]
    assert out == ""
    wait_until(lambda: not any(is_alive(each) for each in children))
    rows = (folder / "sweep.csv").read_text().splitlines()
    assert json.loads((folder / "sweep.json").read_text())["runs"]["made"] == len(rows) - 1


def test_a_point_that_is_the_baseline_has_ratio_one(experiment_file, tmp_path, hpid):
    path = experiment_file(duration=0.1)
    options = [path, "--vary", "law=pid,hpid", "--vary", "mu=-0.1", "--seeds", 2, "--jobs", 1]
    code, out, _ = hpid("sweep", *options, "-o", tmp_path / "s", "--format", "csv")
    assert code == DONE
    _, same, other = csv.DictReader(io.StringIO(out))
    for quantity in PAPER:
        assert float(same[f"{quantity.key}_ratio"]) == 1.0
    assert float(other["itae_ratio"]) != 1.0


def test_what_is_saved_depends_on_the_sweep_alone(experiment_file, tmp_path, hpid, backwards):
    path = experiment_file(duration=0.1)
    one, other = tmp_path / "one", tmp_path / "other"
    options = [path, "--vary", "mu=-0.2,0.1,0.6", "--seeds", 2, "--jobs", 1]
    code, out, err = hpid("sweep", *options, "-o", one)
    assert code == DONE
    assert err == f"result: {one}\n"
    (refused,) = [line for line in out.splitlines() if " 0.6 " in line]
    assert "mu must lie in [-0.5, 0.5], not 0.6" in refused
    assert out == (one / "table.txt").read_text()
    with backwards:
        code, out, _ = hpid("sweep", *options, "-o", other, "--format", "json")
    assert code == DONE
    assert hpid("sweep", *options, "-o", other)[:2] == (BAD_INPUT, "")
    files = {each.name: each.read_bytes() for each in one.iterdir()}
    tables = {"sweep.csv", "sweep.json", "table.txt"}
    assert set(files) == {"experiment.yaml", "hpid_result.json", *tables}
    assert files == {each.name: each.read_bytes() for each in other.iterdir()}
    saved = json.loads(out)
    assert saved["sha256"] == load_experiment(path).digest
    assert saved["runs"] == {"planned": 6, "made": 6}
    runs = list(csv.DictReader((one / "sweep.csv").open()))
    assert [(run["mu"], run["seed"]) for run in runs] == [
        ("", "1"),
        ("", "2"),
        ("-0.2", "1"),
        ("-0.2", "2"),
        ("0.1", "1"),
        ("0.1", "2"),
        ("0.6", ""),
    ]
    assert len({run["ivc"] for run in runs if run["seed"]}) == 6


def test_a_failed_run_is_told_and_makes_the_exit_code(experiment_file, tmp_path, hpid, losing):
    options = [experiment_file(duration=0.1), "--vary", "mu=0.1", "--seeds", 3, "--jobs", 1]
    with losing("hPID mu=0.1 seed=2", ZeroDivisionError("by zero")):
        code, out, _ = hpid("sweep", *options, "-o", tmp_path / "s")
    assert code == FAILED
    assert "1 of 3 runs failed: ZeroDivisionError: by zero" in out
    assert (tmp_path / "s" / "sweep.csv").read_text().count("ZeroDivisionError: by zero") == 1


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--jobs=0", "--jobs must be at least 1"),
        ("--vary=gains.p=-1", "no point can run"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_folder(
    experiment_file, tmp_path, refused, option, words
):
    options = [experiment_file(), "--vary", "mu=0.1", option, "-o", tmp_path / "s"]
    assert words in refused("sweep", *options)
    assert not (tmp_path / "s").exists()


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
        ("observer.feed_disturbance=true, false", (True, False)),
    ],
)
def test_axes_are_what_a_person_means(text, values):
    assert Axis.parse(text).values == values


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mu", "must be NAME=START:STOP:COUNT"),
        ("mu=small", "'small' is not a number"),
        ("mu=0.1:0.3", "must be START:STOP:COUNT"),
        ("mu=0.1:0.3:1", "for one value write NAME=VALUE"),
        ("mu=0.1:0.3:1e9", "from 2 to 10000"),
        ("mu=0.1:0.1:2", "0.1 is there twice"),
        ("mu=nan", "not finite"),
        ("joint=elbow", "unknown parameter 'joint'"),
        ("law=pdi", "one of hpid, pid"),
        ("observer.feed_disturbance=1", "must be true or false"),
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


def test_an_inertia_of_the_model_is_that_of_the_varied_model(experiment_file):
    decoupled = {"compensation": "decoupling", "gains": {"p": 300.0, "i": 1000.0, "d": 30.0}}
    own = {"arm_joint_1": {"inertia": 0.7}}
    path = experiment_file(compare__hPID={**decoupled, "inertia": 0.0, "joints": own})
    _, light, heavy = planned(load_experiment(path), "model.mass_scale=1,2", seeds=1).rows
    pairs = [(a.inertia, b.inertia) for a, b in zip(light.loops, heavy.loops, strict=True)]
    assert (0.7, 0.7) in pairs
    assert sum(a < b for a, b in pairs) == len(pairs) - 1


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
        assert {each.encoder.encoder_resolution for each in row.loops} == {resolution}
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


def test_a_baseline_of_zero_with_one_seed_leaves_the_others_their_median():
    assert Quartiles.of([math.inf, 0.5, 0.6]) == (0.55, 0.6, math.inf)


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

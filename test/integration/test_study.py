"""Studies: every seed another run, kept as it ends, and claims as they were made."""

import csv
import importlib
import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml
from harness.engines import needs_bullet, shipped
from harness.places import ROOT
from harness.studies import ARM, saved, study

from hpid_bench.cli.commands import DONE, FAILED, INTERRUPTED
from hpid_bench.cli.commands.batches import _shipped_files
from hpid_bench.cli.main import main
from hpid_bench.experiment.batch import (
    LAST_ERROR,
    TOTAL,
    RunRecord,
    RunTask,
    WorldKeeper,
    simulate_task,
    simulated,
)
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.study_plan import (
    JournalEntry,
    RunKey,
    default_files,
    is_robot_installed,
    plan_study,
    read_journal,
)
from hpid_ros.base.errors import SettingError
from hpid_ros.base.resources import share_folder
from hpid_ros.metrics.quantities import INDICES

EXPERIMENTS = share_folder() / "config" / "experiments"


def contents(folder):
    return {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()}


def test_only_judged_joints_count_and_ratios_are_taken_seed_by_seed(studied, tmp_path):
    files, folder = studied
    rows = list(csv.DictReader((folder / "runs.csv").open()))

    def of(controller, joint="all"):
        own = [each for each in rows if each["experiment"] == "calm" and each["joint"] == joint]
        return np.array([float(e["ivc"]) for e in own if e["controller"] == controller])

    assert [row["joint"] for row in rows[:4]] == [*ARM, "all"]
    assert of("PID") == pytest.approx(sum(of("PID", joint) for joint in ARM), rel=1e-12)
    ratios = saved(folder)["experiments"]["calm"]["controllers"]["hPID"]["ratios"]
    assert ratios["ivc"]["median"] == np.median(of("hPID") / of("PID"))
    assert study(files, tmp_path / "one", "--joint", "arm_joint_2", seeds=1) == DONE
    experiments = saved(tmp_path / "one")["experiments"].values()
    assert {each["joints"][0] for each in experiments} == {"arm_joint_2"}


def test_the_last_second_is_the_last_second(studied):
    experiment = load_experiment(studied[0][0])
    task = replace(RunTask.of(experiment, "PID"), periods=1500, joints=("arm_joint_1",))
    with WorldKeeper() as keeper:
        numbers = simulated(task, keeper).numbers
        run = simulate_task(task, keeper)
    (series,) = [each for each in run.joints if each.joint == "arm_joint_1"]
    errors = np.abs(series.error)
    for joint in ("arm_joint_1", TOTAL):
        assert numbers[joint][LAST_ERROR.key] == errors[-1001:].max() < errors.max()


@pytest.mark.parametrize("path", shipped(sorted(EXPERIMENTS.glob("*.yaml"))))
def test_every_experiment_runs_and_no_two_seeds_are_alike(path):
    (entry,) = plan_study([path], seeds=3).entries
    task = RunTask.of(entry.experiment, entry.baseline)
    with WorldKeeper() as keeper:
        found = [
            simulated(
                replace(
                    task,
                    world=replace(task.world, engine="mujoco", seed=seed),
                    periods=200,
                    joints=entry.joints,
                ),
                keeper,
            )
            for seed in range(3)
        ]
    for quantity in INDICES:
        assert len({each.value(quantity) for each in found}) == 3, quantity.key


def test_the_default_study_is_all_experiments_but_the_bricks_the_paper_first():
    names = [path.stem for path in default_files()]
    assert names[0] == "paper"
    assert "bricks" not in names
    assert {"step", "smooth", "sine", "payload", "wrench", "noise", "motors"} <= set(names)


def test_what_is_saved_depends_on_the_plan_alone(studied, tmp_path, capsys, backwards):
    files, one = studied
    assert study(files, one, "--resume") == DONE
    out, err = capsys.readouterr()
    assert out == (one / "tables.txt").read_text()
    assert err == f"result: {one}\n"
    with backwards:
        assert study(files, tmp_path / "other", "--table", "docs") == DONE
    assert capsys.readouterr().out == (one / "tables.md").read_text()
    assert contents(tmp_path / "other") == contents(one)
    names = ("runs.csv", "runs.jsonl", "study.json", "tables.md", "tables.txt")
    assert set(contents(one)) == {*names, "hpid_result.json"}
    for file in files:
        experiment = load_experiment(file)
        copy = load_experiment(one / "experiments" / f"{experiment.name}.yaml")
        assert copy.digest == experiment.digest


def test_a_study_is_carried_on_where_it_was_left(studied, study_runs):
    files, folder = studied
    whole = contents(folder)
    journal = folder / "runs.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    assert len(lines) == 8
    journal.write_text("".join(lines[:3] + lines[5:]) + lines[3][:100])  # cut off while writing
    assert study(files, folder, "--resume") == DONE
    assert len(study_runs) == 2
    assert contents(folder) == whole
    study_runs.clear()
    assert study(files, folder, "--resume", seeds=3) == DONE
    assert len(study_runs) == 4
    study_runs.clear()  # runs beyond the plan stay in the journal
    assert study(files[:1], folder, "--resume", seeds=1) == DONE
    assert saved(folder)["runs"] == {"planned": 2, "made": 2, "failed": 0}
    assert study(files, folder, "--resume", seeds=3) == DONE
    assert not study_runs


def test_only_what_still_holds_is_kept_and_the_rest_until_it_is_replaced(
    studied, study_runs, losing
):
    files, folder = studied
    before = (folder / "runs.jsonl").read_text()
    with losing("calm PID seed=1", KeyboardInterrupt):  # an option was forgotten, and that noticed
        assert study(files, folder, "--resume", "--joint", "arm_joint_2") == INTERRUPTED
    assert sorted((folder / "runs.jsonl").read_text().splitlines()) == sorted(before.splitlines())
    document = yaml.safe_load(files[0].read_text())
    document["compare"]["hPID"]["mu"] = 0.1
    files[0].write_text(yaml.safe_dump(document))
    assert study(files, folder, "--resume") == DONE
    assert {label.split()[0] for label in study_runs} == {"calm"}
    study_runs.clear()
    assert study(files, folder, "--resume", "--joint", "arm_joint_2") == DONE
    assert len(study_runs) == 8


VALUES = [None, [], {}, 1, "x", True, float("nan"), float("inf"), 10**400, [[1]], {"": [1]}]


def test_a_journal_holds_what_was_written_or_is_refused(tmp_path):
    journal = tmp_path / "runs.jsonl"
    keys = [RunKey("e", "mujoco", "PID", seed) for seed in (1, 2)]
    entries = [JournalEntry(key, "0", RunRecord({"": {"ivc": 1.5}})) for key in keys]
    first, last = (each.line() for each in entries)
    journal.write_text(f"{first}\n{last}\n")
    assert read_journal(journal) == entries
    good = json.loads(first)
    changed = [good | {"more": 1}, *VALUES]
    for key in good:
        changed += [good | {key: value} for value in VALUES if value != good[key]]
        changed.append({name: value for name, value in good.items() if name != key})
    changed += [good | {"numbers": {"": {"ivc": value}}} for value in [*VALUES, "1.5", 1.6]]
    for line in [*map(json.dumps, changed), "\ufffd", "[" * 100_000]:
        journal.write_text(f"{line}\n{last}\n")
        with pytest.raises(SettingError, match="line 1 is damaged"):
            read_journal(journal)


def test_what_cannot_be_carried_on_is_one_line(studied, refused):
    files, folder = studied
    journal = folder / "runs.jsonl"
    first, *_ = read_journal(journal)
    numbers = {joint: {**each, "ivc": 1.0} for joint, each in first.record.numbers.items()}
    command = ("study", *files, "--seeds", 2, "--resume", "-o", folder)
    with journal.open("a") as file:
        file.write(replace(first, record=RunRecord(numbers)).line() + "\n")
    line = refused(*command)
    assert "calm PID seed=1 in mujoco is there with other numbers than before" in line
    journal.write_bytes(b"\xff\xfe\n" + journal.read_bytes())
    before = journal.read_bytes()
    assert f"{journal}: line 1 is damaged" in refused(*command)
    assert journal.read_bytes() == before


@needs_bullet
def test_a_study_carried_on_in_another_engine_keeps_the_runs_of_the_first(
    studied, tmp_path, study_runs
):
    files, folder = studied
    assert study(files, tmp_path / "alone", "--engine", "pybullet", seeds=1) == DONE
    study_runs.clear()
    assert study(files, folder, "--engine", "pybullet", "--resume", seeds=1) == DONE
    assert len(study_runs) == 4
    for name in ("runs.csv", "study.json", "tables.txt"):
        assert (folder / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    study_runs.clear()
    assert study(files, folder, "--resume") == DONE
    assert not study_runs


def test_a_failed_run_is_named_and_made_again_when_carried_on(studied, tmp_path, capsys, losing):
    file = studied[0][0]
    with losing("calm hPID seed=2", ZeroDivisionError("by zero")):
        assert study([file], tmp_path / "f") == FAILED
    assert "1 of 2 runs failed: ZeroDivisionError: by zero" in capsys.readouterr().out
    assert saved(tmp_path / "f")["runs"] == {"planned": 4, "made": 4, "failed": 1}
    assert study([file], tmp_path / "f", "--resume") == DONE
    assert saved(tmp_path / "f")["runs"]["failed"] == 0


def test_an_interrupt_leaves_what_was_run(studied, tmp_path, capsys, losing):
    with losing("calm hPID seed=2", KeyboardInterrupt):
        assert study(studied[0], tmp_path / "i") == INTERRUPTED
    assert f"what was run: {tmp_path / 'i'}" in capsys.readouterr().err
    assert saved(tmp_path / "i")["runs"]["made"] == 3
    assert "were not made" in (tmp_path / "i" / "tables.txt").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--seeds", "0"], "seeds must be at least 1"),
        (["--joint", "arm_joint_9"], "unknown joint 'arm_joint_9'"),
        (["--joint", "arm_joint_1", "--joint", "arm_joint_9"], "unknown joint 'arm_joint_9'"),
        (["--resume"], "--resume needs the study's folder"),
        (["a.yaml"], "two experiments are called 'calm'"),
        (["--resume", "-o", "empty"], "is not a study that could be carried on"),
        (["--resume", "-o", "foreign"], "has no hpid_result.json"),
    ],
)
def test_bad_input_is_one_line(studied, tmp_path, monkeypatch, refused, options, words):
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "foreign"):
        (tmp_path / name).mkdir()
    # A journal that somebody else wrote, or an earlier version: not ours to write over.
    (tmp_path / "foreign" / "runs.jsonl").write_text("mine")
    assert words in refused("study", "a.yaml", *options)
    assert not (tmp_path / "results").exists()
    assert (tmp_path / "foreign" / "runs.jsonl").read_text() == "mine"


def test_claims_are_of_the_homogeneous_law_with_the_same_gains(experiment_file, tmp_path):
    compare = {
        "PID": {"law": "pid"},
        "hPID": {"mu": -0.1},
        "other gains": {"mu": -0.1, "joints": {"arm_joint_1": {"gains": {"p": 50.0}}}},
        "linear": {"law": "pid", "velocity_filter_time_constant": 0.01},
    }
    path = experiment_file(
        duration=0.05,
        compare=compare,
        judge={"joints": ARM[:2]},
        controllers__joints__arm_joint_1__inertia=0.0,
    )
    retuned = path.with_name("retuned.yaml")
    retuned.write_text(
        f"extends: {path.name}\nname: retuned\ncompare: {{hPID: {{gains: {{p: 50.0}}}}}}\n"
    )
    assert study([path, retuned], tmp_path / "s", seeds=1) == DONE
    found = saved(tmp_path / "s")
    assert list(found["claims"]) == ["hPID"]
    assert set(found["claims"]["hPID"][0]["figures"]) == {"short"}
    controllers = found["experiments"]["short"]["controllers"]
    assert list(controllers) == list(compare)
    for each in controllers.values():  # loops that are not certified are named
        assert not each["is_certified"]
        assert each["refusals"] == {"arm_joint_1": "its inertia is not known"}


def test_tables_for_the_docs_are_tables(studied):
    text = (studied[1] / "tables.md").read_text()
    blocks = re.findall(r"<!-- begin (.*?) -->\n(.*?)<!-- end \1 -->\n", text, re.S)
    assert [name for name, _ in blocks] == [
        "claims hPID",
        "loops",
        "totals calm",
        "joints calm",
        "totals noisy",
        "joints noisy",
    ]
    for _, body in blocks:
        rows = [line for line in body.splitlines() if line.startswith("|")]
        assert len(rows) > 2
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) == 1


def test_a_page_is_written_only_between_its_marks(studied, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    draw_results = importlib.import_module("draw_results")
    files, folder = studied
    options = ["--law", "pid", "--evaluations", "10", "--seeds", "1", "-j", "1"]
    assert main(["tune", str(files[0]), *options, "-o", str(tmp_path / "t")]) == DONE
    page = tmp_path / "docs" / "results.md"
    page.parent.mkdir()
    arguments = ["draw_results.py", str(folder), "--search", str(tmp_path / "t")]
    monkeypatch.setattr("sys.argv", [*arguments, "--page", str(page)])
    assert draw_results.main() == 0
    made = page.read_text()
    assert "<!-- begin searches -->" in made
    assert "| calm | mujoco | best PID |" in made
    figures = {"results_ratios.png", "results_trade_off_calm_mujoco.png"}
    assert {each.name for each in (page.parent / "figures").iterdir()} == figures
    assert set(re.findall(r"\]\((.*?)\)", made)) == {f"figures/{name}" for name in figures}
    words = "# Mine\n\nwords\n\n{}\nmore\n\n<!-- begin other -->\nstays\n<!-- end other -->\n"
    page.write_text(words.format("<!-- begin loops -->\nold\n<!-- end loops -->\n"))
    monkeypatch.setattr(draw_results, "draw", lambda *_: [])
    assert draw_results.main() == 0
    tables = (folder / "tables.md").read_text()
    (loops,) = re.findall(r"<!-- begin loops -->\n.*?<!-- end loops -->\n", tables, re.S)
    assert page.read_text() == words.format(loops)


def test_robots_that_are_not_installed_are_named_and_left_out(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pybullet_data", None)
    names = [file.stem for file in _shipped_files()]
    assert "paper" in names
    assert not {"iiwa", "panda"} & set(names)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("iiwa, panda")
    assert all(is_robot_installed(EXPERIMENTS / f"{name}.yaml") for name in names)

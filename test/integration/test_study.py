"""Studies: the numbers of the comparison, every seed another run, and claims as they were made."""

import csv
import importlib
import json
import re
from dataclasses import replace

import pytest
import yaml
from harness.engines import shipped
from harness.places import ROOT
from harness.studies import ARM, saved, study

from hpid_ros.base.errors import SettingError
from hpid_ros.base.files import share_folder
from hpid_ros.cli.commands import BAD_INPUT, DONE, FAILED
from hpid_ros.cli.main import main
from hpid_ros.experiment import batch
from hpid_ros.experiment.batch import (
    LAST_ERROR,
    RunRecord,
    RunTask,
    WorldKeeper,
    simulate,
    simulated,
)
from hpid_ros.experiment.compare import compute
from hpid_ros.experiment.description import load_experiment
from hpid_ros.experiment.in_process import NoProgress, run_without_ros
from hpid_ros.experiment.study_plan import (
    JournalEntry,
    RunKey,
    default_files,
    plan_study,
    read_journal,
)
from hpid_ros.metrics.quantities import INDICES

EXPERIMENTS = share_folder() / "config" / "experiments"


def test_the_numbers_are_those_of_the_comparison(study_files, tmp_path):
    experiment = load_experiment(study_files[1])
    bags = {label: tmp_path / label for label in experiment.controllers}
    for label, bag in bags.items():
        run_without_ros(experiment, label, bag, NoProgress())
    compared = compute(experiment, bags).comparison
    assert study(study_files[1:], tmp_path / "s", seeds=1) == DONE
    rows = list(csv.DictReader((tmp_path / "s" / "runs.csv").open()))
    for run in compared.runs:
        for joint in (None, *run.joints):
            (row,) = [
                each
                for each in rows
                if each["controller"] == run.label and each["joint"] == (joint or "all")
            ]
            for quantity in INDICES:
                assert float(row[quantity.key]) == run.value(quantity, joint)
    both = {run.label: run for run in compared.runs}
    ratios = saved(tmp_path / "s")["experiments"]["noisy"]["controllers"]["hPID"]["ratios"]
    for quantity in INDICES:
        wanted = both["hPID"].value(quantity) / both["PID"].value(quantity)
        assert ratios[quantity.key]["median"] == wanted


def test_only_judged_joints_count(study_files, tmp_path):
    assert study(study_files, tmp_path / "s", seeds=1) == DONE
    rows = list(csv.DictReader((tmp_path / "s" / "runs.csv").open()))
    own = [row for row in rows if row["experiment"] == "calm" and row["controller"] == "PID"]
    assert [row["joint"] for row in own] == [*ARM, "all"]
    total = sum(float(row["ivc"]) for row in own[:-1])
    assert float(own[-1]["ivc"]) == pytest.approx(total, rel=1e-12)
    assert study(study_files, tmp_path / "one", "--joint", "arm_joint_2", seeds=1) == DONE
    assert {each["joints"][0] for each in saved(tmp_path / "one")["experiments"].values()} == {
        "arm_joint_2"
    }


def test_the_last_second_is_the_last_second(study_files):
    experiment = load_experiment(study_files[0])
    task = replace(RunTask.of(experiment, "PID"), periods=1500, joints=("arm_joint_1",))
    with WorldKeeper() as keeper:
        found = simulated(task, keeper)
        run = simulate(task, keeper)
    (series,) = [each for each in run.joints if each.joint == "arm_joint_1"]
    last = max(abs(error) for error in series.error[-1001:].tolist())
    assert found.value(LAST_ERROR) == found.numbers["arm_joint_1"][LAST_ERROR.key] == last
    assert last < max(abs(error) for error in series.error.tolist())


@pytest.mark.parametrize("path", shipped(sorted(EXPERIMENTS.glob("*.yaml"))))
def test_every_experiment_runs_and_no_two_seeds_are_alike(path):
    (entry,) = plan_study([path], seeds=3).entries
    task = RunTask.of(entry.experiment, entry.baseline)
    world = replace(task.world, engine="mujoco")
    baseline = replace(task, world=world, periods=200, joints=entry.joints)
    with WorldKeeper() as keeper:
        found = [
            simulated(replace(baseline, world=replace(baseline.world, seed=k)), keeper)
            for k in range(3)
        ]
    for quantity in INDICES:
        assert len({each.value(quantity) for each in found}) == 3, quantity.key


VARIANTS = ["step", "smooth", "sine", "payload", "wrench", "noise", "motors"]


def test_the_default_study_is_all_experiments_but_the_bricks_the_paper_first():
    names = [path.stem for path in default_files()]
    assert names[0] == "paper"
    assert "bricks" not in names
    assert set(VARIANTS) <= set(names)


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_is_another_experiment_but_for_one_thing(name):
    path = EXPERIMENTS / f"{name}.yaml"
    written = yaml.safe_load(path.read_text())
    assert written["name"] == name
    variant, base = load_experiment(path), load_experiment(EXPERIMENTS / written["extends"])
    changed = {"reference", "disturbances", "sensors", "actuators"} & set(written)
    assert len(changed) == 1
    assert variant.judged == base.judged
    assert variant.duration == base.duration
    for before, after in zip(
        *(next(iter(each.controllers.values())) for each in (base, variant)), strict=True
    ):
        assert after.gains == before.gains


def test_what_is_saved_depends_on_the_plan_alone(study_files, tmp_path, capsys):
    assert study(study_files, tmp_path / "one", jobs=1) == DONE
    out, err = capsys.readouterr()
    assert out == (tmp_path / "one" / "tables.txt").read_text()
    assert err == f"result: {tmp_path / 'one'}\n"
    totals = csv.DictReader((tmp_path / "one" / "runs.csv").open())
    assert len({row["ivc"] for row in totals if row["joint"] == "all"}) == 8  # every seed counts
    assert study(study_files, tmp_path / "many", "--table", "docs", jobs=2) == DONE
    assert capsys.readouterr().out == (tmp_path / "one" / "tables.md").read_text()
    names = {"runs.csv", "runs.jsonl", "study.json", "tables.md", "tables.txt", "experiments"}
    names.add("hpid_result.json")
    assert {each.name for each in (tmp_path / "one").iterdir()} == names
    for name in sorted(names - {"experiments"}):
        one, many = (tmp_path / folder / name for folder in ("one", "many"))
        assert one.read_bytes() == many.read_bytes(), name
    for entry in study_files:
        experiment = load_experiment(entry)
        copy = load_experiment(tmp_path / "one" / "experiments" / f"{experiment.name}.yaml")
        assert copy.digest == experiment.digest


def test_a_study_is_carried_on_where_it_was_left(study_files, tmp_path, study_runs):
    folder = tmp_path / "s"
    assert study(study_files, folder) == DONE
    whole = {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()}
    assert len(study_runs) == 8
    journal = folder / "runs.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join(lines[:3] + lines[5:]) + lines[3][:100])  # cut off while writing
    study_runs.clear()
    assert study(study_files, folder, "--resume") == DONE
    assert len(study_runs) == 2
    assert {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()} == whole
    study_runs.clear()
    assert study(study_files, folder, "--resume", seeds=3) == DONE
    assert len(study_runs) == 4


def test_only_what_still_holds_is_kept(study_files, tmp_path, study_runs):
    folder = tmp_path / "s"
    assert study(study_files, folder) == DONE
    study_runs.clear()
    document = yaml.safe_load(study_files[0].read_text())
    document["compare"]["hPID"]["mu"] = 0.1
    study_files[0].write_text(yaml.safe_dump(document))
    assert study(study_files, folder, "--resume") == DONE
    assert {label.split()[0] for label in study_runs} == {"calm"}
    study_runs.clear()
    assert study(study_files, folder, "--resume", "--joint", "arm_joint_2") == DONE
    assert len(study_runs) == 8


def of_one_run(tmp_path):
    """Write a journal of two runs, and return it with the first run's entries."""
    journal = tmp_path / "runs.jsonl"
    numbers = {"": {"ivc": 1.5, "itae": 2.0}, "a": {"ivc": 1.5}}
    keys = [RunKey("e", "mujoco", "PID", seed) for seed in (1, 2)]
    records = [JournalEntry(key, "0", RunRecord(numbers)) for key in keys]
    journal.write_text("".join(each.line() + "\n" for each in records))
    assert read_journal(journal) == records
    return journal, json.loads(records[0].line())


VALUES = [None, [], {}, 1, "x", True, float("nan"), float("inf"), 10**400, [[1]], {"": [1]}]


@pytest.mark.parametrize("key", ["experiment", "seed", "sha256", "numbers", "failure", "crc32"])
def test_a_journal_holds_what_was_written_or_is_refused(tmp_path, key):
    journal, first = of_one_run(tmp_path)
    last = journal.read_text().splitlines()[1]
    changed = [first | {key: value} for value in VALUES if value != first[key]]
    changed += [{k: v for k, v in first.items() if k != key}, first | {"more": 1}]
    if key == "numbers":
        changed += [first | {key: {"": {"ivc": value}}} for value in [*VALUES, "1.5", 1.6]]
    for each in map(json.dumps, changed):
        journal.write_text(f"{each}\n{last}\n")
        with pytest.raises(SettingError, match="line 1 is damaged"):
            read_journal(journal)


@pytest.mark.parametrize("damage", [b"\xff\xfe", b"[" * 100_000], ids=range(2))
def test_what_is_no_journal_is_one_line(study_files, tmp_path, capsys, damage):
    assert study(study_files[:1], tmp_path / "s", seeds=1) == DONE
    journal = tmp_path / "s" / "runs.jsonl"
    journal.write_bytes(damage + b"\n" + journal.read_bytes())
    before = journal.read_bytes()
    capsys.readouterr()
    for option in (("--resume",), ("--merge", tmp_path / "s", "-o", tmp_path / "whole")):
        assert study(study_files[:1], tmp_path / "s", *option, seeds=1) == BAD_INPUT
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"hpid: {journal}: line 1 is damaged")
    assert journal.read_bytes() == before
    assert not (tmp_path / "whole").exists()


def test_numbers_that_contradict_each_other_are_not_merged(study_files, tmp_path, capsys):
    for name in "ab":
        assert study(study_files[:1], tmp_path / name, seeds=1) == DONE
    journal = tmp_path / "b" / "runs.jsonl"
    first, *others = read_journal(journal)
    numbers = {joint: dict(each, ivc=1.0) for joint, each in first.record.numbers.items()}
    records = [replace(first, record=RunRecord(numbers)), *others]
    journal.write_text("".join(each.line() + "\n" for each in records))
    parts = ("--merge", tmp_path / "a", "--merge", tmp_path / "b")
    assert study(study_files[:1], tmp_path / "c", *parts, seeds=1) == BAD_INPUT
    assert "calm PID seed=1 in " in (line := capsys.readouterr().err)
    assert "is there with other numbers than before" in line


def test_runs_beyond_the_plan_stay_in_the_journal(study_files, tmp_path, study_runs):
    assert study(study_files, tmp_path / "s", seeds=3) == DONE
    assert study(study_files[:1], tmp_path / "s", "--resume", seeds=1) == DONE
    assert saved(tmp_path / "s")["runs"] == {"planned": 2, "made": 2, "failed": 0}
    study_runs.clear()
    assert study(study_files, tmp_path / "s", "--resume", seeds=3) == DONE
    assert not study_runs


def test_a_failed_run_is_named_and_made_again_when_carried_on(
    study_files, tmp_path, capsys, monkeypatch
):
    def fragile(task, keeper):
        if task.label == "calm hPID seed=2":
            raise ZeroDivisionError("by zero")
        return simulated(task, keeper)

    with monkeypatch.context() as patched:
        patched.setattr(batch, "simulated", fragile)
        assert study(study_files[:1], tmp_path / "s") == FAILED
    assert "1 of 2 runs failed: ZeroDivisionError: by zero" in capsys.readouterr().out
    assert saved(tmp_path / "s")["runs"] == {"planned": 4, "made": 4, "failed": 1}
    assert study(study_files[:1], tmp_path / "s", "--resume") == DONE
    assert saved(tmp_path / "s")["runs"]["failed"] == 0


def test_an_interrupt_leaves_what_was_run(study_files, tmp_path, capsys, monkeypatch):
    def interrupted(task, keeper):
        if task.label == "calm hPID seed=2":
            raise KeyboardInterrupt
        return simulated(task, keeper)

    monkeypatch.setattr(batch, "simulated", interrupted)
    assert study(study_files, tmp_path / "s") == 130
    assert f"what was run: {tmp_path / 's'}" in capsys.readouterr().err
    assert saved(tmp_path / "s")["runs"]["made"] == 3
    assert "were not made" in (tmp_path / "s" / "tables.txt").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--seeds", "0"], "seeds must be at least 1"),
        (["--jobs", "0"], "--jobs must be at least 1"),
        (["--joint", "arm_joint_9"], "unknown joint 'arm_joint_9'"),
        (["--resume"], "--resume needs the study's folder"),
        (["nowhere.yaml"], "cannot read nowhere.yaml"),
    ],
)
def test_bad_input_is_one_line(study_files, tmp_path, monkeypatch, capsys, options, words):
    monkeypatch.chdir(tmp_path)
    assert main(["study", str(study_files[0]), *options]) == BAD_INPUT
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "results").exists()


def test_nothing_is_overwritten_and_names_are_unlike(study_files, tmp_path, capsys):
    assert study([study_files[0], study_files[0]], tmp_path / "s") == BAD_INPUT
    assert "two experiments are called 'calm'" in capsys.readouterr().err
    (tmp_path / "s").mkdir()
    assert study(study_files[:1], tmp_path / "s", "--resume") == BAD_INPUT
    # A journal that somebody else wrote, or an earlier version: not ours to write over.
    (tmp_path / "s" / "runs.jsonl").write_text("mine")
    capsys.readouterr()
    assert study(study_files[:1], tmp_path / "s", "--resume") == BAD_INPUT
    assert "has no hpid_result.json" in capsys.readouterr().err
    assert (tmp_path / "s" / "runs.jsonl").read_text() == "mine"


def test_claims_are_of_the_homogeneous_law_with_the_same_gains(experiment_file, tmp_path):
    compare = {
        "PID": {"law": "pid"},
        "hPID": {"mu": -0.1},
        "other gains": {"mu": -0.1, "joints": {"arm_joint_1": {"gains": {"p": 50.0}}}},
        "linear": {"law": "pid", "velocity_filter_time_constant": 0.01},
    }
    path = experiment_file(duration=0.05, compare=compare, judge={"joints": ARM})
    assert study([path], tmp_path / "s", seeds=1) == DONE
    found = saved(tmp_path / "s")
    assert list(found["claims"]) == ["hPID"]
    assert list(found["experiments"]["short"]["controllers"]) == list(compare)


def test_loops_that_are_not_certified_are_named(experiment_file, tmp_path, monkeypatch):
    path = experiment_file(
        duration=0.05,
        judge={"joints": ARM[:2]},
        controllers__joints__arm_joint_1__inertia=0.0,
    )
    assert study([path], tmp_path / "s", seeds=1) == DONE
    controllers = saved(tmp_path / "s")["experiments"]["short"]["controllers"]
    for each in controllers.values():
        assert not each["is_certified"]
        assert each["refusals"] == {"arm_joint_1": "its inertia is not known"}


def test_tables_for_the_docs_are_tables(study_files, tmp_path):
    assert study(study_files, tmp_path / "s", seeds=1) == DONE
    text = (tmp_path / "s" / "tables.md").read_text()
    blocks = re.findall(r"<!-- begin (.*?) -->\n(.*?)<!-- end \1 -->\n", text, re.S)
    keys = [name for name, _ in blocks]
    assert keys == [
        *("claims hPID", "loops", "totals calm", "joints calm", "totals noisy", "joints noisy")
    ]
    for _, body in blocks:
        rows = [line for line in body.splitlines() if line.startswith("|")]
        assert len(rows) > 2
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) == 1


def test_a_page_is_written_only_between_its_marks(study_files, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    draw_results = importlib.import_module("draw_results")
    assert study(study_files, tmp_path / "s", seeds=1) == DONE
    options = ["--law", "pid", "--evaluations", "10", "--seeds", "1", "-j", "1"]
    assert main(["tune", str(study_files[0]), *options, "-o", str(tmp_path / "t")]) == DONE
    page = tmp_path / "docs" / "results.md"
    page.parent.mkdir()
    words = "# Mine\n\nwords\n\n{}\nmore\n\n<!-- begin other -->\nstays\n<!-- end other -->\n"
    page.write_text(words.format("<!-- begin loops -->\nold\n<!-- end loops -->\n"))
    arguments = ["draw_results.py", str(tmp_path / "s"), "--search", str(tmp_path / "t")]
    monkeypatch.setattr("sys.argv", [*arguments, "--page", str(page)])
    assert draw_results.main() == 0
    tables = (tmp_path / "s" / "tables.md").read_text()
    (loops,) = re.findall(r"<!-- begin loops -->\n.*?<!-- end loops -->\n", tables, re.S)
    assert page.read_text() == words.format(loops)
    figures = {each.name for each in (page.parent / "figures").iterdir()}
    engine = json.loads((tmp_path / "t" / "tune.json").read_text())["engine"]
    assert figures == {"results_ratios.png", f"results_trade_off_calm_{engine}.png"}
    page.unlink()
    assert draw_results.main() == 0
    made = page.read_text()
    assert "<!-- begin searches -->" in made
    assert f"| calm | {engine} | best PID |" in made
    for name in re.findall(r"\]\((.*?)\)", made):
        assert (page.parent / name).is_file()

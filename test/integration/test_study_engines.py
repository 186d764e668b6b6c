"""Studies of both engines, of one that is not there, and of robots that are not."""

import csv
import sys

import pytest
from harness.engines import needs_bullet
from harness.studies import saved, study

from hpid_ros.base.files import share_folder
from hpid_ros.cli.commands import BAD_INPUT, DONE
from hpid_ros.experiment.study_plan import is_robot_installed
from hpid_ros.metrics.quantities import INDICES

EXPERIMENTS = share_folder() / "config" / "experiments"


def runs_of(folder):
    """Return the numbers of every run and joint in runs.csv, by all that names it."""
    names = ("experiment", "engine", "controller", "seed", "joint")
    with (folder / "runs.csv").open() as file:
        return {tuple(row.pop(name) for name in names): row for row in csv.DictReader(file)}


@needs_bullet
def test_both_engines_give_what_each_gives_alone_and_their_distance(study_files, tmp_path, capsys):
    both = tmp_path / "both"
    assert study(study_files, both, "--engine", "both") == DONE
    printed = capsys.readouterr().out
    assert "How far MuJoCo's totals lie from PyBullet's" in printed
    alone = {}
    for engine in ("pybullet", "mujoco"):
        assert study(study_files, tmp_path / engine, "--engine", engine) == DONE
        alone |= runs_of(tmp_path / engine)
        assert not (tmp_path / engine / "engines.csv").exists()
        assert "engines" not in saved(tmp_path / engine)
    runs = runs_of(both)
    assert runs == alone
    totals = {key: row for key, row in runs.items() if key[-1] == "all"}
    with (both / "engines.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = set()
    for row in rows:
        name = (row["experiment"], row["controller"], row["seed"])
        bullet, mujoco = (
            totals[(name[0], engine, *name[1:], "all")][row["quantity"]]
            for engine in ("pybullet", "mujoco")
        )
        assert (row["pybullet"], row["mujoco"]) == (bullet, mujoco)
        assert float(row["distance"]) == float(mujoco) / float(bullet) - 1.0
        found.add((*name, row["quantity"]))
    assert found >= {
        (experiment, controller, seed, each.key)
        for experiment, _, controller, seed, _ in totals
        for each in INDICES
    }
    assert any(float(row["distance"]) for row in rows)
    document = saved(both)
    assert set(document["experiments"]) == {
        f"{name} ({engine})" for name in ("calm", "noisy") for engine in ("pybullet", "mujoco")
    }
    (ratio,) = [
        each["ratios"]["ivc"]["median"]
        for name, entry in document["experiments"].items()
        for label, each in entry["controllers"].items()
        if (name, label) == ("noisy (mujoco)", "hPID")
    ]
    of_engines = document["engines"]["noisy"]["hPID"]["ivc"]
    assert of_engines["ratios"]["mujoco"] == pytest.approx(ratio, rel=1e-12)
    # A claim holds only if it does in both.
    assert set(document["claims"]["hPID"][0]["figures"]) == set(document["experiments"])
    assert {each.name for each in (both / "experiments").iterdir()} == {"calm.yaml", "noisy.yaml"}


@needs_bullet
def test_a_study_of_both_engines_is_carried_on_where_it_was_left(
    study_files, tmp_path, study_runs
):
    folder = tmp_path / "s"
    assert study(study_files, folder, "--engine", "both") == DONE
    whole = {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()}
    assert len(study_runs) == 16
    assert study(study_files, tmp_path / "m", "--engine", "mujoco") == DONE
    study_runs.clear()  # and the other engine can be added to a study of one
    assert study(study_files, tmp_path / "m", "--engine", "both", "--resume") == DONE
    assert len([label for label in study_runs if "(pybullet)" in label]) == len(study_runs) == 8
    lines = (folder / "runs.jsonl").read_text().splitlines(keepends=True)
    (folder / "runs.jsonl").write_text("".join(lines[:5] + lines[8:]) + lines[6][:99])
    study_runs.clear()
    assert study(study_files, folder, "--engine", "both", "--resume") == DONE
    assert len(study_runs) == 3
    assert {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()} == whole


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_an_engine_that_is_not_installed_is_one_line_before_anything_runs(
    study_files, tmp_path, monkeypatch, capsys, engine
):
    monkeypatch.setitem(sys.modules, engine, None)  # as if it were not
    missing = "is not installed: pip install"
    for wanted, words in ((engine, missing), ("both", missing), ("bullet", "unknown engine")):
        assert study(study_files, tmp_path / "s", "--engine", wanted) == BAD_INPUT
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
        assert not (tmp_path / "s").exists()


def test_robots_that_are_not_installed_are_named_and_left_out(monkeypatch, capsys):
    from hpid_ros.cli.commands.study import _shipped_files

    monkeypatch.setitem(sys.modules, "pybullet_data", None)
    names = [file.stem for file in _shipped_files()]
    assert "paper" in names
    assert not {"iiwa", "panda"} & set(names)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("iiwa, panda")
    assert all(is_robot_installed(EXPERIMENTS / f"{name}.yaml") for name in names)

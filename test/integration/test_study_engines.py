"""Studies of both engines, and of robots that are not there."""

import csv
import sys

import pytest
from harness.engines import needs_bullet
from harness.studies import saved, study

from hpid_ros.base.files import share_folder
from hpid_ros.cli.commands import DONE
from hpid_ros.experiment.study_plan import is_robot_installed
from hpid_ros.metrics.quantities import INDICES

EXPERIMENTS = share_folder() / "config" / "experiments"


def runs_of(folder):
    """Return the numbers of every run and joint in runs.csv, by all that names it."""
    names = ("experiment", "engine", "controller", "seed", "joint")
    with (folder / "runs.csv").open() as file:
        return {tuple(row.pop(name) for name in names): row for row in csv.DictReader(file)}


@needs_bullet
def test_the_other_engine_is_added_to_a_study_and_what_both_give_is_compared(
    studied, tmp_path, capsys, study_runs
):
    files, folder = studied
    alone = runs_of(folder)
    assert "engines" not in saved(folder)
    assert study(files, tmp_path / "pybullet", "--engine", "pybullet", seeds=1) == DONE
    alone |= runs_of(tmp_path / "pybullet")
    assert not (tmp_path / "pybullet" / "engines.csv").exists()
    study_runs.clear()
    assert study(files, folder, "--engine", "both", "--resume") == DONE
    assert len(study_runs) == len([label for label in study_runs if "(pybullet)" in label]) == 8
    assert "How far MuJoCo's totals lie from PyBullet's" in capsys.readouterr().out
    runs = runs_of(folder)
    assert alone.items() <= runs.items()
    rows = list(csv.DictReader((folder / "engines.csv").open()))
    found = set()
    for row in rows:
        name = (row["experiment"], row["controller"], row["seed"])
        bullet, mujoco = (
            runs[(name[0], engine, *name[1:], "all")][row["quantity"]]
            for engine in ("pybullet", "mujoco")
        )
        assert (row["pybullet"], row["mujoco"]) == (bullet, mujoco)
        assert float(row["distance"]) == float(mujoco) / float(bullet) - 1.0
        found.add((*name, row["quantity"]))
    assert found >= {(key[0], *key[2:4], each.key) for key in runs for each in INDICES}
    assert any(float(row["distance"]) for row in rows)
    document = saved(folder)
    assert set(document["experiments"]) == {
        f"{name} ({engine})" for name in ("calm", "noisy") for engine in ("pybullet", "mujoco")
    }
    ratio = document["experiments"]["noisy (mujoco)"]["controllers"]["hPID"]["ratios"]["ivc"]
    of_engines = document["engines"]["noisy"]["hPID"]["ivc"]["ratios"]
    assert of_engines["mujoco"] == pytest.approx(ratio["median"], rel=1e-12)
    # A claim holds only if it does in both.
    assert set(document["claims"]["hPID"][0]["figures"]) == set(document["experiments"])
    assert {each.name for each in (folder / "experiments").iterdir()} == {
        "calm.yaml",
        "noisy.yaml",
    }
    whole = {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()}
    journal = folder / "runs.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join(lines[:1] + lines[3:]) + lines[2][:99])
    study_runs.clear()
    assert study(files, folder, "--engine", "both", "--resume") == DONE
    assert len(study_runs) == 2
    assert {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()} == whole


def test_robots_that_are_not_installed_are_named_and_left_out(monkeypatch, capsys):
    from hpid_ros.cli.commands.batches import _shipped_files

    monkeypatch.setitem(sys.modules, "pybullet_data", None)
    names = [file.stem for file in _shipped_files()]
    assert "paper" in names
    assert not {"iiwa", "panda"} & set(names)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("iiwa, panda")
    assert all(is_robot_installed(EXPERIMENTS / f"{name}.yaml") for name in names)

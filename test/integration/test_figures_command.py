"""``hpid figures`` and ``hpid compare --figures``: figures for print, when somebody wants them."""

import json

import pytest

from hpid_ros.cli.commands import BAD_INPUT, DONE
from hpid_ros.cli.main import main

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("figures") / "short.yaml"
    path.write_text(
        "extends: config/experiments/paper.yaml\nname: short\nduration: 0.2\n"
        "simulation: {engine: mujoco, physics_steps: 2}\n"
    )
    return path


def compared(file, folder, *options):
    assert main(["compare", str(file), "--in-process", "-o", str(folder), *options]) == DONE
    return folder


def drawn(folder):
    return {each.name: each.read_bytes() for each in (folder / "figures").iterdir()}


def test_figures_are_drawn_of_a_result_as_they_would_have_been_with_it(file, tmp_path, capsys):
    first = compared(file, tmp_path / "first", "--figures", "svg")
    second = compared(file, tmp_path / "second")
    assert not (second / "figures").exists()
    assert main(["figures", str(second), "--formats", "svg"]) == DONE
    assert f"figures: {second / 'figures'}" in capsys.readouterr().out
    names = ("positions", "errors", "norm", "multiplier", "trade_off", "end_effector")
    assert {f"{name}.svg" for name in names} < drawn(second).keys()
    assert drawn(first) == drawn(second)
    marker = json.loads((second / "hpid_result.json").read_text())
    assert marker["state"] == "finished"
    assert {f"figures/{name}" for name in drawn(second)} < set(marker["files"])
    assert main(["figures", str(second), "--formats", "svg"]) == BAD_INPUT
    assert "exists; replace it with --force" in capsys.readouterr().err
    (second / "figures" / "positions.png").write_bytes(b"mine")
    assert main(["figures", str(second), "--force"]) == BAD_INPUT
    assert "this package did not write it" in capsys.readouterr().err
    assert (second / "figures" / "positions.png").read_bytes() == b"mine"
    assert main(["figures", str(second), "--formats", "svg", "--force"]) == DONE


def test_figures_of_one_of_several_engines_belong_to_the_whole_result(file, tmp_path, capsys):
    pytest.importorskip("pybullet")
    both = compared(file, tmp_path / "both", "--engine", "both")
    assert main(["figures", str(both)]) == BAD_INPUT
    assert "name one of its folders" in capsys.readouterr().err
    assert main(["figures", str(both / "mujoco"), "--formats", "svg"]) == DONE
    files = json.loads((both / "hpid_result.json").read_text())["files"]
    assert "mujoco/figures/errors.svg" in files


def test_unknown_formats_are_refused_before_anything_is_run(file, tmp_path, capsys):
    folder = tmp_path / "none"
    for command in (["compare", str(file), "--figures", "png,jpg"], ["figures", str(folder)]):
        options = ["-o", str(folder)] if command[0] == "compare" else ["--formats", "jpg"]
        assert main([*command, *options]) == BAD_INPUT
        assert "unknown figure format 'jpg'" in capsys.readouterr().err
        assert not folder.exists()

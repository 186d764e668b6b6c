"""``hpid figures`` and ``hpid compare --figures``: figures for print, when somebody wants them."""

import json

import pytest
from harness.experiments import write_experiment
from harness.studies import compared

from hpid_ros.cli.commands import DONE
from hpid_ros.cli.main import main

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_experiment(tmp_path_factory.mktemp("figures"), duration=0.2)


def drawn(folder):
    return {each.name: each.read_bytes() for each in (folder / "figures").iterdir()}


def test_figures_are_drawn_of_a_result_as_with_it(file, tmp_path, hpid, refused):
    first = compared(file, tmp_path / "first", "--figures", "svg")
    second = compared(file, tmp_path / "second")
    assert not (second / "figures").exists()
    code, printed, _ = hpid("figures", second, "--formats", "svg")
    assert code == DONE
    assert f"figures: {second / 'figures'}" in printed
    names = ("positions", "errors", "norm", "multiplier", "trade_off", "end_effector")
    assert {f"{name}.svg" for name in names} < drawn(second).keys()
    assert drawn(first) == drawn(second)
    marker = json.loads((second / "hpid_result.json").read_text())
    assert marker["state"] == "finished"
    assert {f"figures/{name}" for name in drawn(second)} < set(marker["files"])
    told = refused("figures", second, "--formats", "svg")
    assert "exists; replace it with --force" in told
    (second / "figures" / "positions.png").write_bytes(b"mine")
    assert "this package did not write it" in refused("figures", second, "--force")
    assert (second / "figures" / "positions.png").read_bytes() == b"mine"
    assert main(["figures", str(second), "--formats", "svg", "--force"]) == DONE


def test_figures_of_one_of_several_engines_belong_to_the_whole_result(file, tmp_path, refused):
    pytest.importorskip("pybullet")
    both = compared(file, tmp_path / "both", "--engine", "both")
    assert "name one of its folders" in refused("figures", both)
    assert main(["figures", str(both / "mujoco"), "--formats", "svg"]) == DONE
    files = json.loads((both / "hpid_result.json").read_text())["files"]
    assert "mujoco/figures/errors.svg" in files


def test_unknown_formats_are_refused_before_anything_is_run(file, tmp_path, refused):
    folder = tmp_path / "none"
    for command in (
        ("compare", file, "--figures", "png,jpg", "-o", folder),
        ("figures", folder, "--formats", "jpg"),
    ):
        assert "unknown figure format 'jpg'" in refused(*command)
        assert not folder.exists()

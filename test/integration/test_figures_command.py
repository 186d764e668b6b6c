"""``hpid figures`` and ``hpid compare --figures``: figures for print, when somebody wants them."""

import json
import shutil

import pytest
from harness.experiments import write_experiment
from harness.studies import compared

from hpid_bench.cli.commands import DONE, figures
from hpid_bench.experiment.result_folder import MARKER

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def every():
    """Let the two first figures of a result be drawn alone, and return what gives all of them."""
    every = figures.printed_figures
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "printed_figures", lambda found: every(found)[:2])
        yield every


@pytest.fixture(scope="module")
def result(tmp_path_factory, every):
    """Return a result that was drawn at once."""
    folder = tmp_path_factory.mktemp("figures")
    return compared(write_experiment(folder, duration=0.2), folder / "result", "--figures", "svg")


def drawn(folder):
    return {each.name: each.read_bytes() for each in (folder / "figures").iterdir()}


def test_figures_are_drawn_of_a_result_as_with_it(result, every, hpid, refused):
    names = [each.name for each in every(figures._summary(result))]
    assert {"errors", "norm", "multiplier", "trade_off", "end_effector"} < set(names)
    before = drawn(result)
    assert before.keys() == {f"{name}.svg" for name in names[:2]}
    marker = json.loads((result / MARKER).read_text())
    assert marker["state"] == "finished"
    assert {f"figures/{name}" for name in before} < set(marker["files"])
    told = refused("figures", result, "--formats", "svg")
    assert "exists; replace it with --force" in told
    (result / "figures" / "positions.png").write_bytes(b"mine")
    assert "this package did not write it" in refused("figures", result, "--force")
    code, printed, _ = hpid("figures", result, "--formats", "svg", "--force")
    assert code == DONE
    assert f"figures: {result / 'figures'}" in printed
    assert drawn(result) == before | {"positions.png": b"mine"}


@pytest.mark.parametrize(
    "bridge",
    ["", "[]", "a: b", "/**/b: 1", "/**/b:\n  ros__parameters: {ee_link: 3}", "b: [1", "\0"],
)
def test_parameters_of_a_bridge_that_were_tampered_with_are_one_line(
    result, tmp_path, refused, bridge
):
    folder = tmp_path / "result"
    shutil.copytree(result, folder)
    for file in folder.glob("nodes/*/bridge.yaml"):
        file.write_text(bridge)
    assert "bridge.yaml" in refused("figures", folder, "--force")


def test_unknown_formats_are_refused_before_anything_is_run(experiment_file, tmp_path, refused):
    folder = tmp_path / "none"
    for command in (
        ("compare", experiment_file(), "--figures", "png,jpg", "-o", folder),
        ("figures", folder, "--formats", "jpg"),
    ):
        assert "unknown figure format 'jpg'" in refused(*command)
        assert not folder.exists()

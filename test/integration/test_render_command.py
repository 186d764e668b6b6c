"""hpid render: an animation of a result, looked at by its pixels."""

import shutil

import numpy as np
import pytest
from harness.studies import compared
from PIL import Image

from hpid_bench.cli.main import main
from hpid_bench.report.film import FilmSettings, recorded, render
from hpid_ros.base.errors import LibraryError
from hpid_ros.robot.shapes import Shape
from hpid_ros.simulation.stage import Stage, View

SMALL = ("--size", "320x200", "--fps", "10")


def require_renderer():
    """Skip where nobody can draw: without OpenGL."""
    stage = Stage([[Shape("a", "sphere", (0.1,))]], 16, 16)
    try:
        stage.open(View((0.0, 0.0, 0.0), 1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
        stage.close()
    except LibraryError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Return the folder of a short comparison in which the arm has somewhere to go."""
    require_renderer()
    folder = tmp_path_factory.mktemp("render")
    file = folder / "short.yaml"
    file.write_text(
        "extends: config/experiments/paper.yaml\nname: short\nduration: 0.3\n"
        "simulation: {engine: mujoco, physics_steps: 1}\n"
    )
    return compared(file, folder / "result")


@pytest.fixture
def own(result, tmp_path):
    """Return a copy of it."""
    return shutil.copytree(result, tmp_path / "own")


def frames(path):
    with Image.open(path) as image:
        for k in range(image.n_frames):
            image.seek(k)
            yield np.asarray(image.convert("RGB"), dtype=int)


def test_an_animation_is_in_the_result_and_in_its_report(own, capsys):
    assert main(["render", str(own), *SMALL, "--report"]) == 0
    assert "4 pictures" in capsys.readouterr().out
    pictures = list(frames(own / "animation.webp"))
    assert [each.shape for each in pictures] == [(200, 320, 3)] * 4
    assert abs(pictures[3] - pictures[0]).max() > 60  # it moves
    page = (own / "report.html").read_text()
    assert page.count("data:image/webp;base64,") == 2
    # Once more, in the place of the first; and the result's own bookkeeping knows the file.
    assert main(["render", str(own), *SMALL, "--report", "--force"]) == 0
    assert (own / "report.html").read_text() == page
    assert "animation.webp" in (own / "hpid_result.json").read_text()


@pytest.mark.parametrize("suffix", ["gif", "png"])
def test_other_formats_hold_the_same_frames(result, tmp_path, suffix):
    file = tmp_path / f"arm.{suffix}"
    options = ("--from", "0.1", "--to", "0.2", "--joint", "arm_joint_2")
    assert main(["render", str(result), *SMALL, *options, "-o", str(file)]) == 0
    first, last = frames(file)
    assert abs(first - last).max() > 60
    assert sorted(each.name for each in tmp_path.iterdir()) == [file.name]


def test_one_instant_is_a_still_picture(result, tmp_path):
    file = tmp_path / "arm.jpg"
    options = ("--at", "0.25", "--controller", "hPID", "-o", str(file))
    assert main(["render", str(result), *SMALL, *options]) == 0
    with Image.open(file) as image:
        assert (image.format, image.size) == ("JPEG", (320, 200))


def test_the_robot_is_where_it_was_and_the_double_where_it_was_to_be(result):
    found = recorded(result)
    film = render(*found, FilmSettings(width=320, height=200, fps=10.0, end=0.2))
    assert film.instants.tolist() == pytest.approx([0.0, 0.1, 0.2])
    panel = [np.asarray(each, dtype=int)[15:135, :160] for each in film.frames]
    assert len(panel) == 3
    greens = [np.sum((p[..., 1] > p[..., 0] + 15) & (p[..., 1] > p[..., 2] + 5)) for p in panel]
    # The step is at time 0: the double is far from the robot, which then comes to cover it.
    assert greens[0] > 100
    assert greens[2] < greens[0] / 2


def test_no_wish_that_cannot_be_met_writes_anything(own, refused):
    before = sorted(own.rglob("*"))
    (own.parent / "there.gif").write_text("mine")
    for options, line in (
        (["--size", "big"], "--size 'big' must be WIDTHxHEIGHT"),
        (
            ["--size", "20x20"],
            "width must be a whole number, at least 160 and at most 3840, not 20",
        ),
        (["--from", "9"], "from 9 s to 0.3 s is not within the runs, which take 0.3 s"),
        (["--speed", "0.01", "--fps", "50", "--size", "160x160"], "more than 1500"),
        (["--joint", "elbow"], "unknown joint 'elbow'"),
        (["--controller", "LQR"], "unknown run 'LQR'"),
        (["--engine", "povray"], "engine must be one of "),
        (["--at", "0.1", "--to", "0.2"], "--at is one instant"),
        (["--at", "0.1", "--report"], "--report takes an animation"),
        (["-o", "arm.mp4"], "must be one of .webp, .gif, .png, not '.mp4'"),
        (["-o", str(own.parent / "there.gif")], "exists; name another with -o"),
    ):
        assert line in refused("render", own, *options)
    assert sorted(own.rglob("*")) == before
    assert (own.parent / "there.gif").read_text() == "mine"


def test_what_is_no_result_with_recordings_is_one_line(own, tmp_path, refused):
    assert "is no result folder: it has no result.json" in refused("render", tmp_path)
    shutil.rmtree(own / "bags")
    assert "has no recordings any more" in refused("render", own)


def test_a_comparison_can_be_animated_at_once(experiment_file, tmp_path, refused):
    require_renderer()
    folder = tmp_path / "result"
    many = experiment_file(duration=0.05, compare={name: {} for name in "abcde"})
    words = refused("compare", many, "--in-process", "-o", folder, "--animation")
    assert "shows 1 to 4 runs beside each other, not 5" in words
    assert not folder.exists()
    compared(experiment_file(duration=0.05), folder, "--animation")
    assert len(list(frames(folder / "animation.webp"))) == 1
    assert "data:image/webp" in (folder / "report.html").read_text()
    assert '"finished"' in (folder / "hpid_result.json").read_text()

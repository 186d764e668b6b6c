"""Stages: bodies are seen where they are, alike in both engines."""

import math

import numpy as np
import pytest

from hpid_ros.base.errors import LibraryError, RobotDescriptionError, SettingError
from hpid_ros.robot.shapes import Body
from hpid_ros.simulation.mujoco_stage import triangles_of
from hpid_ros.simulation.settings import installed_engines
from hpid_ros.simulation.stage import StageSettings, View, open_stage

RED = (0.9, 0.1, 0.1)
VIEW = View((0.0, 0.0, 0.0), 2.0, math.radians(30.0), math.radians(20.0))
ENGINES = [
    pytest.param(
        engine,
        marks=pytest.mark.skipif(
            engine not in installed_engines(), reason=f"{engine} is not installed"
        ),
    )
    for engine in ("pybullet", "mujoco")
]


def placed(*positions):
    return np.array([[*position, 0.0, 0.0, 0.0, 1.0] for position in positions])


@pytest.fixture
def stage(request):
    """Return a function that opens stages and closes them in the end."""
    opened = []

    def open_one(engine, *bodies, is_lit=True):
        settings = StageSettings(bodies, VIEW, 96, 64, is_lit)
        try:
            opened.append(open_stage(engine, settings))
        except LibraryError as error:
            pytest.skip(str(error))
        return opened[-1]

    yield open_one
    for each in opened:
        each.close()
        each.close()


def is_red(picture):
    pixels = picture.pixels.astype(int)
    return (pixels[..., 0] > 1.5 * pixels[..., 1]) & (pixels[..., 0] > 60)


@pytest.mark.parametrize("is_lit", [True, False])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_ball_is_seen_where_it_is_and_as_far_away_as_it_is(stage, engine, is_lit):
    radius = 0.2
    one = stage(engine, Body("sphere", (radius,), RED), is_lit=is_lit)
    for right, up in ((0.0, 0.0), (0.3, 0.1), (-0.3, -0.1)):
        picture = one.draw(placed(right * VIEW.axes[0] + up * VIEW.axes[1]))
        rows, columns = np.nonzero(is_red(picture))
        pixel = 2.0 * math.tan(math.radians(15.0)) * VIEW.distance / 64  # [m]
        assert (columns.mean() - 47.5) * pixel == pytest.approx(right, abs=pixel)
        assert (31.5 - rows.mean()) * pixel == pytest.approx(up, abs=pixel)
        assert len(rows) * pixel**2 == pytest.approx(math.pi * radius**2, rel=0.08)
    picture = one.draw(placed((0.0, 0.0, 0.0)))
    assert picture.depth[32, 48] == pytest.approx(VIEW.distance - radius, abs=0.02)
    assert picture.depth[0, 0] > 2.0 * VIEW.distance
    assert picture.pixels[0, 0].tolist() == [255, 255, 255]


@pytest.mark.parametrize("engine", ENGINES)
def test_the_nearer_body_hides_the_other_and_a_turn_is_seen(stage, engine):
    bar = Body("box", (0.05, 0.8, 0.05), RED)
    one = stage(engine, bar, Body("sphere", (0.3,), (0.1, 0.1, 0.9)))
    near, far = VIEW.axes[2] * 0.5, VIEW.axes[2] * -0.5
    before = one.draw(placed(near, far))
    behind = one.draw(placed(far, near))
    assert is_red(before)[32, 48]
    assert not is_red(behind)[32, 48]
    upright = placed(near, far)
    upright[0, 3:] = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # about x, by a right angle
    columns = np.nonzero(is_red(before).any(axis=0))[0]
    turned = np.nonzero(is_red(one.draw(upright)).any(axis=0))[0]
    assert np.ptp(turned) < np.ptp(columns) / 3


@pytest.mark.parametrize("engine", ENGINES)
def test_the_same_bodies_give_the_same_picture(stage, engine):
    bodies = [Body("cylinder", (0.1, 0.6), RED), Body("box", (1.5, 1.5, 0.01))]
    places = placed((0.0, 0.0, 0.1), (0.0, 0.0, -0.3))
    one, other = stage(engine, *bodies), stage(engine, *bodies)
    first = one.draw(places)
    one.draw(places + 0.1)
    assert np.array_equal(first.pixels, one.draw(places).pixels)
    assert np.array_equal(first.pixels, other.draw(places).pixels)


# Two parts, a square and a triangle; some corners counted backwards, some with texture and normal.
MESH = """\
o one
v 0 -0.3 0
v 0 0 0
v 0 0 0.3
v 0 -0.3 0.3
f 1/1/1 2/2/1 3//1 4
o two
v 0 0 0
v 0 0.3 0
v 0 0.3 -0.3
f -2 -3 -1
"""


def test_all_parts_of_a_mesh_are_read(tmp_path):
    file = tmp_path / "two.obj"
    file.write_text(MESH)
    corners, triangles = triangles_of(file)
    assert corners.shape == (7, 3)
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3], [5, 4, 6]]
    for text in ("", "v 0 0 0\nf 1 2 3\n", "v 0 0 high\n", "v 0 0 0\nf a b c\n"):
        file.write_text(text)
        with pytest.raises(RobotDescriptionError, match="cannot read mesh"):
            triangles_of(file)


@pytest.mark.parametrize("engine", ENGINES)
def test_all_parts_of_a_mesh_are_drawn(stage, engine, tmp_path):
    file = tmp_path / "two.obj"
    file.write_text(MESH)
    one = stage(engine, Body("mesh", (1.0, 1.0, 1.0), RED, file))
    square, triangle = 0.3 * 0.3, 0.3 * 0.3 / 2.0
    pixel = 2.0 * math.tan(math.radians(15.0)) * VIEW.distance / 64  # [m]
    seen = np.sum(is_red(one.draw(placed((0.0, 0.0, 0.0))))) * pixel**2
    # The mesh lies in the plane of y and z, seen at an angle.
    assert seen == pytest.approx((square + triangle) * abs(VIEW.axes[2][0]), rel=0.15)


def test_a_stage_of_no_engine_is_one_line():
    with pytest.raises(SettingError, match="engine"):
        open_stage("povray", StageSettings((), VIEW, 96, 64))


def test_without_opengl_mujoco_says_what_to_install(monkeypatch):
    from hpid_ros.simulation import mujoco_stage

    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    monkeypatch.setitem(__import__("sys").modules, "mujoco.osmesa", None)
    with pytest.raises(LibraryError, match="apt install libegl1"):
        mujoco_stage.MujocoStage(StageSettings([Body("sphere", (0.1,))], VIEW, 96, 64))

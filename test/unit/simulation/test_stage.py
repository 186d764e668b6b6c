"""The stage: bodies are seen where they are, and the picture is full."""

import math

import numpy as np
import pytest
from harness.examples import examples
from hypothesis import example, given
from hypothesis import strategies as st

from hpid_bench.report.film import framed
from hpid_ros.base.errors import LibraryError, RobotDescriptionError
from hpid_ros.robot.shapes import Shape
from hpid_ros.simulation import stage as stage_module
from hpid_ros.simulation.stage import FIELD, Stage, View, triangles_of

RED = (0.9, 0.1, 0.1, 1.0)
VIEW = View((0.0, 0.0, 0.0), 2.0, math.radians(30.0), math.radians(20.0))
PIXEL = 2.0 * math.tan(FIELD / 2.0) * VIEW.distance / 64  # [m]


def placed(*positions):
    return np.array([[*position, 0.0, 0.0, 0.0, 1.0] for position in positions])


@pytest.fixture
def stage():
    """Return a function that opens stages, one shape a body, and closes them in the end."""
    opened = []

    def open_one(*shapes):
        opened.append(Stage([[each] for each in shapes], 96, 64))
        try:
            opened[-1].open(VIEW, (0.0, 0.0, -50.0), 1.0)
        except LibraryError as error:
            pytest.skip(str(error))
        return opened[-1]

    yield open_one
    for each in opened:
        each.close()
        each.close()


def is_red(picture):
    pixels = picture.astype(int)
    return (pixels[..., 0] > 1.5 * pixels[..., 1]) & (pixels[..., 0] > 60)


def test_a_ball_is_seen_where_it_is_before_white(stage):
    radius = 0.2
    one = stage(Shape("a", "sphere", (radius,), RED))
    for right, up in ((0.0, 0.0), (0.3, 0.1), (-0.3, -0.1)):
        picture = one.draw(placed(right * VIEW.axes[0] + up * VIEW.axes[1]))
        rows, columns = np.nonzero(is_red(picture))
        assert (columns.mean() - 47.5) * PIXEL == pytest.approx(right, abs=PIXEL)
        assert (31.5 - rows.mean()) * PIXEL == pytest.approx(up, abs=PIXEL)
        assert len(rows) * PIXEL**2 == pytest.approx(math.pi * radius**2, rel=0.08)
        assert picture[0, 0].tolist() == [255, 255, 255]


def test_the_nearer_body_hides_the_other_and_a_turn_is_seen(stage):
    bar = Shape("a", "box", (0.05, 0.8, 0.05), RED)
    one = stage(bar, Shape("b", "sphere", (0.3,), (0.1, 0.1, 0.9, 1.0)))
    near, far = VIEW.axes[2] * 0.5, VIEW.axes[2] * -0.5
    before = one.draw(placed(near, far))
    assert is_red(before)[32, 48]
    assert not is_red(one.draw(placed(far, near)))[32, 48]
    assert np.array_equal(one.draw(placed(near, far)), before)
    upright = placed(near, far)
    upright[0, 3:] = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # about x, by a right angle
    columns = np.nonzero(is_red(before).any(axis=0))[0]
    turned = np.nonzero(is_red(one.draw(upright)).any(axis=0))[0]
    assert np.ptp(turned) < np.ptp(columns) / 3


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


def test_all_parts_of_a_mesh_are_read_and_drawn(stage, tmp_path):
    file = tmp_path / "two.obj"
    file.write_text(MESH)
    corners, triangles = triangles_of(file)
    assert corners.shape == (7, 3)
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3], [5, 4, 6]]
    one = stage(Shape("a", "mesh", (1.0, 1.0, 1.0), RED, mesh=file))
    square, triangle = 0.3 * 0.3, 0.3 * 0.3 / 2.0
    seen = np.sum(is_red(one.draw(placed((0.0, 0.0, 0.0))))) * PIXEL**2
    # The mesh lies in the plane of y and z, seen at an angle.
    assert seen == pytest.approx((square + triangle) * abs(VIEW.axes[2][0]), rel=0.15)


@pytest.mark.parametrize("text", ["", "v 0 0 0\nf 1 2 3\n", "v 0 0 high\n", "v 0 0 0\nf a b c\n"])
def test_a_damaged_mesh_is_refused(text, tmp_path):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(RobotDescriptionError, match="cannot read mesh"):
        triangles_of(tmp_path / "a.obj")


def test_the_corners_of_a_turned_box_are_those_of_the_turned_box():
    half = math.sqrt(0.5)
    place = np.array([[[1.0, 2.0, 3.0, 0.0, 0.0, half, half]]])  # about z, by a right angle
    points = Stage([[Shape("a", "box", (2.0, 4.0, 6.0))]], 96, 64).corners(place)
    assert np.allclose(points.min(axis=0), (-1.0, 1.0, 0.0))
    assert np.allclose(points.max(axis=0), (3.0, 3.0, 6.0))


@examples(2.0)
@example(seed=182, azimuth=3.0, elevation=0.0, aspect=2.0)  # along a cloud that is near
@given(
    seed=st.integers(0, 1000),
    azimuth=st.floats(-3.0, 3.0),
    elevation=st.floats(-1.4, 1.4),
    aspect=st.floats(0.5, 3.0),
)
def test_all_points_are_in_the_picture_which_is_full(seed, azimuth, elevation, aspect):
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1.0, 1.0, (30, 3)) * (2.0, 0.3, 1.0) + (5.0, -3.0, 1.0)
    view = framed(points, azimuth, elevation, aspect)
    right, up, back = view.axes @ (points - view.eye).T
    assert np.all(back < 0.0)  # before the camera
    high = up / -back / math.tan(FIELD / 2.0)
    wide = right / -back / math.tan(FIELD / 2.0) / aspect
    largest = max(np.abs(high).max(), np.abs(wide).max())
    assert largest == pytest.approx(1.0 / 1.1)
    assert abs(high.min() + high.max()) < 1e-6
    assert abs(wide.min() + wide.max()) < 1e-6


def test_without_opengl_one_line_says_what_to_install(stage, monkeypatch):
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    monkeypatch.setitem(__import__("sys").modules, "mujoco.osmesa", None)
    with pytest.raises(LibraryError, match="apt install libegl1"):
        stage_module.gl_context(96, 64)

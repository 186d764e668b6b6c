"""The camera: everything in the picture, and as near as that goes."""

import math

import numpy as np
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.report.film import framed
from hpid_ros.report.film_motion import corners
from hpid_ros.robot.shapes import Body
from hpid_ros.simulation.stage import FIELD


@examples(2.0)
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
    assert 0.85 < largest <= 0.95
    assert abs(high.min() + high.max()) < 0.1
    assert abs(wide.min() + wide.max()) < 0.1


def test_the_corners_of_a_turned_box_are_those_of_the_turned_box():
    half = math.sqrt(0.5)
    place = np.array([[[1.0, 2.0, 3.0, 0.0, 0.0, half, half]]])  # about z, by a right angle
    points = corners([Body("box", (2.0, 4.0, 6.0))], place)
    assert np.allclose(points.min(axis=0), (-1.0, 1.0, 0.0))
    assert np.allclose(points.max(axis=0), (3.0, 3.0, 6.0))

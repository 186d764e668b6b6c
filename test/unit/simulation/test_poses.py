"""Quaternions and matrices of rotations, against SciPy's."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hpid_ros.simulation.poses import quaternion_of, rotation_matrix, unit_quaternion

QUARTERS = st.integers(-4, 4).map(lambda count: count * math.pi / 2.0)
ANGLES = st.floats(-10.0, 10.0) | QUARTERS


@given(ANGLES, ANGLES, ANGLES)
def test_roll_pitch_and_yaw_are_about_fixed_axes(roll, pitch, yaw):
    turn = Rotation.from_euler("xyz", [roll, pitch, yaw])
    found = quaternion_of(roll, pitch, yaw)
    assert np.allclose(found, turn.as_quat(), rtol=0.0, atol=1e-15)
    assert np.allclose(rotation_matrix(found), turn.as_matrix(), rtol=0.0, atol=2e-15)


@given(st.lists(st.floats(0.01, 1.0) | st.floats(-1.0, -0.01), min_size=4, max_size=4))
def test_any_length_is_a_rotation(quaternion):
    unit = unit_quaternion(quaternion)
    assert abs(math.hypot(*unit) - 1.0) < 1e-15
    expected = Rotation.from_quat(quaternion).as_matrix()
    assert np.allclose(rotation_matrix(unit), expected, rtol=0.0, atol=2e-15)

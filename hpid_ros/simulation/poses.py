"""Poses and twists of links in the world, and their quaternions x, y, z, w as what they mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Quaternion = tuple[float, float, float, float]
Matrix = npt.NDArray[np.float64]


class Pose(NamedTuple):
    """A frame in the world.

    Attributes:
        position: Origin x, y, z, in [m].
        orientation: Unit quaternion x, y, z, w, as in ``geometry_msgs/Quaternion``.
    """

    position: tuple[float, float, float]
    orientation: Quaternion


class Twist(NamedTuple):
    """Velocity of a frame, expressed in that frame, as ``nav_msgs/Odometry`` has it.

    Attributes:
        linear: Velocity of the frame's origin, in [m/s].
        angular: Angular velocity, in [rad/s].
    """

    linear: tuple[float, float, float]
    angular: tuple[float, float, float]


def unit_quaternion(quaternion: Sequence[float]) -> Quaternion:
    """Return a quaternion that is not quite of length 1 at that length.

    Args:
        quaternion: x, y, z, w.
    """
    x, y, z, w = quaternion
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length


def rotation_matrix(quaternion: Quaternion) -> Matrix:
    """Return a rotation as a matrix, shape (3, 3).

    Args:
        quaternion: Its unit quaternion x, y, z, w.
    """
    x, y, z, w = quaternion
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, xz, xw, yz, yw, zw = x * y, x * z, x * w, y * z, y * w, z * w
    return np.array(
        [
            [xx - yy - zz + ww, 2.0 * (xy - zw), 2.0 * (xz + yw)],
            [2.0 * (xy + zw), -xx + yy - zz + ww, 2.0 * (yz - xw)],
            [2.0 * (xz - yw), 2.0 * (yz + xw), -xx - yy + zz + ww],
        ]
    )


def quaternion_of(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the quaternion of the angles of a URDF's ``rpy``.

    Args:
        roll: About the fixed x axis, first, in [rad].
        pitch: About the fixed y axis, in [rad].
        yaw: About the fixed z axis, last, in [rad].
    """
    found = (math.sin(roll / 2.0), 0.0, 0.0, math.cos(roll / 2.0))
    found = _product((0.0, math.sin(pitch / 2.0), 0.0, math.cos(pitch / 2.0)), found)
    return _product((0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0)), found)


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the rotation q and then p."""
    return (
        p[3] * q[0] + q[3] * p[0] + (p[1] * q[2] - p[2] * q[1]),
        p[3] * q[1] + q[3] * p[1] + (p[2] * q[0] - p[0] * q[2]),
        p[3] * q[2] + q[3] * p[2] + (p[0] * q[1] - p[1] * q[0]),
        p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2],
    )

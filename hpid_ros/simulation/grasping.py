"""How a box lies between two fingers, and whether they can hold it so."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hpid_ros.simulation.bricks import GripperSettings
from hpid_ros.simulation.bullet import pybullet
from hpid_ros.simulation.poses import Pose

Matrix = npt.NDArray[np.float64]

_ROTATIONS = [
    rotation
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(rotation := np.diag(signs)[list(order)]) > 0.0
]  # the 24 that map a box's axes onto axes


class Fit(NamedTuple):
    """How a brick lies in the hand.

    Attributes:
        brick: Which brick.
        distance: Between its centre and the grasp frame, in [m].
        angle: Between its faces and the fingers, in [rad].
        width: Its edge between the fingers, in [m].
    """

    brick: int
    distance: float
    angle: float
    width: float


def fit_of(index: int, size: Sequence[float], brick: Pose, hand: Pose) -> Fit:
    """Return how a brick lies in the hand.

    Args:
        index: Which brick.
        size: Its edges along its own axes, in [m].
        brick: Pose of its centre.
        hand: The grasp frame, whose fingers close along y.
    """
    relative = _matrix(hand.orientation).T @ _matrix(brick.orientation)
    nearest = max(_ROTATIONS, key=lambda rotation: float(np.sum(rotation * relative)))
    # The chord of an angle is exact for small ones, where the arc cosine of the trace is not.
    chord = float(np.linalg.norm(nearest - relative)) / (2.0 * math.sqrt(2.0))
    across = int(np.argmax(np.abs(nearest[1])))  # the brick's axis along the hand's y
    distance = math.dist(hand.position, brick.position)
    return Fit(index, distance, 2.0 * math.asin(min(chord, 1.0)), size[across])


def misfit(fit: Fit, gripper: GripperSettings) -> str:
    """Return why a brick cannot be held; empty when it can.

    Args:
        fit: How it lies in the hand.
        gripper: The hand.
    """
    if fit.distance > gripper.tolerance:
        return f"{fit.distance:.4g} m away, at most {gripper.tolerance:g} m"
    if fit.angle > gripper.angle_tolerance:
        return f"turned by {fit.angle:.4g} rad, at most {gripper.angle_tolerance:g} rad"
    if fit.width > gripper.opening:
        return f"{fit.width:g} m wide, at most {gripper.opening:g} m"
    return ""


def _matrix(quaternion: Sequence[float]) -> Matrix:
    """Return a quaternion x, y, z, w as a rotation matrix."""
    return np.reshape(pybullet.getMatrixFromQuaternion(quaternion), (3, 3))

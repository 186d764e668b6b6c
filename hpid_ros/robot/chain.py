"""Forward kinematics of one chain at many instants at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class LinkPose(NamedTuple):
    """A link's frame in the frame of the robot's root link.

    Attributes:
        position: Origin x, y, z, in [m].
        rotation: Its axes as columns, a rotation matrix of shape (3, 3).
    """

    position: Array
    rotation: Array


class LinkPoses(NamedTuple):
    """A frame at n instants.

    Attributes:
        positions: Origins, shape (n, 3), in [m].
        rotations: Axes as columns, shape (n, 3, 3).
    """

    positions: Array
    rotations: Array


@dataclass(frozen=True, eq=False)
class ChainJoint:
    """One joint of a chain.

    Attributes:
        rotation: Of the joint's frame at position 0 in the frame of the joint before, (3, 3).
        origin: Of the same, (3,), in [m].
        axis: Unit axis in the joint's frame, (3,).
        is_prismatic: It slides along the axis; otherwise it turns about it.
        column: Where its position stands among the positions given; None if it stands still.
        still: Its position where ``column`` is None, in [rad].
    """

    rotation: Array
    origin: Array
    axis: Array
    is_prismatic: bool
    column: int | None
    still: float


@dataclass(frozen=True, eq=False)
class SerialChain:
    """Joints from a root to a tip.

    Attributes:
        joints: From the root on.
        tip_rotation: Of the tip in the frame of the last joint, (3, 3).
        tip_origin: Of the same, (3,), in [m].
    """

    joints: tuple[ChainJoint, ...]
    tip_rotation: Array
    tip_origin: Array

    def poses(self, positions: Array) -> LinkPoses:
        """Return the tip in the root's frame.

        Args:
            positions: Shape (n, columns), in [rad].
        """
        count = len(positions)
        origins = np.zeros((count, 3))
        rotations = np.broadcast_to(np.eye(3), (count, 3, 3))
        for joint in self.joints:
            origins = origins + rotations @ joint.origin
            rotations = rotations @ joint.rotation
            angles = (
                np.full(count, joint.still) if joint.column is None else positions[:, joint.column]
            )
            if joint.is_prismatic:
                origins = origins + (rotations @ joint.axis) * angles[:, None]
            else:
                rotations = rotations @ axis_rotations(joint.axis, angles)
        return LinkPoses(origins + rotations @ self.tip_origin, rotations @ self.tip_rotation)


def axis_rotations(axis: Array, angles: Array) -> Array:
    """Return rotations about one axis, by Rodrigues' formula.

    Args:
        axis: Unit axis, (3,).
        angles: In [rad], (n,).

    Returns:
        Rotation matrices, shape (n, 3, 3).
    """
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sines, cosines = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sines * cross + (1.0 - cosines) * (cross @ cross))


def rotation_angles(rotations: Array, others: Array) -> Array:
    """Return the angles of the rotations that lead from some to others.

    Exact also for small angles, where the arc cosine of the trace is not.

    Args:
        rotations: Shape (n, 3, 3).
        others: Shape (n, 3, 3).

    Returns:
        Shape (n,), in [rad], from 0 to pi.
    """
    # |R - S| (Frobenius) = 2 sqrt(2) sin(angle / 2)
    chord = np.linalg.norm(rotations - others, axis=(1, 2)) / (2.0 * np.sqrt(2.0))
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))

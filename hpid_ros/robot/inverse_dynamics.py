"""Efforts that a robot's links need for a motion, sample by sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import RobotDescriptionError, unknown_name
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import build_model, velocity_index


class InverseDynamics:
    """The links of a robot on a fixed base: neither rotors nor friction.

    Args:
        description: The robot.
        joints: Those that move, in the order of all arrays.
        others: Where the other joints stand, in [rad]; those left out are at 0.

    Raises:
        RobotDescriptionError: The robot lacks a joint, or Pinocchio cannot read it.
    """

    def __init__(
        self,
        description: RobotDescription,
        joints: Sequence[str],
        others: Mapping[str, float] | None = None,
    ) -> None:
        for name in (*joints, *(others or {})):
            if name not in description.joints:
                raise RobotDescriptionError(unknown_name("joint", name, description.joints))
        self._model = build_model(description)
        self._model.armature = np.zeros(self._model.nv)
        self._data = self._model.createData()
        model = self._model
        self._rows = [velocity_index(model, name) for name in joints]
        rest = np.zeros(model.nv)
        for name, position in (others or {}).items():
            rest[velocity_index(model, name)] = position
        self._rest = rest

    def efforts(self, positions: Numbers, velocities: Numbers, accelerations: Numbers) -> Numbers:
        """Return the efforts, (K, R), in [N m]; in [N] where a joint slides.

        Args:
            positions: Of K joints at R instants, (K, R), in [rad].
            velocities: Likewise, in [rad/s].
            accelerations: Likewise, in [rad/s^2].
        """
        model, data, rows = self._model, self._data, self._rows
        neutral = pinocchio.neutral(model)
        motion, velocity, acceleration = self._rest.copy(), *np.zeros((2, model.nv))
        found = np.empty_like(positions)
        for k in range(positions.shape[1]):
            motion[rows] = positions[:, k]
            velocity[rows] = velocities[:, k]
            acceleration[rows] = accelerations[:, k]
            at = pinocchio.integrate(model, neutral, motion)
            found[:, k] = pinocchio.rnea(model, data, at, velocity, acceleration)[rows]
        return found

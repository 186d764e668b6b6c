"""Equations of motion of a robot in the coordinates of its motors, a rolling base included."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.dynamics import PAYLOAD_LINK, build_model, velocity_index

_PLANAR = 3  # velocities of a planar root: forward, sideways, turning, in its own frame


class Equations(NamedTuple):
    r"""Equations of motion :math:`M \ddot q + h = u` at one state."""

    mass: Numbers  # [kg m^2] m, (n, n)
    bias: Numbers  # [N m] h: Coriolis, centrifugal, gravity and viscous friction, (n,)


class JointSpace:
    r"""A robot whose coordinates are its moving joints and nothing else.

    A rolling base adds none: its wheels do not slip, so that with the velocity of the root in
    the root's own frame the rates of all bodies are :math:`\nu = S \dot q` with a constant S,
    and

    .. math:: M = S' M_\nu S, \qquad h = S' h_\nu(q, S \dot q).

    Rotors and viscous friction of the URDF belong to the model, Coulomb friction does not. The
    ground is level.

    Source: R. M. Murray, Z. Li, S. S. Sastry, *A Mathematical Introduction to Robotic
    Manipulation*, section 6.1 (constraints that are linear in the velocities).
    """

    def __init__(
        self,
        description: RobotDescription,
        drive: DifferentialDrive | None = None,
        *,
        payload_mass: float = 0.0,
        payload_link: str = PAYLOAD_LINK,
        mass_scale: float = 1.0,
        locked: Iterable[str] = (),
    ) -> None:
        held = tuple(locked)
        self._model = build_model(
            description,
            None if drive is None else pinocchio.JointModelPlanar(),
            payload_mass=payload_mass,
            payload_link=payload_link,
            mass_scale=mass_scale,
            locked=held,
        )
        self._data = self._model.createData()
        self.description = description
        moving = [joint.name for joint in description.joints.values() if joint.name not in held]
        self.joints = tuple(sorted(moving, key=lambda name: velocity_index(self._model, name)))
        self._damping = np.array([description.joints[name].damping for name in self.joints])
        self._rolling = None if drive is None else self._no_slip(drive)
        self._configuration = pinocchio.neutral(self._model)
        self._places = [
            (model.idx_q, model.nq == 2)
            for model in (self._model.joints[self._model.getJointId(name)] for name in self.joints)
        ]
        self._require_mass()

    def equations(self, positions: Sequence[float], velocities: Sequence[float]) -> Equations:
        """Return the equations of motion at one state."""
        model, data, rates = self._model, self._data, np.array(velocities)
        configuration = self._at(positions)
        rolling = self._rolling
        if rolling is None:
            mass = pinocchio.crba(model, data, configuration)
            bias = pinocchio.nonLinearEffects(model, data, configuration, rates)
        else:
            mass = rolling.T @ (pinocchio.crba(model, data, configuration) @ rolling)
            bias = rolling.T @ pinocchio.nonLinearEffects(
                model, data, configuration, rolling @ rates
            )
        return Equations(mass, bias + self._damping * rates)

    def gravity(self, positions: Sequence[float]) -> Numbers:
        """Return the efforts that hold the joints against gravity, in [N m]."""
        torques = pinocchio.computeGeneralizedGravity(self._model, self._data, self._at(positions))
        return torques if self._rolling is None else self._rolling.T @ torques

    def _at(self, positions: Sequence[float]) -> Numbers:
        """Return Pinocchio's configuration; a continuous joint's is cosine and sine."""
        configuration = self._configuration
        for (place, is_turning), position in zip(self._places, positions, strict=True):
            if is_turning:
                configuration[place] = math.cos(position)
                configuration[place + 1] = math.sin(position)
            else:
                configuration[place] = position
        return configuration

    def _no_slip(self, drive: DifferentialDrive) -> Numbers:
        """Return S: the model's velocities for unit rates of the joints."""
        self.description.select(drive.joints)
        matrix = np.zeros((self._model.nv, len(self.joints)))
        for column, name in enumerate(self.joints):
            matrix[_PLANAR + column, column] = 1.0
            if name in drive.joints:
                twist = drive.twist(float(name == drive.left), float(name == drive.right))
                matrix[0, column], matrix[2, column] = twist
        return matrix

    def _require_mass(self) -> None:
        """Refuse a robot whose equations cannot be solved for the accelerations."""
        rest = (0.0,) * len(self.joints)
        least = np.linalg.eigvalsh(self.equations(rest, rest).mass)[0]
        if not least > 0.0:
            raise RobotDescriptionError(
                f"the robot's mass matrix must be positive definite: its least eigenvalue is "
                f"{least:g} kg m^2, a joint moves no mass"
            )

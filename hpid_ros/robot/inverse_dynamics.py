"""Efforts that a robot's links need for a motion, sample by sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import RobotDescriptionError, unknown_name
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import build_model, velocity_index

_RATIO = 100.0  # of a gear of which nothing is said


class InverseDynamics:
    """The links of a robot on a fixed base: neither rotors nor friction."""

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
        self._rotors = [_Rotor.of(model, description, name) for name in joints]

    def efforts(self, positions: Numbers, velocities: Numbers, accelerations: Numbers) -> Numbers:
        """Return the efforts, (K, R), in [N m]; in [N] where a joint slides."""
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

    def spin(
        self, positions: Numbers, velocities: Numbers, accelerations: Numbers, rotors: Numbers
    ) -> Numbers:
        r"""Return the efforts, (K, R), that rotors need beside their reflected inertia, in [N m].

        A rotor behind a gear of ratio N that spins about its joint's axis z, on the link before
        the joint, has the angular momentum :math:`h = m/N\,\dot q\,z` in that link. The link must
        turn it, and the joint feels :math:`m/N\,\alpha\cdot z` of the link's acceleration.
        """
        model, data, rows = self._model, self._data, self._rows
        neutral = pinocchio.neutral(model)
        motion, velocity, acceleration = self._rest.copy(), *np.zeros((2, model.nv))
        momenta = [
            (each, rotor / each.ratio)
            for each, rotor in zip(self._rotors, rotors, strict=True)
            if each.ratio and rotor
        ]
        found = np.empty_like(positions)
        for k in range(positions.shape[1]):
            motion[rows] = positions[:, k]
            velocity[rows] = velocities[:, k]
            acceleration[rows] = accelerations[:, k]
            at = pinocchio.integrate(model, neutral, motion)
            plain = pinocchio.rnea(model, data, at, velocity, acceleration).copy()
            forces = pinocchio.StdVec_Force([pinocchio.Force.Zero()] * model.njoints)
            own = np.zeros(model.nv)
            for each, size in momenta:
                turn, swing = data.v[each.parent].angular, data.a_gf[each.parent].angular
                own[each.row] += size * float(swing @ each.axis)
                rate, change = velocity[each.row], acceleration[each.row]
                torque = size * (change * each.axis + rate * np.cross(turn, each.axis))
                forces[each.parent] -= pinocchio.Force(np.zeros(3), torque)
            pulled = pinocchio.rnea(model, data, at, velocity, acceleration, forces)
            found[:, k] = (pulled - plain + own)[rows]
        return found


class _Rotor(NamedTuple):
    """Where a joint's rotor is: on the link before it, about the joint's axis."""

    row: int  # of the joint's velocity
    parent: int  # the joint that moves that link
    axis: Numbers  # in that joint's frame
    ratio: float  # of the gear; 0 of a joint that slides, whose rotor may be anywhere

    @classmethod
    def of(cls, model: pinocchio.Model, description: RobotDescription, name: str) -> _Rotor:
        joint, index = description.joints[name], model.getJointId(name)
        axis = model.jointPlacements[index].rotation @ np.asarray(joint.axis)
        ratio = joint.gear_ratio if joint.gear_ratio > 1.0 else _RATIO
        return cls(
            velocity_index(model, name),
            int(model.parents[index]),
            axis / np.linalg.norm(axis),
            0.0 if joint.is_slide else ratio,
        )

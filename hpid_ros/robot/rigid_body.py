"""Pinocchio's model of a robot, with its rotors, a payload and errors of the masses."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pinocchio

from hpid_ros.errors import RobotDescriptionError, SettingError
from hpid_ros.robot.description import RobotDescription

PAYLOAD_LINK = "payload"


def build_model(
    description: RobotDescription,
    root: pinocchio.JointModel | None = None,
    *,
    payload_mass: float = 0.0,
    payload_link: str = PAYLOAD_LINK,
    mass_scale: float = 1.0,
    locked: Iterable[str] = (),
) -> pinocchio.Model:
    """Build the model of a robot.

    Args:
        description: The robot.
        root: The joint that carries the root link; None holds it in place.
        payload_mass: Point mass at the payload link, in [kg].
        payload_link: Link that carries the payload.
        mass_scale: Factor on the mass and inertia of every link; rotors and payload not.
        locked: Joints that are held at 0 and leave the model.

    Returns:
        The model; its armature is the rotors' reflected inertia, in [kg m^2].

    Raises:
        RobotDescriptionError: Pinocchio cannot build a model of the URDF, the robot lacks a
            locked joint, or has a payload and no link for it.
        SettingError: A mass is negative or not finite, or the factor is not positive.
    """
    if not (math.isfinite(payload_mass) and payload_mass >= 0.0):
        raise SettingError(f"payload_mass {payload_mass!r} must be a finite number >= 0 [kg]")
    if not (math.isfinite(mass_scale) and mass_scale > 0.0):
        raise SettingError(f"mass_scale {mass_scale!r} must be a positive number")
    try:
        model = pinocchio.buildModelFromXML(description.xml, *(() if root is None else (root,)))
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise RobotDescriptionError(f"Pinocchio cannot read the robot: {reason}") from error
    held = [joint.name for joint in description.select(locked)]
    if held:
        indices = [model.getJointId(name) for name in held]
        model = pinocchio.buildReducedModel(model, indices, pinocchio.neutral(model))
    if mass_scale != 1.0:
        for index in range(model.njoints):
            body = model.inertias[index]
            scaled = pinocchio.Inertia(
                mass_scale * body.mass, body.lever, mass_scale * body.inertia
            )
            model.inertias[index] = scaled
    armature = np.zeros(model.nv)
    for joint in description.joints.values():
        if joint.name not in held:
            armature[velocity_index(model, joint.name)] = joint.reflected_inertia
    model.armature = armature
    if payload_mass:
        frame = model.frames[model.getFrameId(description.link(payload_link))]
        load = pinocchio.Inertia(payload_mass, np.zeros(3), np.zeros((3, 3)))
        model.appendBodyToJoint(frame.parentJoint, load, frame.placement)
    return model


def velocity_index(model: pinocchio.Model, joint: str) -> int:
    """Return where a joint's velocity stands in the model's velocity vector."""
    return int(model.joints[model.getJointId(joint)].idx_v)

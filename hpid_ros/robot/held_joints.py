"""Joints that something holds: a gripper's fingers, an axis with its brake on."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from hpid_ros.errors import RobotDescriptionError
from hpid_ros.robot.joints import JointDescription

Matrix = npt.NDArray[np.float64]

_MOVING_ONLY = ("axis", "limit", "dynamics", "mimic", "calibration", "safety_controller")


def hold(element: ElementTree.Element, joint: JointDescription, position: float) -> None:
    """Make a moving joint a fixed one that stands at a position.

    Args:
        element: The URDF's joint element; it is changed.
        joint: The joint.
        position: In [rad]; in [m] where it is prismatic.

    Raises:
        RobotDescriptionError: The position is beyond the joint's limits.
    """
    if not (math.isfinite(position) and joint.lower <= position <= joint.upper):
        raise RobotDescriptionError(
            f"joint {joint.name!r} cannot be held at {position}, which is not within its limits"
            f" [{joint.lower}, {joint.upper}]"
        )
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    place = np.array([float(word) for word in origin.get("xyz", "0 0 0").split()])
    turn = _rotation(*(float(word) for word in origin.get("rpy", "0 0 0").split()))
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    if joint.type == "prismatic":
        place = place + turn @ (axis * position)
    elif position:
        turn = turn @ _about(axis, position)
        origin.set("rpy", _text(_angles(turn)))
    origin.set("xyz", _text(place))
    element.set("type", "fixed")
    for tag in _MOVING_ONLY:
        for child in element.findall(tag):
            element.remove(child)


def _rotation(roll: float, pitch: float, yaw: float) -> Matrix:
    """Return the rotation of fixed-axis roll, pitch and yaw, as URDF has them."""
    x, y, z = np.eye(3)
    return _about(z, yaw) @ _about(y, pitch) @ _about(x, roll)


def _about(axis: Matrix, angle: float) -> Matrix:
    """Return the rotation about a unit axis, by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Matrix = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return turned


def _angles(rotation: Matrix) -> tuple[float, float, float]:
    """Return roll, pitch and yaw; with pitch upright, roll is 0."""
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], level)
    if level < 1e-9:
        return 0.0, pitch, math.atan2(-rotation[0, 1], rotation[1, 1])
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    return roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])


def _text(numbers: Matrix | tuple[float, ...]) -> str:
    return " ".join(repr(float(number)) for number in numbers)

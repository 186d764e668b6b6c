"""Corrections of a robot's URDF in a configuration file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import TypeVar

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.documents.sections import Section
from hpid_ros.robot.amendments import Inertial, JointAmendment, amended
from hpid_ros.robot.description import RobotDescription

_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
Known = TypeVar("Known")


def amended_by(robot: Section, description: RobotDescription) -> RobotDescription:
    """Return the robot with what a section knows better.

    ``joints`` has, by joint, any of the values of
    :class:`~hpid_ros.robot.amendments.JointAmendment`; ``links``, by link, ``mass``,
    ``center_of_mass`` and ``inertia`` (``ixx`` ...), or ``mass: 0`` for a mere frame; ``held``
    the position of each joint that does not move.

    Args:
        robot: The section, of which these three are taken.
        description: The robot as its URDF has it.

    Returns:
        The same description where the section knows nothing better.

    Raises:
        HpidError: An entry is unknown, missing or out of range; the line names its place.
    """
    joints, links, held = (robot.section(key, {}) for key in ("joints", "links", "held"))
    better = {name: _known(joints, name, _joint) for name in joints.items()}
    bodies = {name: _known(links, name, _inertial) for name in links.items()}
    places = {name: held.number(name) for name in held.items()}
    if not (better or bodies or places):
        return description
    try:
        return amended(description, better, bodies, places)
    except RobotDescriptionError as error:
        raise RobotDescriptionError(f"{robot.where}: {error}") from None


def _known(section: Section, name: str, read: Callable[[Section], Known]) -> Known:
    """Return what one entry of a section says."""
    entry = section.section(name)
    try:
        found = read(entry)
    except RobotDescriptionError as error:
        raise RobotDescriptionError(f"{entry.where}: {error}") from None
    entry.finish()
    return found


def _joint(entry: Section) -> JointAmendment:
    names = [field.name for field in fields(JointAmendment)]
    return JointAmendment(**{name: entry.number(name) for name in names if name in entry})


def _inertial(entry: Section) -> Inertial | None:
    mass = entry.number("mass", least=0.0)
    if mass == 0.0:
        return None
    center = entry.take("center_of_mass", [0.0, 0.0, 0.0])
    if not (isinstance(center, list) and len(center) == 3 and all(map(_is_number, center))):
        raise RobotDescriptionError(f"center_of_mass must be three numbers [m], not {center!r}")
    x, y, z = map(float, center)
    inertia = entry.section("inertia")
    xx, yy, zz, xy, xz, yz = (
        inertia.number(name) if name[1] == name[2] else inertia.number(name, 0.0)
        for name in _MOMENTS
    )
    inertia.finish()
    return Inertial(mass, (x, y, z), (xx, yy, zz, xy, xz, yz))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)

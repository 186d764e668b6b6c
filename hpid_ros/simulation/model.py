"""A user's URDF made ready for Bullet."""

from __future__ import annotations

import logging
from pathlib import Path
from xml.etree import ElementTree

from hpid_ros.errors import RobotDescriptionError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.meshes import find_mesh, mesh_places
from hpid_ros.simulation.rotors import add_rotors

NEGLIGIBLE_MASS = 1e-6  # [kg]
NEGLIGIBLE_INERTIA = 1e-9  # [kg m^2]

_logger = logging.getLogger(__name__)


def bullet_urdf(
    description: RobotDescription, *, is_touched: bool = True, is_shown: bool = False
) -> str:
    """Return the URDF text that Bullet gets.

    Rotors are added; links without an inertial element become weightless frames (Bullet would
    make 1 kg and 1 kg m^2 of each); mesh paths become absolute, since the text is loaded from
    a temporary file; and what nobody will see is left out, which loads many times faster.

    Args:
        description: The robot.
        is_touched: Whether the robot stands on something or meets something. Where it does not,
            a collision mesh that is not there is left out, and the log says so.
        is_shown: Whether there is a window.

    Raises:
        RobotDescriptionError: A collision mesh is not there, and the robot is touched.
    """
    robot = ElementTree.fromstring(description.xml)
    missing: list[str] = []
    for link in robot.findall("link"):
        if link.find("inertial") is None:
            _add_negligible_inertia(link)
        missing += _place_meshes(link, "collision", description.folder)
        if is_shown:
            _place_meshes(link, "visual", description.folder)
        else:
            for shape in link.findall("visual"):
                link.remove(shape)
    if missing:
        what = f"{len(missing)} collision mesh(es) missing: {missing[0]}"
        if is_touched:
            raise RobotDescriptionError(f"{what}; only on a fixed base the robot can do without")
        _logger.warning("%s; nothing touches the robot, it goes without", what)
    add_rotors(robot, description.joints.values())
    return ElementTree.tostring(robot, encoding="unicode")


def _place_meshes(link: ElementTree.Element, tag: str, folder: Path | None) -> list[str]:
    """Make the paths of a link's meshes absolute; leave out shapes whose mesh is missing.

    Returns:
        What is missing, in words.
    """
    missing = []
    for shape in link.findall(tag):
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            continue
        name = mesh.get("filename", "")
        found = find_mesh(name, folder)
        if found is None:
            link.remove(shape)
            missing.append(f"{name} of link {link.get('name')!r} ({mesh_places(name, folder)})")
        else:
            mesh.set("filename", str(found))
    return missing


def _add_negligible_inertia(link: ElementTree.Element) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", value=repr(NEGLIGIBLE_MASS))
    moments = dict.fromkeys(("ixx", "iyy", "izz"), repr(NEGLIGIBLE_INERTIA))
    ElementTree.SubElement(inertial, "inertia", moments, ixy="0", ixz="0", iyz="0")

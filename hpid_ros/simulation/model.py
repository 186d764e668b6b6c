"""A user's URDF made ready for Bullet."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.rotors import add_rotors

NEGLIGIBLE_MASS = 1e-6  # [kg]
NEGLIGIBLE_INERTIA = 1e-9  # [kg m^2]


def bullet_urdf(description: RobotDescription) -> str:
    """Return the URDF text that Bullet gets.

    Three things change: rotors are added, links without an inertial element become weightless
    frames (Bullet would make 1 kg and 1 kg m^2 of each), and mesh paths become absolute, since
    the text is loaded from a temporary file.
    """
    robot = ElementTree.fromstring(description.xml)
    for link in robot.findall("link"):
        if link.find("inertial") is None:
            _add_negligible_inertia(link)
    if description.folder is not None:
        for mesh in robot.iter("mesh"):
            mesh.set("filename", _absolute(mesh.get("filename", ""), description.folder))
    add_rotors(robot, description.joints.values())
    return ElementTree.tostring(robot, encoding="unicode")


def _add_negligible_inertia(link: ElementTree.Element) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", value=repr(NEGLIGIBLE_MASS))
    moments = dict.fromkeys(("ixx", "iyy", "izz"), repr(NEGLIGIBLE_INERTIA))
    ElementTree.SubElement(inertial, "inertia", moments, ixy="0", ixz="0", iyz="0")


def _absolute(filename: str, folder: Path) -> str:
    """Return a mesh's absolute path; unchanged where no such file is found.

    A ``package://name/path`` is looked for as ``path`` and ``name/path`` in the URDF's folder and
    in those above it, which finds it in a source tree as in an install space.
    """
    plain = filename.removeprefix("file://")
    if plain.startswith("package://"):
        plain = plain.removeprefix("package://")
        below = plain.partition("/")[2]
        tries = [base / path for base in (folder, *folder.parents) for path in (plain, below)]
    else:
        tries = [folder / plain]
    return next((str(path) for path in tries if path.is_file()), filename)

"""A user's URDF made ready for Bullet, with rotors for the reflected inertia.

Behind a gear of ratio N a rotor of inertia Jr weighs Jr N^2 at the joint; in a small arm's wrist
that is far more than the links. Bullet has no such term ("armature"), so every rotor is
simulated: a link of inertia Jr on the joint's parent, turning about the joint's axis, held to
N times the joint's speed by a gear constraint. This also yields what an armature leaves out, the
gyroscopic torque of the rotors and the reaction of their acceleration on the parent, both of
relative size 1/N. The links are added when a world loads its URDF; the URDF itself stays as the
user wrote it.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree import ElementTree

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.robot.description import JointDescription, RobotDescription
from hpid_ros.robot.meshes import find_mesh, mesh_places
from hpid_ros.simulation.bullet.connection import pybullet

ROTOR_SUFFIX = "__rotor"
# The rotor's mass belongs to the housing and is part of the parent's; this one only has to be
# positive for Bullet.
ROTOR_MASS = 1e-6  # [kg]
# Never reached: a limit would let the gear slip.
GEAR_FORCE = 1e6  # [N m]


def add_rotors(robot: ElementTree.Element, joints: Iterable[JointDescription]) -> None:
    """Add a rotor link and its joint to a URDF for every joint that has rotor inertia.

    The inertia is the same about every axis: then a turning rotor's inertia stays constant as
    seen from its parent, as that of a real, axially symmetric rotor does. The rotor has no
    collision shape.
    """
    elements = {element.get("name"): element for element in robot.findall("joint")}
    for joint in geared(joints):
        name, element = rotor_name(joint), elements[joint.name]
        inertial = ElementTree.SubElement(
            ElementTree.SubElement(robot, "link", name=name), "inertial"
        )
        ElementTree.SubElement(inertial, "mass", value=repr(ROTOR_MASS))
        moments = dict.fromkeys(("ixx", "iyy", "izz"), repr(joint.rotor_inertia))
        ElementTree.SubElement(inertial, "inertia", moments, ixy="0", ixz="0", iyz="0")
        rotor = ElementTree.SubElement(robot, "joint", name=name, type="continuous")
        ElementTree.SubElement(rotor, "parent", link=joint.parent)
        ElementTree.SubElement(rotor, "child", link=name)
        for tag in ("origin", "axis"):
            found = element.find(tag)
            if found is not None:
                rotor.append(copy.deepcopy(found))


def couple_rotors(
    client: int, body: int, indices: Mapping[str, int], joints: Iterable[JointDescription]
) -> None:
    """Gear each rotor to its joint.

    The constraint acts on velocities alone (erp 0): no position of a rotor is ever read, so its
    drift against the joint's, some 1e-6 rad in half a second, means nothing.
    """
    for joint in geared(joints):
        gear = pybullet.createConstraint(
            body,
            indices[joint.name],
            body,
            indices[rotor_name(joint)],
            jointType=pybullet.JOINT_GEAR,
            jointAxis=joint.axis,
            parentFramePosition=(0.0, 0.0, 0.0),
            childFramePosition=(0.0, 0.0, 0.0),
            physicsClientId=client,
        )
        # Bullet's row reads: joint velocity + gearRatio * rotor velocity = 0.
        pybullet.changeConstraint(
            gear,
            gearRatio=-1.0 / joint.gear_ratio,
            maxForce=GEAR_FORCE,
            erp=0.0,
            physicsClientId=client,
        )


def geared(joints: Iterable[JointDescription]) -> tuple[JointDescription, ...]:
    """Return the joints that have a rotor."""
    return tuple(joint for joint in joints if joint.rotor_inertia > 0.0)


def rotor_name(joint: JointDescription) -> str:
    """Return the name of a joint's rotor, of its link as of its joint."""
    return joint.name + ROTOR_SUFFIX


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
    """Make the paths of a link's meshes absolute; leave out shapes whose mesh is missing."""
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

"""Reflected rotor inertia, with rotors.

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
from collections.abc import Iterable, Mapping
from xml.etree import ElementTree

from hpid_ros.robot.joints import JointDescription
from hpid_ros.simulation.bullet import pybullet

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

    Args:
        robot: Root element of the URDF; it is changed.
        joints: Joints of the robot.
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

    Args:
        client: PyBullet's client.
        body: The robot.
        indices: Bullet's joint index by joint name.
        joints: Joints of the robot.
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

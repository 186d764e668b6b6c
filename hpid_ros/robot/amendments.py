"""Corrections of a URDF: what is known of a robot better than its file says it.

URDFs that go from hand to hand seldom have rotor inertias, and often no friction, the same effort
limit for every joint, or inertias that somebody made up. What is known better is laid over the
URDF here, as a new URDF text: whoever reads it, Bullet, Pinocchio or a controller with
a model, sees the same robot, and nobody else has to know.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.base.resources import package_uri
from hpid_ros.documents.records import Record, quantity
from hpid_ros.robot.description import DRAKE_NAMESPACE, JointDescription, RobotDescription
from hpid_ros.robot.meshes import find_mesh

_MOVING_ONLY = ("axis", "limit", "dynamics", "mimic", "calibration", "safety_controller")


def hold(element: ElementTree.Element, joint: JointDescription, position: float) -> None:
    """Make a moving joint a fixed one that stands at a position."""
    from scipy.spatial.transform import Rotation  # slow to import, and only needed here

    if not (math.isfinite(position) and joint.lower <= position <= joint.upper):
        raise RobotDescriptionError(
            f"joint {joint.name!r} cannot be held at {position}, which is not within its limits"
            f" [{joint.lower}, {joint.upper}]"
        )
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    place = np.array([float(word) for word in origin.get("xyz", "0 0 0").split()])
    angles = [float(word) for word in origin.get("rpy", "0 0 0").split()]
    turn = Rotation.from_euler("xyz", angles)  # about fixed axes
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    if joint.type == "prismatic":
        place = place + turn.as_matrix() @ (axis * position)
    elif position:
        turn = turn * Rotation.from_rotvec(axis * position)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # pitch upright: any roll will do
            origin.set("rpy", _text(turn.as_euler("xyz")))
    origin.set("xyz", _text(place))
    element.set("type", "fixed")
    for tag in _MOVING_ONLY:
        for child in element.findall(tag):
            element.remove(child)


def _text(numbers: Numbers) -> str:
    return " ".join(repr(float(number)) for number in numbers)


ElementTree.register_namespace("drake", DRAKE_NAMESPACE)

_TRIANGLE_SLACK = 1e-3
"""Share of the largest principal moment by which published, rounded inertias may break the
triangle inequality."""


@dataclass(frozen=True)
class JointAmendment(Record):
    """What is known better of one joint; what is left out stays as the URDF has it."""

    rotor_inertia: float | None = quantity(
        "Of the motor's rotor about its own axis", "kg m^2", default=None, least=0.0
    )
    gear_ratio: float | None = quantity(
        "Turns of the rotor for one turn of the joint, not 0", default=None
    )
    damping: float | None = quantity("Viscous friction", "N m s/rad", default=None, least=0.0)
    friction: float | None = quantity("Coulomb friction", "N m", default=None, least=0.0)
    effort: float | None = quantity("Largest absolute effort", "N m", default=None, above=0.0)
    velocity: float | None = quantity(
        "Largest absolute velocity", "rad/s", default=None, above=0.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gear_ratio == 0.0:
            raise SettingError("gear_ratio must not be 0")

    def given(self) -> dict[str, float]:
        """Return what is known, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class Inertial:
    """Mass and inertia of one link; they replace its ``inertial`` element as a whole."""

    mass: float  # [kg]
    center_of_mass: tuple[float, float, float]  # [m] in the link's frame
    inertia: tuple[float, float, float, float, float, float]  # [kg m^2]

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.mass, *self.center_of_mass, *self.inertia))):
            raise RobotDescriptionError("mass, centre and inertia must be finite numbers")
        if self.mass <= 0.0:
            raise RobotDescriptionError(f"mass {self.mass} kg must be above 0")
        moments = principal_moments(self.inertia)
        if not is_possible(moments):
            shown = ", ".join(f"{moment:.4g}" for moment in moments)
            raise RobotDescriptionError(
                f"no body has the principal moments {shown} kg m^2: each must be above 0, and"
                " none above the sum of the others"
            )


def principal_moments(
    inertia: tuple[float, float, float, float, float, float],
) -> tuple[float, float, float]:
    """Return the principal moments of inertia, the least first, in [kg m^2]."""
    xx, yy, zz, xy, xz, yz = inertia
    least, middle, most = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return float(least), float(middle), float(most)


def is_possible(moments: tuple[float, float, float]) -> bool:
    """Return whether some body has these principal moments, sorted, in [kg m^2]."""
    least, middle, most = moments
    return least > 0.0 and most <= (least + middle) * (1.0 + _TRIANGLE_SLACK)


def amended(
    description: RobotDescription,
    joints: Mapping[str, JointAmendment],
    links: Mapping[str, Inertial | None],
    held: Mapping[str, float],
) -> RobotDescription:
    """Return a robot with what is known better.

    Meshes of packages get their ``package://`` name and others their absolute path, since the
    new text stands in no folder.
    """
    description.select(list(joints))
    description.select(list(held))
    robot = ElementTree.fromstring(description.xml)
    elements = {element.get("name", ""): element for element in robot.findall("joint")}
    for name, amendment in joints.items():
        _amend_joint(robot, elements[name], amendment)
    bodies = {element.get("name", ""): element for element in robot.findall("link")}
    for name, inertial in links.items():
        _replace_inertial(bodies[description.link(name)], inertial)
    for name, position in held.items():
        hold(elements[name], description.joints[name], position)
    for mesh in robot.iter("mesh"):
        found = find_mesh(mesh.get("filename", ""), description.folder)
        if found is not None:
            mesh.set("filename", package_uri(found))
    return RobotDescription.load(ElementTree.tostring(robot, encoding="unicode"))


def _amend_joint(
    robot: ElementTree.Element, joint: ElementTree.Element, amendment: JointAmendment
) -> None:
    given = amendment.given()
    for tag, names in (("limit", ("effort", "velocity")), ("dynamics", ("damping", "friction"))):
        for name in names:
            if name in given:
                _child(joint, tag).set(name, repr(given[name]))
    rotor = {name: given[name] for name in ("rotor_inertia", "gear_ratio") if name in given}
    if rotor:
        actuator = _actuator(robot, joint.get("name", ""))
        for name, value in rotor.items():
            _child(actuator, f"{{{DRAKE_NAMESPACE}}}{name}").set("value", repr(value))


def _actuator(robot: ElementTree.Element, joint: str) -> ElementTree.Element:
    """Return the actuator of a joint; where there is none it is added."""
    for transmission in reversed(robot.findall("transmission")):
        moved = transmission.find("joint")
        if moved is not None and moved.get("name") == joint:
            return _child(transmission, "actuator", name=f"{joint}_motor")
    transmission = ElementTree.SubElement(robot, "transmission", name=f"{joint}_transmission")
    kind = ElementTree.SubElement(transmission, "type")
    kind.text = "transmission_interface/SimpleTransmission"
    ElementTree.SubElement(transmission, "joint", name=joint)
    return _child(transmission, "actuator", name=f"{joint}_motor")


def _replace_inertial(link: ElementTree.Element, inertial: Inertial | None) -> None:
    for old in link.findall("inertial"):
        link.remove(old)
    if inertial is None:
        return
    new = ElementTree.SubElement(link, "inertial")
    center = " ".join(map(repr, inertial.center_of_mass))
    ElementTree.SubElement(new, "origin", xyz=center, rpy="0 0 0")
    ElementTree.SubElement(new, "mass", value=repr(inertial.mass))
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    values = {name: repr(value) for name, value in zip(names, inertial.inertia, strict=True)}
    ElementTree.SubElement(new, "inertia", values)


def _child(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    found = parent.find(tag)
    return ElementTree.SubElement(parent, tag, attributes) if found is None else found

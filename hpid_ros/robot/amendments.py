"""A robot as a configuration file says it, with corrections of its URDF, and its review.

URDFs that go from hand to hand seldom have rotor inertias, and often no friction, the same effort
limit for every joint, or inertias that somebody made up. What is known better is laid over the
URDF here, as a new URDF text: whoever reads it, Bullet, Pinocchio or a controller with
a model, sees the same robot, and nobody else has to know.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.resources import package_uri
from hpid_ros.base.units import of_slide
from hpid_ros.robot import mending
from hpid_ros.robot.description import (
    DRAKE_NAMESPACE,
    UNDRIVABLE_TYPES,
    RobotDescription,
    find_mesh,
    mesh_places,
)
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.joint_description import JointDescription


def hold(element: ElementTree.Element, joint: JointDescription, position: float) -> None:
    """Make a moving joint a fixed one that stands at a position within its limits."""
    if not (math.isfinite(position) and joint.lower <= position <= joint.upper):
        raise RobotDescriptionError(
            f"joint {joint.name!r} cannot be held at {position}, which is not within its limits"
            f" [{joint.lower}, {joint.upper}]"
        )
    mending.hold(element, position)


@dataclass(frozen=True)
class JointAmendment(Record):
    """What is known better of one joint; what is left out stays as the URDF has it."""

    rotor_inertia: float | None = quantity(
        "Inertia of the motor's rotor about its own axis", "kg m^2", default=None, least=0.0
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
        return {name: value for name, value in vars(self).items() if value is not None}


def principal_moments(
    xx: float, yy: float, zz: float, xy: float, xz: float, yz: float
) -> tuple[float, float, float]:
    """Return the principal moments of inertia, the least first, in [kg m^2]."""
    least, middle, most = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return float(least), float(middle), float(most)


def is_possible(moments: tuple[float, float, float]) -> bool:
    """Return whether some body has these principal moments, sorted, in [kg m^2].

    The engines give no slack either.
    """
    least, middle, most = moments
    return least > 0.0 and most <= least + middle


def amended(
    description: RobotDescription,
    joints: Mapping[str, JointAmendment],
    links: Mapping[str, LinkAmendment],
    held: Mapping[str, float],
) -> RobotDescription:
    """Return a robot with what is known better.

    Meshes of packages get their ``package://`` name and others their absolute path, since the
    new text stands in no folder.
    """
    description.named(name for name in joints if name not in description.held)
    robot = ElementTree.fromstring(description.xml)
    elements = {element.get("name", ""): element for element in robot.findall("joint")}
    held = _yet_to_hold(description, held, elements)
    for name, amendment in joints.items():
        _amend_joint(robot, elements[name], amendment)
    bodies = {element.get("name", ""): element for element in robot.findall("link")}
    for name, link in links.items():
        _replace_inertial(bodies[description.link(name)], link)
    for name, position in held.items():
        if name in description.joints:
            hold(elements[name], description.joints[name], position)
        else:
            mending.hold(elements[name], 0.0)
    for mesh in robot.iter("mesh"):
        found = find_mesh(mesh.get("filename", ""), description.folder)
        if found is not None:
            mesh.set("filename", package_uri(found))
    known = RobotDescription.load(ElementTree.tostring(robot, encoding="unicode"))
    return replace(known, mends=description.mends)


def _yet_to_hold(
    description: RobotDescription,
    held: Mapping[str, float],
    elements: Mapping[str, ElementTree.Element],
) -> dict[str, float]:
    """Return the joints that are to be held and move yet, also those of no type that is driven."""
    found = {}
    for name, position in held.items():
        if name in elements and elements[name].get("type") in UNDRIVABLE_TYPES:
            if position != 0.0:
                raise RobotDescriptionError(
                    f"joint {name!r} has more than one position: it can be held at 0 alone"
                )
        elif description.held.get(name) == position:
            continue
        else:
            description.named([name])
        found[name] = position
    return found


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


def _replace_inertial(element: ElementTree.Element, link: LinkAmendment) -> None:
    for old in element.findall("inertial"):
        element.remove(old)
    if link.inertia is None:
        return
    moments = principal_moments(*vars(link.inertia).values())
    if not is_possible(moments):
        shown = ", ".join(f"{moment:.4g}" for moment in moments)
        raise RobotDescriptionError(
            f"links.{element.get('name')}: no body has the principal moments {shown} kg m^2: each"
            " must be above 0, and none above the sum of the others"
        )
    new = ElementTree.SubElement(element, "inertial")
    center = " ".join(map(repr, link.center_of_mass))
    ElementTree.SubElement(new, "origin", xyz=center, rpy="0 0 0")
    ElementTree.SubElement(new, "mass", value=repr(link.mass))
    values = {name: repr(value) for name, value in vars(link.inertia).items()}
    ElementTree.SubElement(new, "inertia", values)


def _child(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    found = parent.find(tag)
    return ElementTree.SubElement(parent, tag, attributes) if found is None else found


_ALIKE = 4
"""So many joints or links seldom share a number by chance."""


class Remark(NamedTuple):
    """One thing to know before such a robot is simulated."""

    names: tuple[str, ...]  # joints or links that it is about
    text: str  # what is the matter
    is_unsafe: bool = False  # whether nothing would limit a robot that is driven by it


def review(description: RobotDescription) -> list[Remark]:
    """Return what to know of a robot before it is simulated."""
    robot = ElementTree.fromstring(description.xml)
    parts = _joints, _links, _meshes
    return [remark for part in parts for remark in part(description, robot)]


def _joints(description: RobotDescription, robot: ElementTree.Element) -> Iterator[Remark]:
    joints = list(description.joints.values())
    lacks: list[tuple[Callable[[JointDescription], bool], str]] = [
        (lambda j: math.isinf(j.effort), "no effort limit"),
        (lambda j: math.isinf(j.velocity), "no velocity limit"),
        (lambda j: j.damping == j.friction == 0.0, "no friction, neither viscous nor Coulomb"),
        (
            lambda j: j.rotor_inertia == 0.0,
            "no rotor inertia; behind a gear the rotor is often most of a joint's inertia",
        ),
    ]
    for is_lacking, text in lacks:
        names = tuple(joint.name for joint in joints if is_lacking(joint))
        if names:
            yield Remark(names, text, is_unsafe=text.endswith("limit"))
    for limit, unit in (("effort", "N m"), ("velocity", "rad/s"), ("damping", "N m s/rad")):
        values = {joint.name: getattr(joint, limit) for joint in joints}
        if len(joints) >= _ALIKE and len(set(values.values())) == 1:
            value = next(iter(values.values()))
            if 0.0 < value < math.inf:
                units = {of_slide(unit) if joint.is_slide else unit: None for joint in joints}
                text = f"{limit} {value:g} {' or '.join(units)} for every joint: a placeholder?"
                yield Remark(tuple(values), text)
    mimics = [each for each in robot.findall("joint") if each.find("mimic") is not None]
    names = tuple(joint.get("name", "") for joint in mimics)
    if set(names) & set(description.joints):
        yield Remark(names, "mimics another joint: here it moves on its own, hold it or drive it")


def _links(description: RobotDescription, robot: ElementTree.Element) -> Iterator[Remark]:
    moved = {joint.child for joint in description.joints.values()}
    shared: dict[tuple[float, ...], list[str]] = defaultdict(list)
    bare, weightless = [], []
    for link in robot.findall("link"):
        name = link.get("name", "")
        inertial = link.find("inertial")
        if inertial is None:
            bare += [name] if name in moved else []
            continue
        moments = _moments(inertial)
        has_mass = _value(inertial.find("mass"), "value") > 0.0
        if name != description.root:
            weightless += [name] if not has_mass and any(moments) else []
        shared[moments].append(name)
    texts = (
        (bare, "moved by a joint, but without mass: what hangs on it must have some"),
        (weightless, "inertia without mass: the inertia is simulated all the same"),
    )
    yield from (Remark(tuple(names), text) for names, text in texts if names)
    number = sum(map(len, shared.values()))
    for alike, names in shared.items():
        if len(names) >= max(_ALIKE, number / 2) and any(alike):
            shown = " ".join(f"{moment:g}" for moment in alike)
            yield Remark(tuple(names), f"the same moments, {shown} kg m^2: a placeholder?")


def _moments(inertial: ElementTree.Element) -> tuple[float, float, float]:
    tensor = inertial.find("inertia")
    xx, yy, zz, xy, xz, yz = (
        _value(tensor, name) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    if xy == xz == yz == 0.0:  # as written, without the solver's rounding
        return min(xx, yy, zz), sorted([xx, yy, zz])[1], max(xx, yy, zz)
    return principal_moments(xx, yy, zz, xy, xz, yz)


def _value(element: ElementTree.Element | None, name: str) -> float:
    text = "0" if element is None else element.get(name, "0")
    try:
        return float(text)
    except ValueError:
        raise RobotDescriptionError(f"{name}={text!r} of a link is not a number") from None


def _meshes(description: RobotDescription, robot: ElementTree.Element) -> Iterator[Remark]:
    for link in robot.findall("link"):
        for mesh in link.findall("collision/geometry/mesh"):
            name = mesh.get("filename", "")
            if find_mesh(name, description.folder) is None:
                where = mesh_places(name, description.folder)
                text = f"its collision mesh {name} is missing ({where})"
                yield Remark((link.get("name", ""),), text)


@dataclass(frozen=True)
class Wheels(Record):
    """The two driven wheels of a base."""

    left_wheel: str = quantity("Joint of the left wheel")
    right_wheel: str = quantity("Joint of the right wheel")
    wheel_radius: float | None = quantity(
        "Radius of both wheels; as the URDF has it if left out", "m", default=None, above=0.0
    )
    wheel_separation: float | None = quantity(
        "Between their contacts; as the URDF has it if left out", "m", default=None, above=0.0
    )

    @classmethod
    def of(cls, drive: DifferentialDrive) -> Wheels:
        """Return what a file says to give this drive."""
        return cls(drive.left, drive.right, drive.radius, drive.separation)

    def drive(self, description: RobotDescription) -> DifferentialDrive:
        return DifferentialDrive.of(description, *vars(self).values())


@dataclass(frozen=True)
class Moments(Record):
    """Moments and products of inertia about the centre of mass, in axes parallel to the link's."""

    ixx: float = quantity("Moment about x", "kg m^2")
    iyy: float = quantity("Moment about y", "kg m^2")
    izz: float = quantity("Moment about z", "kg m^2")
    ixy: float = quantity("Product of x and y", "kg m^2", default=0.0)
    ixz: float = quantity("Product of x and z", "kg m^2", default=0.0)
    iyz: float = quantity("Product of y and z", "kg m^2", default=0.0)


@dataclass(frozen=True)
class LinkAmendment(Record):
    """Mass and inertia of one link; they replace what the URDF says of them as a whole."""

    mass: float = quantity("Its mass; 0 makes it a mere frame", "kg", least=0.0)
    center_of_mass: tuple[float, float, float] = quantity(
        "In the link's frame", "m", default=(0.0, 0.0, 0.0)
    )
    inertia: Moments | None = quantity("Needed where there is a mass", default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mass and self.inertia is None:
            raise SettingError("inertia is missing")
        if self.inertia is not None and not self.mass:
            raise SettingError("inertia must be left out where mass is 0")


@dataclass(frozen=True)
class RobotSection(Record):
    """The robot of an experiment, and how it stands at the start."""

    description: str = quantity(
        "Its URDF: a path, also in the share folder, or package:// and a path"
    )
    driven: tuple[str, ...] = quantity(
        "Its driven joints; those of the reference, else all that move, if left out", default=()
    )
    payload: float = quantity("Mass in its hand", "kg", default=0.0, least=0.0)
    fixed_base: bool = quantity("Whether its root is held, without a ground", default=False)
    initial_positions: Mapping[str, float] = quantity(
        "Positions at the start, by joint; others are at 0, or at the limit nearest to it",
        "rad",
        factory=dict,
    )
    base: Wheels | None = quantity("The wheels of its base", default=None)
    joints: Mapping[str, JointAmendment] = quantity(
        "What is known better than the URDF says it, by joint", factory=dict
    )
    links: Mapping[str, LinkAmendment] = quantity(
        "What is known better than the URDF says it, by link", factory=dict
    )
    held: Mapping[str, float] = quantity(
        "Joints that do not move, and where they stand", "rad", factory=dict
    )

    def load(self, load: Callable[[str], RobotDescription]) -> RobotDescription:
        """Return the robot with what is known better of it."""
        plain = load(self.description)
        if not (self.joints or self.links or self.held or plain.mends):
            return plain
        try:
            return amended(plain, self.joints, self.links, self.held)
        except RobotDescriptionError as error:
            raise RobotDescriptionError(f"robot: {error}") from None

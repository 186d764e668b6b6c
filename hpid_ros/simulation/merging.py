"""Links that never move against their parents, made one with them."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from hpid_ros.base.units import Numbers
from hpid_ros.robot.description import end_of, origin_of
from hpid_ros.robot.mending import inertia_of, mass_of


class LinkPlacement(NamedTuple):
    """Where the frame of a merged link is."""

    link: str  # that it is part of now
    position: tuple[float, float, float]  # [m] in that link's frame
    orientation: tuple[float, float, float, float]  # quaternion x, y, z, w


class _Frame(NamedTuple):
    turn: Numbers  # rotation, (3, 3)
    place: Numbers  # [m], (3,)

    @classmethod
    def of(cls, element: ElementTree.Element) -> _Frame:
        place, angles = origin_of(element)
        return cls(Rotation.from_euler("xyz", angles).as_matrix(), np.array(place))

    def then(self, other: _Frame) -> _Frame:
        return _Frame(self.turn @ other.turn, self.place + self.turn @ other.place)

    def write(self, element: ElementTree.Element) -> None:
        """Make it the origin of an element."""
        origin = element.find("origin")
        if origin is None:
            origin = ElementTree.SubElement(element, "origin")
        angles = Rotation.from_matrix(self.turn).as_euler("xyz", suppress_warnings=True)
        origin.set("xyz", " ".join(map(repr, self.place.tolist())))
        origin.set("rpy", " ".join(map(repr, angles.tolist())))


def merge_fixed(robot: ElementTree.Element, kept: Collection[str]) -> dict[str, LinkPlacement]:
    """Merge links on fixed joints into what they are fixed to, in place.

    A link stays if it is ``kept`` by name, or touches things with a surface of its own.
    """
    links = {each.get("name", ""): each for each in robot.findall("link")}
    below: dict[str, list[ElementTree.Element]] = {name: [] for name in links}
    for joint in robot.findall("joint"):
        below[end_of(joint, "parent")].append(joint)
    moved = {end_of(joint, "child") for joint in robot.findall("joint")}
    (root,) = links.keys() - moved
    placed: dict[str, tuple[str, _Frame]] = {}
    pending = [root]
    while pending:
        name = pending.pop()
        into, frame = placed.get(name, (name, _Frame(np.eye(3), np.zeros(3))))
        for joint in below[name]:
            child = end_of(joint, "child")
            pending.append(child)
            whole = frame.then(_Frame.of(joint))
            if joint.get("type") == "fixed" and _may_merge(links[child], links[into], kept):
                placed[child] = (into, whole)
                _add(links[into], links[child], whole)
                robot.remove(links[child])
                robot.remove(joint)
            elif into != name:
                for parent in joint.findall("parent"):
                    parent.set("link", into)
                whole.write(joint)
    return {name: _placement(*each) for name, each in placed.items()}


def _placement(link: str, frame: _Frame) -> LinkPlacement:
    x, y, z, w = Rotation.from_matrix(frame.turn).as_quat().tolist()
    place_x, place_y, place_z = frame.place.tolist()
    return LinkPlacement(link, (place_x, place_y, place_z), (x, y, z, w))


def _may_merge(
    child: ElementTree.Element, into: ElementTree.Element, kept: Collection[str]
) -> bool:
    if child.get("name", "") in kept:
        return False
    return child.find("collision") is None or _surface(child) == _surface(into)


def _surface(link: ElementTree.Element) -> list[tuple[str, dict[str, str]]]:
    contact = link.find("contact")
    return [] if contact is None else [(each.tag, each.attrib) for each in contact]


def _add(into: ElementTree.Element, child: ElementTree.Element, frame: _Frame) -> None:
    """Give a link what another one has that is fixed at a frame of it."""
    for tag in ("collision", "visual"):
        for shape in child.findall(tag):
            frame.then(_Frame.of(shape)).write(shape)
            into.append(shape)
    bodies = [_body(into, _Frame(np.eye(3), np.zeros(3))), _body(child, frame)]
    mass = sum(each[0] for each in bodies)
    if not (mass or any(each[2].any() for each in bodies)):
        return
    centre = sum(m * at for m, at, _ in bodies) / mass if mass else bodies[0][1]
    tensor = np.zeros((3, 3))
    for m, at, moments in bodies:
        arm = at - centre
        tensor += moments + m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    for old in into.findall("inertial"):
        into.remove(old)
    inertial = ElementTree.SubElement(into, "inertial")
    _Frame(np.eye(3), np.asarray(centre)).write(inertial)
    ElementTree.SubElement(inertial, "mass", value=repr(float(mass)))
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2)}
    names["iyz"] = (1, 2)
    values = {name: repr(float(tensor[place])) for name, place in names.items()}
    ElementTree.SubElement(inertial, "inertia", values)


def _body(link: ElementTree.Element, frame: _Frame) -> tuple[float, Numbers, Numbers]:
    """Return mass, centre of mass, and moments about it, in the axes that a frame is given in."""
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    own = frame.then(_Frame.of(inertial))
    element = inertial.find("inertia")
    moments = None if element is None else inertia_of(element)
    tensor = np.zeros((3, 3)) if moments is None else moments
    return mass_of(link), own.place, own.turn @ tensor @ own.turn.T

"""A review of a URDF: what it does not say, or hardly can mean, of the robot that it describes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import NamedTuple
from xml.etree import ElementTree

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.base.units import of_slide
from hpid_ros.robot.amendments import is_possible, principal_moments
from hpid_ros.robot.description import JointDescription, RobotDescription
from hpid_ros.robot.meshes import find_mesh, mesh_places

_ALIKE = 4
"""So many joints or links seldom share a number by chance."""


class Remark(NamedTuple):
    """One thing to know before such a robot is simulated."""

    names: tuple[str, ...]  # joints or links that it is about
    text: str  # what is the matter


def review(description: RobotDescription) -> list[Remark]:
    """Return what to know of a robot before it is simulated."""
    robot = ElementTree.fromstring(description.xml)
    parts = _joints, _links, _meshes
    return [remark for part in parts for remark in part(description, robot)]


def _joints(description: RobotDescription, robot: ElementTree.Element) -> Iterator[Remark]:
    joints = list(description.joints.values())
    lacks: list[tuple[Callable[[JointDescription], bool], str]] = [
        (lambda j: not 0.0 < j.effort < float("inf"), "no effort limit"),
        (lambda j: not 0.0 < j.velocity < float("inf"), "no velocity limit"),
        (lambda j: j.damping == j.friction == 0.0, "no friction, neither viscous nor Coulomb"),
        (lambda j: j.rotor_inertia == 0.0, "no rotor inertia: behind a gear it often is most"),
    ]
    for is_lacking, text in lacks:
        names = tuple(joint.name for joint in joints if is_lacking(joint))
        if names:
            yield Remark(names, text)
    for limit, unit in (("effort", "N m"), ("velocity", "rad/s"), ("damping", "N m s/rad")):
        values = {joint.name: getattr(joint, limit) for joint in joints}
        if len(joints) >= _ALIKE and len(set(values.values())) == 1:
            value = next(iter(values.values()))
            if 0.0 < value < float("inf"):
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
    bare, weightless, impossible = [], [], []
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
            impossible += [name] if has_mass and not is_possible(moments) else []
        shared[moments].append(name)
    texts = (
        (bare, "moved by a joint, but without mass: what hangs on it must have some"),
        (weightless, "inertia without mass: it counts, though nothing is there"),
        (impossible, "moments of inertia that no body has"),
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
    return principal_moments((xx, yy, zz, xy, xz, yz))


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

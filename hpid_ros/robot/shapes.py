"""The shapes of a URDF, as they are drawn: its visual elements, or what stands in for them.

Where a link's visual meshes are not there, or nobody here can read them, its collision shapes
stand in; of a robot of which nothing can be drawn, its bones do: straight ones from each joint to
the next.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.base.units import Numbers, Vector
from hpid_ros.robot.description import RobotDescription, find_mesh, mesh_places

_logger = logging.getLogger(__name__)

PLAIN: Vector = (0.78, 0.80, 0.84)
"""Colour of what has none."""
_JOINT: Vector = (0.93, 0.45, 0.13)
_BONE_SHARE = 0.12  # radius of a bone, over its length
_SHORTEST_BONE = 0.005  # [m]


class Body(NamedTuple):
    """A solid as it is drawn."""

    form: str  # box, sphere, cylinder (along its z) or mesh
    size: tuple[float, ...]  # [m] a box's edges; a sphere's radius; a cylinder's radius, length
    color: Vector = PLAIN  # red, green and blue, each in [0, 1]
    mesh: Path | None = None  # file of a mesh


class Shape(NamedTuple):
    """A body on a link."""

    link: str  # name of the link
    body: Body
    position: Numbers  # [m] its centre in the link's frame, (3,)
    rotation: Numbers  # its axes there as columns, (3, 3)


def drawn_shapes(description: RobotDescription, readable: Collection[str]) -> tuple[Shape, ...]:
    """Return what is drawn of a robot, link by link."""
    robot = ElementTree.fromstring(description.xml)
    colors = {each.get("name", ""): color for each in robot.findall("material")
              if (color := _color(each)) is not None}  # fmt: skip
    shapes: list[Shape] = []
    unread: list[str] = []
    for link in robot.findall("link"):
        reader = _LinkReader(link, description.folder, colors, readable)
        shapes += reader.shapes()
        unread += reader.unread
    if unread:
        more = f" and {len(unread) - 1} more" if len(unread) > 1 else ""
        _logger.warning("cannot draw mesh %s%s", unread[0], more)
    return tuple(shapes) or tuple(_bones(robot))


class _LinkReader:
    """Reads the shapes of one link."""

    def __init__(
        self,
        link: ElementTree.Element,
        folder: Path | None,
        colors: Mapping[str, Vector],
        readable: Collection[str],
    ) -> None:
        self._link, self._folder = link, folder
        self._name = link.get("name", "")
        self._colors, self._readable = colors, readable
        self.unread: list[str] = []

    def shapes(self) -> list[Shape]:
        """Return the visual shapes, or if one cannot be drawn the collision shapes that can."""
        try:
            visual = [self._shape(each) for each in self._link.findall("visual")]
            whole = [each for each in visual if each is not None]
            if len(whole) == len(visual):
                return whole
            collision = [self._shape(each) for each in self._link.findall("collision")]
        except ValueError as error:
            line = f"link {self._name!r} has a shape that cannot be drawn: {error}"
            raise RobotDescriptionError(line) from None
        return [each for each in collision if each is not None] or whole

    def _shape(self, element: ElementTree.Element) -> Shape | None:
        form = next(iter(element.findall("geometry/*")), None)
        body = None if form is None else self._body(form, self._paint(element))
        return None if body is None else Shape(self._name, body, *_frame(element))

    def _body(self, form: ElementTree.Element, color: Vector) -> Body | None:
        if form.tag in _SIZES:
            size = tuple(value for name in _SIZES[form.tag] for value in _numbers(form, name))
            return Body(form.tag, size, color)
        name = form.get("filename", "") if form.tag == "mesh" else ""
        found = find_mesh(name, self._folder) if name else None
        if found is None or found.suffix.lower() not in self._readable:
            why = mesh_places(name, self._folder) if found is None else "of this format"
            self.unread.append(f"{name or form.tag} of link {self._name!r} ({why})")
            return None
        return Body("mesh", _numbers(form, "scale", "1 1 1"), color, found)

    def _paint(self, element: ElementTree.Element) -> Vector:
        material = element.find("material")
        if material is None:
            return PLAIN
        own = _color(material)
        return own if own is not None else self._colors.get(material.get("name", ""), PLAIN)


_SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}


def _bones(robot: ElementTree.Element) -> Iterator[Shape]:
    """Yield a bone from each link's frame to each joint below it, and the joint as a ball."""
    for joint in robot.findall("joint"):
        parent = joint.find("parent")
        position, _ = _frame(joint)
        length = float(np.linalg.norm(position))
        if parent is None or length < _SHORTEST_BONE:
            continue
        link, radius = parent.get("link", ""), _BONE_SHARE * length
        turn, _ = Rotation.align_vectors([position], [[0.0, 0.0, 1.0]])
        yield Shape(link, Body("cylinder", (radius, length)), position / 2.0, turn.as_matrix())
        yield Shape(link, Body("sphere", (1.3 * radius,), _JOINT), position, np.eye(3))


def _frame(element: ElementTree.Element) -> tuple[Numbers, Numbers]:
    """Return origin and axes that an element's origin says."""
    origin = element.find("origin")
    if origin is None:
        return np.zeros(3), np.eye(3)
    angles = _numbers(origin, "rpy", "0 0 0")
    turn = Rotation.from_euler("xyz", angles).as_matrix()
    return np.array(_numbers(origin, "xyz", "0 0 0")), turn


def _color(material: ElementTree.Element) -> Vector | None:
    color = material.find("color")
    if color is None:
        return None
    red, green, blue, *_ = _numbers(color, "rgba")
    return red, green, blue


def _numbers(element: ElementTree.Element, attribute: str, default: str = "") -> tuple[float, ...]:
    return tuple(float(word) for word in (element.get(attribute) or default).split())

"""The shapes of a URDF, as they are drawn: its visual elements, or what stands in for them.

Where a link's visual meshes are not there, or nobody here can read them, its collision shapes
stand in; of a robot of which nothing can be drawn, its bones do: straight ones from each joint to
the next.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.base.units import Numbers
from hpid_ros.robot.description import (
    RobotDescription,
    end_of,
    find_mesh,
    mesh_places,
    numbers_of,
    origin_of,
)

_logger = logging.getLogger(__name__)

Color = tuple[float, float, float, float]  # red, green, blue and opacity, each in [0, 1]
PLAIN: Color = (0.78, 0.80, 0.84, 1.0)
"""Colour of what has none."""
_JOINT: Color = (0.93, 0.45, 0.13, 1.0)
_BONE_SHARE = 0.12  # radius of a bone, over its length
_SHORTEST_BONE = 0.005  # [m]
_SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}
_MESHES = (".obj", ".stl")  # suffixes of the files that are read


class Shape(NamedTuple):
    """A solid on a link, as it is drawn."""

    link: str  # name of the link
    form: str  # box, sphere, cylinder (along its z) or mesh
    size: tuple[float, ...]  # [m] a box's edges; a sphere's radius; a cylinder's radius, length
    color: Color = PLAIN
    position: Numbers = np.zeros(3)  # [m] its centre in the link's frame, (3,)
    rotation: Numbers = np.eye(3)  # its axes there as columns, (3, 3)
    mesh: Path | None = None  # file of a mesh, whose size are the scales of its axes


def drawn_shapes(description: RobotDescription) -> tuple[Shape, ...]:
    """Return what is drawn of a robot, link by link."""
    robot = ElementTree.fromstring(description.xml)
    colors = {each.get("name", ""): _color(each) for each in robot.findall("material")}
    shapes: list[Shape] = []
    unread: list[str] = []
    for link in robot.findall("link"):
        name = link.get("name", "")

        def read(kind: str, link: Element = link, name: str = name) -> list[Shape | None]:
            found = link.findall(kind)
            return [_shape(name, each, description.folder, colors, unread) for each in found]

        try:
            drawn = read("visual")
            if None in drawn:
                drawn = [each for each in read("collision") if each] or drawn
        except ValueError as error:
            line = f"link {name!r} has a shape that cannot be drawn: {error}"
            raise RobotDescriptionError(line) from None
        shapes += [each for each in drawn if each is not None]
    if unread:
        more = f" and {len(unread) - 1} more" if len(unread) > 1 else ""
        _logger.warning("cannot draw mesh %s%s", unread[0], more)
    return tuple(shapes) or tuple(_bones(robot))


def _shape(
    link: str,
    element: Element,
    folder: Path | None,
    colors: Mapping[str, Color | None],
    unread: list[str],
) -> Shape | None:
    """Return a visual or a collision element; None, and a line more, if it cannot be read."""
    form = element.find("geometry/*")
    if form is None:
        return None
    material = element.find("material")
    color = None if material is None else _color(material) or colors.get(material.get("name", ""))
    place = color or PLAIN, *_frame(element)
    if form.tag in _SIZES:
        sizes = (numbers_of(form, name) for name in _SIZES[form.tag])
        return Shape(link, form.tag, tuple(chain.from_iterable(sizes)), *place)
    name = form.get("filename", "") if form.tag == "mesh" else ""
    found = find_mesh(name, folder) if name else None
    if found is None or found.suffix.lower() not in _MESHES:
        why = mesh_places(name, folder) if found is None else "of this format"
        unread.append(f"{name or form.tag} of link {link!r} ({why})")
        return None
    return Shape(link, "mesh", tuple(numbers_of(form, "scale", "1 1 1")), *place, found)


def _bones(robot: Element) -> Iterator[Shape]:
    """Yield a bone from each link's frame to each joint below it, and the joint as a ball."""
    for joint in robot.findall("joint"):
        position, _ = _frame(joint)
        length = float(np.linalg.norm(position))
        if length < _SHORTEST_BONE:
            continue
        link, radius = end_of(joint, "parent"), _BONE_SHARE * length
        turn, _ = Rotation.align_vectors([position], [[0.0, 0.0, 1.0]])
        half = position / 2.0
        yield Shape(link, "cylinder", (radius, length), PLAIN, half, turn.as_matrix())
        yield Shape(link, "sphere", (1.3 * radius,), _JOINT, position)


def _frame(element: Element) -> tuple[Numbers, Numbers]:
    """Return origin and axes that an element's origin says."""
    position, angles = origin_of(element)
    return np.array(position), Rotation.from_euler("xyz", angles).as_matrix()


def _color(material: Element) -> Color | None:
    color = material.find("color")
    if color is None:
        return None
    red, green, blue, *_ = numbers_of(color, "rgba")
    return red, green, blue, 1.0

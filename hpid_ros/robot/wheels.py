"""Where a URDF puts a wheel, and how large it is.

Source: the URDF joint and link elements (http://wiki.ros.org/urdf/XML); roll, pitch and yaw are
rotations about the fixed x, y and z axes in this order.
"""

from __future__ import annotations

import math
from typing import NamedTuple
from xml.etree import ElementTree

from hpid_ros.errors import RobotDescriptionError
from hpid_ros.robot.description import RobotDescription

_ALIGNED = 0.01  # [rad], also for those who write 1.57 for a quarter of a turn

Vector = tuple[float, float, float]
Rows = tuple[Vector, Vector, Vector]
_NO_TURN: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Wheel(NamedTuple):
    """A wheel as its robot's root link sees it, with every joint at 0.

    Attributes:
        centre: Origin of its joint, in [m].
        radius: Of its link's collision shape, in [m]; None where that is no sphere or cylinder.
    """

    centre: Vector
    radius: float | None


def read_wheel(description: RobotDescription, joint: str) -> Wheel:
    """Read a wheel.

    Args:
        description: The robot.
        joint: Name of the wheel's joint.

    Raises:
        RobotDescriptionError: The wheel does not turn about the root's +y axis, or an element
            on the way to it holds no numbers.
    """
    robot = ElementTree.fromstring(description.xml)
    parents = {_child(each): each for each in robot.findall("joint")}
    wheel = description.joints[joint]
    centre: Vector = (0.0, 0.0, 0.0)
    axis: Vector = wheel.axis
    link = wheel.child
    while link in parents:
        element = parents[link]
        shift, rows = _origin(element)
        x, y, z = _turned(rows, centre)
        centre = (x + shift[0], y + shift[1], z + shift[2])
        axis = _turned(rows, axis)
        parent = element.find("parent")
        link = "" if parent is None else parent.get("link", "")
    if math.atan2(math.hypot(axis[0], axis[2]), axis[1]) > _ALIGNED:
        raise RobotDescriptionError(
            f"wheel {joint!r} must turn about the +y axis of {description.root!r}, not about "
            f"({', '.join(f'{value:.6g}' for value in axis)})"
        )
    return Wheel(centre, _radius(robot, wheel.child))


def _radius(robot: ElementTree.Element, name: str) -> float | None:
    """Return the radius of a link's only collision shape."""
    shapes = robot.findall(f"link[@name='{name}']/collision/geometry/*")
    if len(shapes) != 1 or shapes[0].tag not in ("sphere", "cylinder"):
        return None
    (radius,) = _numbers(shapes[0], "radius", "nan", f"link {name!r}", 1)
    return radius


def _child(joint: ElementTree.Element) -> str:
    child = joint.find("child")
    return "" if child is None else child.get("link", "")


def _origin(joint: ElementTree.Element) -> tuple[Vector, Rows]:
    """Return a joint's shift in [m] and its turn as the rows of a matrix."""
    origin = joint.find("origin")
    if origin is None:
        return (0.0, 0.0, 0.0), _NO_TURN
    where = f"joint {joint.get('name', '')!r}"
    x, y, z = _numbers(origin, "xyz", "0 0 0", where, 3)
    roll, pitch, yaw = _numbers(origin, "rpy", "0 0 0", where, 3)
    (cr, cp, cy), (sr, sp, sy) = (
        tuple(each(angle) for angle in (roll, pitch, yaw)) for each in (math.cos, math.sin)
    )
    return (x, y, z), (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )


def _turned(rows: Rows, vector: Vector) -> Vector:
    x, y, z = (sum(a * b for a, b in zip(row, vector, strict=True)) for row in rows)
    return x, y, z


def _numbers(
    element: ElementTree.Element, attribute: str, default: str, where: str, count: int
) -> list[float]:
    text = element.get(attribute, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise RobotDescriptionError(f"{where}: {attribute}={text!r} must be {count} numbers")
    return values

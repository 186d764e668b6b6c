"""The bridge's parameters of bricks, supports and gripper."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.simulation.world.disturbances import vector
from hpid_ros.simulation.world.workpieces import (
    Brick,
    GripCommand,
    GripperSettings,
    Support,
    Workplace,
)

_LONGEST = 1e5  # [s]
_DOUBLES, _TEXTS = Parameter.Type.DOUBLE_ARRAY, Parameter.Type.STRING_ARRAY
_OF_BOX = {
    "names": (_TEXTS, "Names"),
    "sizes": (_DOUBLES, "Edges x, y, z of each [m]"),
    "positions": (_DOUBLES, "Centre x, y, z of each in the world [m]"),
    "yaws": (_DOUBLES, "Turn of each about z [rad]; 0 if left out"),
    "frictions": (_DOUBLES, "Coefficient of each one's surface; 1 if left out"),
}
_OF_GRIPPER = {
    "opening": "Widest brick between the open fingers [m]",
    "tolerance": "Largest distance of a brick from the grasp frame when it is taken [m]",
    "angle_tolerance": "Largest angle between its faces and the fingers [rad]",
    "grip_force": "With which each finger presses [N]",
    "friction": "Coefficient between finger and brick",
}
_WIDTHS = {"sizes": 3, "positions": 3}
_DEFAULTS = {"yaws": 0.0, "frictions": 1.0}


def workplace(node: Node) -> Workplace:
    """Declare the parameters of bricks, supports and gripper and return what they say.

    Args:
        node: The bridge.

    Raises:
        SettingError: Arrays that belong together differ in length, or a value is out of range.
    """
    supports = [Support(**values) for values in _boxes(node, "supports")]
    masses = list(
        read_only(node, "bricks.masses", _DOUBLES, "Mass of each brick [kg]; 1 if left out") or ()
    )
    boxes = _boxes(node, "bricks")
    if masses and len(masses) != len(boxes):
        raise SettingError(f"bricks.masses has {len(masses)} entries for {len(boxes)} bricks")
    bricks = [
        Brick(**values, mass=mass)
        for values, mass in zip(boxes, masses or [1.0] * len(boxes), strict=True)
    ]
    return Workplace(tuple(bricks), tuple(supports), _gripper(node), tuple(_schedule(node)))


def _boxes(node: Node, prefix: str) -> list[dict[str, Any]]:
    """Return the values of each box, by field."""
    arrays = {
        name: list(read_only(node, f"{prefix}.{name}", kind, meaning) or ())
        for name, (kind, meaning) in _OF_BOX.items()
    }
    count = len(arrays["names"])
    for name, default in _DEFAULTS.items():
        arrays[name] = arrays[name] or [default] * count
    for name, values in arrays.items():
        wanted = count * _WIDTHS.get(name, 1)
        if len(values) != wanted:
            raise SettingError(
                f"{prefix}.{name} must have {wanted} entries, as {prefix}.names has {count}, "
                f"not {len(values)}"
            )
    rows = []
    for index, name in enumerate(arrays["names"]):
        three = slice(3 * index, 3 * index + 3)
        rows.append(
            {
                "name": name,
                "size": vector(f"{prefix}.sizes", arrays["sizes"][three]),
                "position": vector(f"{prefix}.positions", arrays["positions"][three]),
                "yaw": arrays["yaws"][index],
                "friction": arrays["frictions"][index],
            }
        )
    return rows


def _gripper(node: Node) -> GripperSettings:
    ideal = GripperSettings()
    link = read_only(node, "gripper.link", ideal.link, "Link whose frame is the grasp frame")
    values = {
        name: float(read_only(node, f"gripper.{name}", getattr(ideal, name), meaning))
        for name, meaning in _OF_GRIPPER.items()
    }
    return GripperSettings(str(link), **values)


def _schedule(node: Node) -> list[GripCommand]:
    times = read_only(node, "gripper_schedule.times", _DOUBLES, "When the gripper moves [s]")
    closed = read_only(
        node, "gripper_schedule.closed", Parameter.Type.BOOL_ARRAY, "Whether it closes"
    )
    times, closed = list(times or ()), list(closed or ())
    if len(times) != len(closed):
        raise SettingError(
            f"gripper_schedule.closed must have {len(times)} entries, as gripper_schedule.times "
            f"has, not {len(closed)}"
        )
    for time in times:
        if not 0.0 <= time <= _LONGEST:
            raise SettingError(
                f"time {time} s of gripper_schedule must lie in [0, {_LONGEST:g}] s"
            )
    return [
        GripCommand(round(time * NANOSECONDS), is_closed)
        for time, is_closed in zip(times, closed, strict=True)
    ]

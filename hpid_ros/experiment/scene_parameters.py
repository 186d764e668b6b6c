"""Bricks, supports and gripper as parameters of the bridge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from hpid_ros.simulation.bricks import Support, Workplace

_NANOSECONDS = 1_000_000_000


def scene_document(workplace: Workplace) -> dict[str, Any]:
    """Return the parameters, nested; empty where nothing stands about the robot.

    Args:
        workplace: What does.
    """
    document: dict[str, Any] = {}
    if workplace.supports:
        document["supports"] = _boxes(workplace.supports)
    if workplace.bricks:
        masses = {"masses": [brick.mass for brick in workplace.bricks]}
        document["bricks"] = _boxes(workplace.bricks) | masses
        document["gripper"] = asdict(workplace.gripper)
    if workplace.schedule:
        document["gripper_schedule"] = {
            "times": [command.time_ns / _NANOSECONDS for command in workplace.schedule],
            "closed": [command.is_closed for command in workplace.schedule],
        }
    return document


def _boxes(boxes: Sequence[Support]) -> dict[str, list[Any]]:
    return {
        "names": [box.name for box in boxes],
        "sizes": [edge for box in boxes for edge in box.size],
        "positions": [coordinate for box in boxes for coordinate in box.position],
        "yaws": [box.yaw for box in boxes],
        "frictions": [box.friction for box in boxes],
    }

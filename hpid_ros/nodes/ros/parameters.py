"""Declares parameters from tables, with descriptions, constraints and the ends of sliders."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.node import Node

from hpid_ros.base.errors import SettingError
from hpid_ros.control.settings.table import ParameterSpec


def descriptor(spec: ParameterSpec, *, read_only: bool = False) -> ParameterDescriptor:
    """Return what ROS tools show of a parameter."""
    description = ParameterDescriptor(
        description=spec.description,
        read_only=read_only,
        additional_constraints=_constraints(spec),
    )
    if spec.slider:
        low, high = spec.slider
        description.floating_point_range = [
            FloatingPointRange(from_value=low, to_value=high, step=0.0)
        ]
    return description


def _constraints(spec: ParameterSpec) -> str:
    if spec.choices:
        return f"one of: {', '.join(spec.choices)}"
    if isinstance(spec.default, float) and math.isfinite(spec.minimum + spec.maximum):
        return f"from {spec.minimum:g} to {spec.maximum:g}"
    return ""


def declare(node: Node, specs: Iterable[ParameterSpec], read_only: Iterable[str] = ()) -> None:
    """Declare parameters from their table."""
    fixed = set(read_only)
    for spec in specs:
        node.declare_parameter(
            spec.name, spec.default, descriptor(spec, read_only=spec.name in fixed)
        )


def read_only(node: Node, name: str, default: object, description: str) -> Any:
    """Declare one parameter that is fixed when the node starts, and return its value."""
    parameter = node.declare_parameter(
        name, default, ParameterDescriptor(description=description, read_only=True)
    )
    return parameter.value


def read_choice(
    node: Node, name: str, default: str, description: str, choices: Iterable[str]
) -> str:
    """Declare one text of a few, fixed when the node starts, and return it."""
    allowed = ", ".join(choices)
    descriptor = ParameterDescriptor(
        description=description, read_only=True, additional_constraints=f"one of: {allowed}"
    )
    value = str(node.declare_parameter(name, default, descriptor).value)
    if value not in allowed.split(", "):
        raise SettingError(f"{name} must be one of {allowed}, not {value!r}")
    return value


def read_number(
    node: Node, name: str, default: float, description: str, limits: tuple[float, float]
) -> float:
    """Declare one number that is fixed when the node starts, and return its value."""
    value = float(read_only(node, name, default, description))
    low, high = limits
    if not low <= value <= high:
        raise SettingError(f"{name} must lie in [{low:g}, {high:g}], not {value}")
    return value

"""Declares parameters from tables, with descriptions and ranges that sliders can show."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control.settings.table import ParameterSpec, Value


def descriptor(spec: ParameterSpec, *, read_only: bool = False) -> ParameterDescriptor:
    """Return what ROS tools show of a parameter.

    Args:
        spec: The parameter.
        read_only: Whether it is fixed when the node starts.
    """
    description = ParameterDescriptor(
        description=spec.description,
        read_only=read_only,
        additional_constraints=f"one of: {', '.join(spec.choices)}" if spec.choices else "",
    )
    if isinstance(spec.default, float) and math.isfinite(spec.minimum + spec.maximum):
        description.floating_point_range = [
            FloatingPointRange(from_value=spec.minimum, to_value=spec.maximum, step=0.0)
        ]
    return description


def declare(node: Node, specs: Iterable[ParameterSpec], read_only: Iterable[str] = ()) -> None:
    """Declare parameters from their table.

    Args:
        node: The node that gets them.
        specs: The table.
        read_only: Names of those that are fixed when the node starts.
    """
    fixed = set(read_only)
    for spec in specs:
        node.declare_parameter(
            spec.name, spec.default, descriptor(spec, read_only=spec.name in fixed)
        )


def read_only(node: Node, name: str, default: object, description: str) -> Any:
    """Declare one parameter that is fixed when the node starts, and return its value.

    Args:
        node: The node that gets it.
        name: Its name.
        default: Its default, whose type is the parameter's; a ``Parameter.Type`` for a list
            that may be left out, whose value is then None.
        description: What it is, with the unit in brackets.
    """
    parameter = node.declare_parameter(
        name, default, ParameterDescriptor(description=description, read_only=True)
    )
    return parameter.value


def read_number(
    node: Node, name: str, default: float, description: str, limits: tuple[float, float]
) -> float:
    """Declare one number that is fixed when the node starts, and return its value.

    Args:
        node: The node that gets it.
        name: Its name.
        default: Its default.
        description: What it is, with the unit in brackets.
        limits: Least and largest allowed value.

    Raises:
        SettingError: It is out of range or not a number.
    """
    value = float(read_only(node, name, default, description))
    low, high = limits
    if not low <= value <= high:
        raise SettingError(f"{name} must lie in [{low:g}, {high:g}], not {value}")
    return value


def merged(node: Node, names: Iterable[str], changes: Iterable[Parameter]) -> dict[str, Value]:
    """Return the values that would be in force after a change.

    Args:
        node: The node.
        names: The parameters that are asked for.
        changes: What is about to be set.
    """
    values = {name: node.get_parameter(name).value for name in names}
    values.update({p.name: p.value for p in changes if p.name in values})
    return values


def verdict(
    check: Mapping[str, Value], build: Callable[[Mapping[str, Value]], object]
) -> SetParametersResult:
    """Say whether a set of values as a whole can be put in force.

    Args:
        check: The values by name.
        build: Called with the values; raises an :class:`HpidError` when they cannot be used.
    """
    try:
        build(check)
    except HpidError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)

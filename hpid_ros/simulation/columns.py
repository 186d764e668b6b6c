"""Models of several joints as arrays along the joints, which is how ROS parameters hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from hpid_ros.base.errors import SettingError
from hpid_ros.simulation.drives import Motor, Pwm
from hpid_ros.simulation.sensors import Homing

Model = TypeVar("Model", Motor, Pwm, Homing)

_OFF: dict[str, Any] = {"float": 0.0, "int": 0, "str": ""}


def column_types(kind: type[Any]) -> dict[str, str]:
    """Return ``float``, ``int`` or ``str`` for each array of a kind of model.

    Args:
        kind: A frozen dataclass of numbers and texts; its first field is never 0.
    """
    return {field.name: str(field.type) for field in fields(kind)}


def columns(kind: type[Model], models: Sequence[Model | None]) -> dict[str, list[Any]]:
    """Return the arrays; empty when no joint has such a model.

    Args:
        kind: What the models are.
        models: One for each joint; None is written as its first number being 0.
    """
    if all(model is None for model in models):
        return {}
    arrays: dict[str, list[Any]] = {}
    for field in fields(kind):
        plain = field.default is MISSING
        off = _OFF[str(field.type)] if plain else field.default
        arrays[field.name] = [getattr(model, field.name, off) for model in models]
    return arrays


def from_columns(
    kind: type[Model], arrays: Mapping[str, Sequence[Any]], joints: Sequence[str]
) -> tuple[Model | None, ...]:
    """Return the models that arrays say; empty when there are none.

    Args:
        kind: What the models are.
        arrays: By name; what is left out or empty has its default.
        joints: The joints, for their number and for messages.

    Raises:
        SettingError: An array is missing, has another length, or a value is out of range.
    """
    given = {name: values for name, values in arrays.items() if len(values)}
    if not given:
        return ()
    first = fields(kind)[0].name
    needed = [field.name for field in fields(kind) if field.default is MISSING]
    for name in needed:
        if name not in given:
            raise SettingError(f"{kind.__name__.lower()}.{name} is missing")
    for name, values in given.items():
        if len(values) != len(joints):
            raise SettingError(
                f"{kind.__name__.lower()}.{name} must have one entry for each of "
                f"{len(joints)} driven joints, not {len(values)}"
            )
    models: list[Model | None] = []
    for index, joint in enumerate(joints):
        row = {name: values[index] for name, values in given.items()}
        try:
            models.append(kind(**row) if row[first] != 0 else None)
        except SettingError as error:
            raise SettingError(f"joint {joint!r}: {error}") from None
    return tuple(models)

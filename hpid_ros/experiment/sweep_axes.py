"""What a sweep varies: one name and its values for each direction of the grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

from hpid_ros.control import LOOP_PARAMETERS
from hpid_ros.control.model_settings import MODEL_PARAMETERS
from hpid_ros.errors import SettingError, unknown_name

Value = float | str

WORLD_SETTINGS = {
    "payload": "payload_mass",
    "physics_steps": "physics_steps",
    "encoder_counts": "encoder_counts",
}
"""Settings of the simulated robot that can be varied, and their names in ``WorldSettings``."""

LARGEST_COUNT = 10_000
_PARAMETERS = {**LOOP_PARAMETERS, **MODEL_PARAMETERS}
_FORMS = "NAME=START:STOP:COUNT or NAME=VALUE,VALUE,..."


@dataclass(frozen=True)
class Axis:
    """One direction of a grid.

    Attributes:
        name: A loop's parameter or one of :data:`WORLD_SETTINGS`.
        values: Its values, each once, in the order given.
    """

    name: str
    values: tuple[Value, ...]

    @property
    def is_of_the_world(self) -> bool:
        """Whether the values are the robot's and not the controller's."""
        return self.name in WORLD_SETTINGS

    @classmethod
    def parse(cls, text: str) -> Axis:
        """Return the axis that a text says.

        Args:
            text: ``NAME=START:STOP:COUNT``, evenly spaced with both ends, or
                ``NAME=VALUE,VALUE,...``.

        Raises:
            SettingError: It says none; the line repeats the text.
        """
        name, equals, rest = (part.strip() for part in text.partition("="))
        try:
            if not equals or not name or not rest:
                raise SettingError(f"it must be {_FORMS}")
            values = _texts(name, rest) if _is_text(name) else _numbers(rest)
            if len(set(values)) < len(values):
                doubled = next(value for value in values if values.count(value) > 1)
                raise SettingError(f"{shown(doubled)} is there twice")
        except SettingError as error:
            raise SettingError(f"--vary {text!r}: {error}") from None
        return cls(name, values)


def shown(value: Value) -> str:
    """Return a value as a person would write it."""
    return value if isinstance(value, str) else f"{value:.12g}"


def _is_text(name: str) -> bool:
    """Tell whether a parameter is a text and no number.

    Raises:
        SettingError: There is no such parameter, or it cannot be varied.
    """
    names = [*(each for each in _PARAMETERS if each != "joint"), *WORLD_SETTINGS]
    if name not in names:
        raise SettingError(unknown_name("parameter", name, names))
    return name in _PARAMETERS and isinstance(_PARAMETERS[name].default, str)


def _texts(name: str, text: str) -> tuple[Value, ...]:
    return tuple(_PARAMETERS[name].checked(part.strip()) for part in text.split(","))


def _numbers(text: str) -> tuple[Value, ...]:
    if ":" not in text:
        return tuple(_number(part) for part in text.split(","))
    parts = text.split(":")
    if len(parts) != 3:
        raise SettingError("a range must be START:STOP:COUNT")
    start, stop = (Fraction(repr(_number(part))) for part in parts[:2])
    count = _number(parts[2])
    if count != int(count) or not 2 <= count <= LARGEST_COUNT:
        raise SettingError(
            f"COUNT must be a whole number from 2 to {LARGEST_COUNT}, not {parts[2]}"
            + ("; for one value write NAME=VALUE" if count == 1.0 else "")
        )
    # Exact, and rounded once: the middle of -0.3:0.3:7 is 0 and its neighbour is 0.1.
    step = (stop - start) / (int(count) - 1)
    return tuple(float(start + k * step) for k in range(int(count)))


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise SettingError(f"{text.strip()!r} is not a number") from None
    if not math.isfinite(value):
        raise SettingError(f"{text.strip()} is not finite")
    return value

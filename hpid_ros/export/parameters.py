"""The parameters that a loop in C has: which, and how they stand there; and which it has not."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import NamedTuple

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control import LOOP_PARAMETERS, LoopSettings
from hpid_ros.control.settings.table import PARAMETERS, Value

_CHOICES: Mapping[str, tuple[str, ...]] = {
    "law": ("hpid", "pid"),
    "norm.type": ("weighted", "canonical"),
    "discretization": ("explicit", "semi_implicit"),
    "antiwindup_strategy": ("none", "conditional_integration", "back_calculation"),
    "velocity_source": ("measured", "filtered", "homogeneous_differentiator"),
}
"""What the C code can do of what a parameter may say, in the order of its enumerators."""

_NUMBERS = (
    *("gains.p", "gains.i", "gains.d", "mu"),
    *("norm.error_scale", "norm.rate_weight", "norm.effort_scale", "norm.floor", "norm.cap"),
    *("u_clamp_max", "u_clamp_min", "i_clamp_max", "i_clamp_min", "tracking_time_constant"),
    *("velocity_filter_time_constant", "acceleration_bound"),
    *("encoder_wrap", "encoder_resolution", "position_step_max", "effort_rate_max"),
    *("position_max", "position_min", "velocity_max"),
    *("soft_stop.margin", "soft_stop.k_position", "soft_stop.k_velocity"),
    *("takeover_time", "fallback_effort", "state_timeout", "control_period", "inertia"),
)
_FLAGS = ("angle_wraparound", "multi_turn")
_TIMES = ("state_timeout", "control_period")  # compared with some slack in single precision
_EXPORTED = {*_CHOICES, *_NUMBERS, *_FLAGS}

_OF_THE_NODE = {"joint", "state_clock"}
"""What a loop's node looks at: its name, and whether a silence may be a pause."""

_IN_C = {
    "encoder_wrap": "The encoder begins anew after so much [rad], as a driver does that reports "
    "(-pi, pi] or [0, 2 pi); 0 and -1 never",
}
"""What is said differently of parameters whose meaning in ROS has to do with its surroundings."""


class Field(NamedTuple):
    """One parameter as a member of the settings in C."""

    parameter: str  # its dotted name
    description: str  # what it is, with unit and range
    choices: tuple[str, ...] = ()  # what a text may say; empty for numbers and flags
    range: tuple[float, float] | None = None  # least and largest number; None for texts and flags

    @property
    def name(self) -> str:
        """The member's name."""
        return self.parameter.replace(".", "_")


def _field(parameter: str) -> Field:
    spec = LOOP_PARAMETERS[parameter]
    text = _IN_C.get(parameter, spec.description)
    if parameter in _CHOICES:
        return Field(parameter, text, _CHOICES[parameter])
    if parameter in _FLAGS:
        return Field(parameter, text)
    ends = spec.minimum, spec.maximum
    return Field(parameter, f"{text} ({ends[0]:g} to {ends[1]:g})", range=ends)


FIELDS = tuple(_field(name) for name in LOOP_PARAMETERS if name in _EXPORTED)
"""The members of the settings in C, in the order of the parameters' table."""


def exported_values(settings: LoopSettings) -> dict[str, Value]:
    """Return the settings' values by parameter, of those that the C code has."""
    values = settings.to_parameters()
    for name, value in values.items():
        if name in _OF_THE_NODE:
            continue
        known = _CHOICES.get(name)
        if known is not None and value not in known:
            raise SettingError(
                f"{settings.joint}: {name} {value} is not exported to C, only {', '.join(known)}"
            )
        if name not in _EXPORTED and value != PARAMETERS[name].default:
            raise SettingError(
                f"{settings.joint}: {name} = {value} cannot be exported: the loop in C has no "
                f"{name.partition('.')[0]}; export the joint without it"
            )
    return {field.parameter: values[field.parameter] for field in FIELDS}


def to_single(number: float) -> float:
    """Return a number rounded to single precision, infinite where it has none there."""
    try:
        (rounded,) = struct.unpack("f", struct.pack("f", number))
    except OverflowError:
        return math.copysign(math.inf, number)
    return float(rounded)


def in_single(settings: LoopSettings) -> LoopSettings:
    """Return settings with the numbers rounded to single precision, but for two times."""
    values = settings.to_parameters()
    for name in _NUMBERS:
        value = values[name]
        if name in _TIMES or value == PARAMETERS[name].default:  # which some of them must have
            continue
        values[name] = to_single(float(value))
        if value and not values[name]:
            raise SettingError(f"{settings.joint}: {name} = {value:g} is 0 in single precision")
    try:
        return LoopSettings.from_parameters(values)
    except HpidError as error:
        raise SettingError(f"{settings.joint}: in single precision {error}") from None

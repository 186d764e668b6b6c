"""What was found of a joint, each number with its interval, or the reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import Numbers

Flags = NDArray[np.bool_]

INERTIA = "inertia"
VISCOUS = "viscous"
COULOMB = "coulomb"
STRIBECK = "stribeck"
OFFSET = "offset"
GRAVITY_SIN = "gravity_sin"
GRAVITY_COS = "gravity_cos"
EFFORT_SCALE = "effort_scale"
DELAY = "delay"
SPIN = "spin"
"""Beside the parameters: how much of the effort is there that rotors need beside their inertia."""

PARAMETERS: Mapping[str, tuple[str, str]] = {
    INERTIA: ("kg m^2", "kg"),
    VISCOUS: ("N m s/rad", "N s/m"),
    COULOMB: ("N m", "N"),
    STRIBECK: ("N m", "N"),
    GRAVITY_SIN: ("N m", "N"),
    GRAVITY_COS: ("N m", "N"),
    OFFSET: ("N m", "N"),
    EFFORT_SCALE: ("", ""),
    DELAY: ("s", "s"),
}
"""Names of all parameters, with the units of a joint that turns and of one that slides."""


@dataclass(frozen=True)
class Estimate:
    """One number."""

    value: float  # the estimate, in SI units
    half_width: float  # of its 95 % interval
    reason: str = ""  # why it should not be relied on, and what motion would help

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half_width

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half_width

    @property
    def is_told(self) -> bool:
        """Whether the data tell it."""
        return not self.reason

    @property
    def is_positive(self) -> bool:
        """Whether the whole interval is above zero."""
        return self.low > 0.0


class Fit(NamedTuple):
    """How a joint's efforts are explained, row by row; NaN between spans."""

    time: Numbers  # [s] (R,)
    measured: Numbers  # [N m] effort at the joint's motion, smoothed and freed of the delay, (R,)
    predicted: Numbers  # [N m] what the estimates say of it, (R,)
    is_used: Flags  # whether the row counted; where the direction is in doubt it does not, (R,)


@dataclass(frozen=True, eq=False)
class JointIdentification:
    """What was found of one joint."""

    joint: str  # its name
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    untold: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  # what to know of all the numbers
    method: str = ""  # how, in a few words
    why: str = ""  # the reason for the method, in a few words
    cutoff: float = 0.0  # [Hz] of the low pass
    rows: int = 0  # rows that counted
    time: float = 0.0  # [s] time that they stand for
    stribeck_speed: float = 0.0  # [rad/s] speed at which Stribeck friction has fallen to 1/e
    residual: float = 0.0  # [N m] root mean square of what is not explained
    explained: float = 0.0  # share of the effort's variance that is explained
    condition: float = 0.0  # condition number of the scaled columns
    travel: float = 0.0  # [rad] how far the joint moved between its ends
    speed: float = 0.0  # [rad/s] largest speed
    acceleration: float = 0.0  # [rad/s^2] largest acceleration
    effort_limit: float = math.inf  # [N m] largest that the drive gives; inf if not seen
    fit: Fit | None = None  # to draw

    @property
    def is_found(self) -> bool:
        """Whether there is any number."""
        return bool(self.estimates)

    def told(self, name: str) -> Estimate | None:
        """Return an estimate that the data tell; None if they do not."""
        found = self.estimates.get(name)
        return found if found is not None and found.is_told else None

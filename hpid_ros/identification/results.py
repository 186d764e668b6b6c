"""What was found of a joint, each number with its interval, or the reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.arrays import Numbers

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
    """One number.

    Attributes:
        value: The estimate, in SI units.
        half_width: Of its 95 % interval.
        reason: Why it should not be relied on, and what motion would help; empty where it may.
    """

    value: float
    half_width: float
    reason: str = ""

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
    """How a joint's efforts are explained, row by row; NaN between spans.

    Attributes:
        time: In [s], (R,).
        measured: Effort at the joint's motion, smoothed and freed of the delay, (R,), in [N m].
        predicted: What the estimates say of it, (R,), in [N m].
        is_used: Whether the row counted; where the direction is in doubt it does not, (R,).
    """

    time: Numbers
    measured: Numbers
    predicted: Numbers
    is_used: Flags


@dataclass(frozen=True, eq=False)
class JointIdentification:
    """What was found of one joint.

    Attributes:
        joint: Its name.
        estimates: By name of the parameter, in the order of :data:`PARAMETERS`; empty where
            nothing could be found.
        untold: What the data cannot tell, by name of the parameter, and what motion would help;
            under the joint's own name if nothing could be found.
        remarks: What to know of all the numbers.
        method: How, in a few words.
        why: The reason for the method, in a few words.
        cutoff: Of the low pass, in [Hz].
        rows: Rows that counted.
        time: Time that they stand for, in [s].
        stribeck_speed: Speed at which Stribeck friction has fallen to 1/e, in [rad/s]; zero
            without.
        residual: Root mean square of what is not explained, in [N m].
        explained: Share of the effort's variance that is.
        condition: Condition number of the scaled columns.
        travel: How far the joint moved between its ends, in [rad].
        speed: Largest speed, in [rad/s].
        acceleration: Largest acceleration, in [rad/s^2].
        effort_limit: What acts of a larger command, in [N m]; infinite if no command shows one.
        fit: To draw.
    """

    joint: str
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    untold: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    method: str = ""
    why: str = ""
    cutoff: float = 0.0
    rows: int = 0
    time: float = 0.0
    stribeck_speed: float = 0.0
    residual: float = 0.0
    explained: float = 0.0
    condition: float = 0.0
    travel: float = 0.0
    speed: float = 0.0
    acceleration: float = 0.0
    effort_limit: float = math.inf
    fit: Fit | None = None

    @property
    def is_found(self) -> bool:
        """Whether there is any number."""
        return bool(self.estimates)

    def told(self, name: str) -> Estimate | None:
        """Return an estimate that the data tell; None if they do not."""
        found = self.estimates.get(name)
        return found if found is not None and found.is_told else None

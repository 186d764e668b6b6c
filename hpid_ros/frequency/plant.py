r"""A joint with inertia and viscous friction, as its controller sees it: sampled, and held.

.. math:: J \ddot q + b \dot q = u(t - \theta)

with the effort u held between two samples (zero-order hold). What is computed is exact for this
joint at the samples, whatever the delay: no Pade approximation, no Tustin.

Source: K. J. Astrom and B. Wittenmark, "Computer-Controlled Systems" (3rd ed., 1997), sections
2.3 (sampling of a system with a hold) and 2.3 "Systems with time delay"; the modified
z-transform.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import SettingError

Complexes = NDArray[np.complex128]
"""Of any shape, which the docstring says."""

_SERIES_BELOW = 0.05


class PlantResponse(NamedTuple):
    """Frequency response from the effort that a sample gives."""

    position: Complexes  # [rad/(N m)] to the measured position
    velocity: Complexes  # [rad/(N m s)] to the joint's velocity at the samples


class HeldEffort(NamedTuple):
    """What one period makes of position and velocity: x' = (q + reach v, keep v) + gains u."""

    reach: float  # [s] by how far a velocity of one moves the joint in one period
    keep: float  # which part of a velocity is left after it
    whole_periods: int  # an effort begins to act so many periods late
    # gains of the effort that begins to act within the period: position, velocity
    newer: tuple[float, float]
    older: tuple[float, float]  # gains of the effort before it, which acts until then


@dataclass(frozen=True)
class SampledJoint:
    """A joint behind a zero-order hold."""

    inertia: float  # [kg m^2] j, what one unit of effort accelerates
    period: float  # [s] control period T
    friction: float = 0.0  # [N m s/rad] viscous friction b
    delay: float = 0.0  # [s]

    def __post_init__(self) -> None:
        for name, unit in (("inertia", "kg m^2"), ("period", "s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise SettingError(f"the {name} must be positive and finite, not {value} {unit}")
        for name, unit in (("friction", "N m s/rad"), ("delay", "s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise SettingError(
                    f"the {name} must be finite and not negative, not {value} {unit}"
                )

    @property
    def nyquist(self) -> float:
        """Half the sampling frequency, in [rad/s]: no response is looked at beyond it."""
        return math.pi / self.period

    @property
    def held(self) -> HeldEffort:
        """What one period makes of position, velocity and effort."""
        period = self.period
        whole = math.floor(self.delay / period)
        late = self.delay - whole * period
        reach, keep = self._free(period - late)
        first = self._forced(late)
        older = (first[0] + reach * first[1], keep * first[1])
        return HeldEffort(*self._free(period), whole, self._forced(period - late), older)

    def _free(self, time: float) -> tuple[float, float]:
        """Return reach and rest of a velocity after a time."""
        decay = self.friction / self.inertia * time
        return time * _phi_1(decay), math.exp(-decay)

    def _forced(self, time: float) -> tuple[float, float]:
        """Return position and velocity after a time under a unit effort from rest."""
        decay = self.friction / self.inertia * time
        return time * time * _phi_2(decay) / self.inertia, time * _phi_1(decay) / self.inertia

    def response(self, frequency: Numbers) -> PlantResponse:
        """Return the frequency response of the held joint at z = exp(j w T)."""
        held = self.held
        ahead = np.expm1(1j * self.period * frequency)  # z - 1, with all its digits
        back = 1.0 / (1.0 + ahead)
        late = np.exp(-1j * held.whole_periods * self.period * frequency)
        forced = [
            late * (newer + older * back)
            for newer, older in zip(held.newer, held.older, strict=True)
        ]
        lost = self.friction / self.inertia * held.reach  # 1 - keep, likewise
        velocity = forced[1] / (ahead + lost)
        return PlantResponse((forced[0] + held.reach * velocity) / ahead, velocity)


def _phi_1(x: float) -> float:
    """Return (1 - exp(-x)) / x."""
    return -math.expm1(-x) / x if x else 1.0


def _phi_2(x: float) -> float:
    """Return (x - 1 + exp(-x)) / x^2."""
    if x < _SERIES_BELOW:
        return sum((-x) ** k / math.factorial(k + 2) for k in range(8))
    return (x + math.expm1(-x)) / (x * x)

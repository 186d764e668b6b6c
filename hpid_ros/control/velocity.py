"""Velocity of a joint, measured or estimated from its positions."""

from __future__ import annotations

import math
from typing import Protocol

from hpid_ros.errors import SettingError


class VelocitySource(Protocol):
    """Gives one velocity a sample."""

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the velocity in [rad/s] at this sample.

        Args:
            position: Measured, in [rad].
            velocity: Measured, in [rad/s]; None when the robot reports none.
            dt: Time since the last sample in [s]; 0 for the first one.
        """

    def reset(self) -> None:
        """Forget the past: the next sample is the first one."""


class FilteredVelocity:
    """Backward difference behind a first-order low-pass filter.

    The filter is discretised by backward Euler, hence stable for every period:
    ``v += dt / (tau + dt) ((x - x_before) / dt - v)``.

    Args:
        time_constant: tau in [s]; 0 gives the bare difference.

    Raises:
        SettingError: The time constant is negative or not finite.
    """

    __slots__ = ("_position", "_velocity", "time_constant")

    _position: float | None
    _velocity: float

    def __init__(self, time_constant: float) -> None:
        if not math.isfinite(time_constant) or time_constant < 0.0:
            raise SettingError(
                f"the velocity filter's time constant must be finite and not negative, "
                f"not {time_constant} s"
            )
        self.time_constant = time_constant
        self.reset()

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the filtered difference in [rad/s]; the measured velocity is not used."""
        if self._position is not None and dt > 0.0:
            difference = (position - self._position) / dt
            self._velocity += dt / (self.time_constant + dt) * (difference - self._velocity)
        self._position = position
        return self._velocity

    def reset(self) -> None:
        """Forget the past: the next velocity is 0."""
        self._position = None
        self._velocity = 0.0


class MeasuredVelocity:
    """The robot's own velocity, or the filtered difference in samples that report none.

    Args:
        time_constant: Of the filter for samples without a velocity, in [s].
    """

    __slots__ = ("_fallback", "estimated")

    def __init__(self, time_constant: float) -> None:
        self._fallback = FilteredVelocity(time_constant)
        self.estimated = 0
        """Samples whose velocity had to be estimated."""

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the measured velocity in [rad/s], or an estimate where there is none."""
        estimate = self._fallback.update(position, velocity, dt)
        if velocity is not None:
            return velocity
        self.estimated += 1
        return estimate

    def reset(self) -> None:
        """Forget the past of the estimate."""
        self._fallback.reset()

"""Position and velocity of a joint from what its encoder tells."""

from __future__ import annotations

import math
from typing import Protocol

from hpid_ros.base.errors import SettingError

_ROUNDING = 1e-3  # of a turn; a driver's pi need not be exactly half of it


class Unwrapper:
    """Adds up the increments of an encoder that wraps around.

    A step of more than half a turn between two states is a turn that the encoder has left out,
    if both positions are such as a wrapping encoder gives: within (-turn/2, turn/2] or
    [0, turn). Positions of an encoder that counts its turns are left alone.
    """

    __slots__ = ("_before", "_has_wrapped", "_largest", "_offset", "_turn")

    def __init__(self, turn: float) -> None:
        self.begin_anew_after(turn)
        self.reset()

    def begin_anew_after(self, turn: float) -> None:
        """Go by another turn from the next position on; those before stay what they were."""
        self._turn = turn
        self._largest = turn * (1.0 + _ROUNDING)

    def reset(self) -> None:
        """Forget the past: the next position is taken as it is."""
        self._before = math.nan
        self._offset = 0.0
        self._has_wrapped = False

    def interrupt(self) -> None:
        """Note that the joint may have moved any way since the last position.

        Of an encoder that has wrapped before, the nearest turn is taken; of another one it is
        not known that it ever does.
        """
        if not self._has_wrapped:
            self._before = math.nan

    def update(self, position: float) -> float:
        """Return the continuous position in [rad]."""
        step = position - self._before
        if abs(step) > 0.5 * self._turn and max(abs(position), abs(self._before)) < self._largest:
            self._offset -= self._turn * round(step / self._turn)
            self._has_wrapped = True
        self._before = position
        return position + self._offset


class VelocitySource(Protocol):
    """Gives one velocity a sample."""

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the velocity in [rad/s] at this sample."""

    def take_over(self, position: float, velocity: float) -> None:
        """Go on from where another source stands."""

    def reset(self) -> None:
        """Forget the past: the next sample is the first one."""


class FilteredVelocity:
    """Backward difference behind a first-order low-pass filter.

    The filter is discretised by backward Euler, hence stable for every period:
    ``v += dt / (tau + dt) ((x - x_before) / dt - v)``.
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

    def take_over(self, position: float, velocity: float) -> None:
        """Go on from a position in [rad] and a velocity in [rad/s]."""
        self._position, self._velocity = position, velocity

    def reset(self) -> None:
        """Forget the past: the next velocity is 0."""
        self._position = None
        self._velocity = 0.0


_FEW_ZEROS = 10  # a driver that is quantised, or asked at rest, tells as many


class MeasuredVelocity:
    """The robot's own velocity, or the filtered difference in samples that report none."""

    __slots__ = ("_fallback", "_zero_since", "_zeros", "is_reported", "moved_at_zero")

    def __init__(self, time_constant: float) -> None:
        self._fallback = FilteredVelocity(time_constant)
        self._zero_since, self._zeros = 0.0, 0
        self.moved_at_zero = 0.0
        self.is_reported = True

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the measured velocity in [rad/s], or an estimate where there is none."""
        estimate = self._fallback.update(position, velocity, dt)
        if velocity == 0.0:
            if not self._zeros or dt <= 0.0:
                self._zero_since, self._zeros = position, 0
            self._zeros += 1
            if self._zeros > _FEW_ZEROS:
                moved = abs(position - self._zero_since)
                self.moved_at_zero = max(moved, self.moved_at_zero)
        elif self._zeros:
            self._zeros, self.moved_at_zero = 0, 0.0
        self.is_reported = velocity is not None
        return estimate if velocity is None else velocity

    def take_over(self, position: float, velocity: float) -> None:
        """Let the estimate go on from a position in [rad] and a velocity in [rad/s]."""
        self._fallback.take_over(position, velocity)

    def reset(self) -> None:
        """Forget the past of the estimate."""
        self._fallback.reset()
        self._zeros, self.moved_at_zero = 0, 0.0


class HomogeneousDifferentiator:
    r"""Levant's robust exact differentiator: exact for a bounded acceleration, after finite time.

    .. math::
        \dot z_0 = z_1 - 1.5\sqrt{L}\,|z_0 - x|^{1/2}\,\mathrm{sign}(z_0 - x), \qquad
        \dot z_1 = -1.1\,L\,\mathrm{sign}(z_0 - x)

    by backward Euler, where both signs become what makes the step consistent: it does not
    chatter, and on a track without noise it is the backward difference. With a position noise of
    at most eps the velocity is wrong by the order of max(sqrt(L eps), L T) whatever the motion,
    without the lag of a filter.

    Source: A. Levant, "Robust exact differentiation via sliding mode technique", Automatica 34
    (1998); the gains, A. Levant, "Higher-order sliding modes, differentiation and output-feedback
    control", Int. J. Control 76 (2003); the step, M. R. Mojallizadeh, B. Brogliato, V. Acary,
    "Time-discretizations of differentiators", Int. J. Robust Nonlinear Control 31 (2021).
    """

    __slots__ = ("_position", "_velocity", "acceleration_bound")

    _position: float | None
    _velocity: float

    _POSITION_GAIN = 1.5
    _VELOCITY_GAIN = 1.1

    def __init__(self, acceleration_bound: float) -> None:
        if not math.isfinite(acceleration_bound) or acceleration_bound <= 0.0:
            raise SettingError(
                f"the differentiator's acceleration bound must be positive and finite, "
                f"not {acceleration_bound} rad/s^2"
            )
        self.acceleration_bound = acceleration_bound
        self.reset()

    def update(self, position: float, velocity: float | None, dt: float) -> float:
        """Return the estimate in [rad/s]; the measured velocity is not used."""
        if self._position is None:
            self._position = position
            return self._velocity
        if dt <= 0.0:
            return self._velocity
        # The estimate s = z0 - x after the step solves s = ahead - T k |s|^{1/2} sign(s)
        # - T^2 c sign(s), with sign(0) anywhere in [-1, 1].
        ahead = self._position + dt * self._velocity - position
        change = self._VELOCITY_GAIN * self.acceleration_bound * dt
        beyond = abs(ahead) - change * dt
        if beyond <= 0.0:
            self._velocity -= ahead / dt
            self._position = position
        else:
            slope = self._POSITION_GAIN * math.sqrt(self.acceleration_bound) * dt
            root = 0.5 * (math.sqrt(slope * slope + 4.0 * beyond) - slope)
            self._velocity -= math.copysign(change, ahead)
            self._position = position + math.copysign(root * root, ahead)
        return self._velocity

    def take_over(self, position: float, velocity: float) -> None:
        """Go on from a position in [rad] and a velocity in [rad/s]."""
        self._position, self._velocity = position, velocity

    def reset(self) -> None:
        """Forget the past: the next velocity is 0."""
        self._position = None
        self._velocity = 0.0

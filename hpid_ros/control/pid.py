"""The linear PID."""

from __future__ import annotations

from typing import NamedTuple

from hpid_ros.control.gains import Gains


class Terms(NamedTuple):
    """What each term contributed to an effort."""

    p: float  # [N m] proportional term
    i: float  # [N m] integral term
    d: float  # [N m] derivative term


class Pid:
    """Linear PID, ``u = kp e + kd de + I`` with ``dI/dt = ki e``, by forward Euler.

    The gain ``ki`` stands inside the integral, so that changing it does not jump.

    Args:
        gains: The gains.
    """

    __slots__ = ("_derivative", "_integral", "_integral_used", "_proportional", "gains")

    _integral: float
    _integral_used: float
    _proportional: float
    _derivative: float

    def __init__(self, gains: Gains) -> None:
        self.gains = gains
        self.reset()

    @property
    def integral(self) -> float:
        """The integral term that the next sample uses, in [N m]."""
        return self._integral

    @property
    def terms(self) -> Terms:
        """The terms of the last sample."""
        return Terms(self._proportional, self._integral_used, self._derivative)

    def update(self, error: float, error_rate: float, dt: float) -> float:
        """Take one sample.

        Args:
            error: Reference minus measured position, in [rad].
            error_rate: Its time derivative, in [rad/s].
            dt: Time over which the error is integrated, in [s].

        Returns:
            The effort in [N m], with the integral before this sample's increment.
        """
        gains, integral = self.gains, self._integral
        proportional = gains.p * error
        derivative = gains.d * error_rate
        self._proportional = proportional
        self._derivative = derivative
        self._integral_used = integral
        self._integral = integral + dt * (gains.i * error)
        return proportional + derivative + integral

    def reset(self) -> None:
        """Forget the integral and the last terms."""
        self._integral = self._integral_used = 0.0
        self._proportional = self._derivative = 0.0

    def restore_integral(self, integral: float) -> None:
        """Replace the integral term, as anti-windup and a change of law do.

        Args:
            integral: In [N m].
        """
        self._integral = integral

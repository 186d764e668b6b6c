"""Published tuning rules for one joint: gains from its inertia, a closed-loop time and a delay.

The joint is the double integrator of the theory, m s^2, driven by the parallel PID that this
package has, u = p e + i integral of e + d de/dt.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.control.homogeneous_pid import Gains


class SeriesPid(NamedTuple):
    """A PID in series form, C(s) = gain (1 + 1 / (integral_time s)) (derivative_time s + 1)."""

    gain: float  # [N m/rad] Kc
    integral_time: float  # [s] tau_I
    derivative_time: float  # [s] tau_D

    def parallel(self) -> Gains:
        """Return the same controller in parallel form.

        Source: S. Skogestad, "Simple analytic rules for model reduction and PID controller
        tuning", Journal of Process Control 13 (2003) 291-309, section on the ideal form:
        Kc' = Kc (1 + tau_D / tau_I), Kc' / tau_I' = Kc / tau_I, Kc' tau_D' = Kc tau_D.
        """
        return Gains(
            p=self.gain * (1.0 + self.derivative_time / self.integral_time),
            i=self.gain / self.integral_time,
            d=self.gain * self.derivative_time,
        )


def simc_series(inertia: float, closed_loop_time: float, delay: float = 0.0) -> SeriesPid:
    r"""Return the SIMC tuning of a double integrating process with delay, in series form.

    .. math::
        K_c = \frac{1}{k''} \frac{1}{4 (\tau_c + \theta)^2}, \qquad
        \tau_I = \tau_D = 4 (\tau_c + \theta)

    with :math:`k'' = 1/m`.

    Source: S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning",
    Journal of Process Control 13 (2003) 291-309, Table 1, row "Double integrating".
    """
    time = _checked(inertia, closed_loop_time, delay)
    return SeriesPid(inertia / (4.0 * time**2), 4.0 * time, 4.0 * time)


def simc(inertia: float, closed_loop_time: float, delay: float = 0.0) -> Gains:
    """Return :func:`simc_series` in parallel form.

    With T = tau_c + theta: p = m / (2 T^2), i = m / (16 T^3), d = m / T.
    """
    return simc_series(inertia, closed_loop_time, delay).parallel()


def pole_placement(inertia: float, closed_loop_time: float, delay: float = 0.0) -> Gains:
    """Return gains that put all three poles of m s^3 + d s^2 + p s + i in one place.

    The poles lie at -w, w = 1 / (closed_loop_time + delay): p = 3 w^2 m, i = w^3 m, d = 3 w m.
    The delay is counted as a slower loop, as SIMC does; the poles are those without it.

    Source: K. J. Astrom and T. Hagglund, "Advanced PID Control" (ISA, 2006), pole placement by
    comparing the coefficients of the characteristic polynomial.
    """
    rate = 1.0 / _checked(inertia, closed_loop_time, delay)
    return Gains(p=3.0 * rate**2 * inertia, i=rate**3 * inertia, d=3.0 * rate * inertia)


Rule = Callable[[float, float, float], Gains]

RULES: Mapping[str, Rule] = {"simc": simc, "pole-placement": pole_placement}
"""The rules by name: gains of inertia [kg m^2], closed-loop time [s] and delay [s]."""


def _checked(inertia: float, closed_loop_time: float, delay: float) -> float:
    """Return the sum of the times, of numbers that are allowed."""
    named = {"inertia": inertia, "closed-loop time": closed_loop_time}
    for name, value in named.items():
        if not (math.isfinite(value) and value > 0.0):
            raise SettingError(f"the {name} must be positive and finite, not {value}")
    if not (math.isfinite(delay) and delay >= 0.0):
        raise SettingError(f"the delay must be finite and not negative, not {delay} s")
    return closed_loop_time + delay

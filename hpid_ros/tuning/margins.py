"""Classical robustness margins of a linear PID on one joint, with delay and velocity filter."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from hpid_ros.control.gains import Gains, require_hurwitz
from hpid_ros.errors import GainError

_DECADES = 4.0
_POINTS = 4001

Array = NDArray[np.float64]


class Margins(NamedTuple):
    """How far a loop is from instability.

    Attributes:
        gain: Factor by which the loop's gain may grow; infinite where any may.
        gain_reduction: Factor to which it may fall.
        phase: Phase that may be lost at the crossover, in [rad].
        delay: Delay that may be added, in [s].
        sensitivity: Ms, the largest magnitude of the sensitivity function.
        crossover: Where the loop's gain is one, in [rad/s].
    """

    gain: float
    gain_reduction: float
    phase: float
    delay: float
    sensitivity: float
    crossover: float


class _Loop:
    """The open loop L(jw) = (p + i/s + d s / (filter s + 1)) exp(-delay s) / (m s^2)."""

    def __init__(self, gains: Gains, inertia: float, delay: float, filter_time: float) -> None:
        self._gains, self._inertia = gains, inertia
        self.delay, self._filter_time = delay, filter_time
        middle = math.log10(gains.d / inertia)
        self.frequencies: Array = np.logspace(middle - _DECADES, middle + _DECADES, _POINTS)

    def response(self, frequency: float | Array) -> NDArray[np.complex128]:
        """Return L(jw)."""
        s = 1j * np.asarray(frequency)
        derivative = self._gains.d * s / (self._filter_time * s + 1.0)
        controller = self._gains.p + self._gains.i / s + derivative
        values: NDArray[np.complex128] = (
            controller * np.exp(-self.delay * s) / (self._inertia * s**2)
        )
        return values

    def gain(self, frequency: float | Array) -> Array:
        """Return the logarithm of the gain."""
        return np.asarray(np.log(np.abs(self.response(frequency))))

    def phase(self, frequency: float | Array) -> Array:
        """Return the phase beyond -180 degrees in [rad]: positive is what may be lost.

        Continuous in the frequency, since each factor's angle is: i - p w^2 + j d' w with the
        filter's angle and the delay's taken off.
        """
        w = np.asarray(frequency)
        g, tau = self._gains, self._filter_time
        # (p + i/s)(tau s + 1) + d s over s: numerator (d + p tau) s^2 + (p + i tau) s + i.
        numerator = np.angle(g.i - (g.d + g.p * tau) * w**2 + 1j * (g.p + g.i * tau) * w)
        return np.asarray(numerator - np.arctan(tau * w) - 0.5 * math.pi - self.delay * w)


def loop_margins(
    gains: Gains, inertia: float, *, delay: float = 0.0, filter_time: float = 0.0
) -> Margins:
    """Return the margins of the linear loop.

    Source of the definitions: K. J. Astrom and R. M. Murray, "Feedback Systems", section 9.3,
    and for Ms section 12.

    Args:
        gains: The gains, with integral action.
        inertia: What one unit of effort accelerates, in [kg m^2].
        delay: Of the loop, in [s].
        filter_time: Time constant of the first-order filter of the velocity, in [s].

    Raises:
        GainError: The loop is unstable, without or because of delay and filter.
    """
    require_hurwitz(gains, inertia)
    loop = _Loop(gains, inertia, delay, filter_time)
    bare = _Loop(gains, inertia, 0.0, filter_time)
    crossovers = _roots(loop.gain, loop.frequencies)
    tolerable = min(float(bare.phase(w)) / w for w in crossovers)
    if tolerable <= delay:
        raise GainError(
            f"the loop of p {gains.p:g}, i {gains.i:g}, d {gains.d:g} on {inertia:g} kg m^2 is "
            f"unstable with a velocity filter of {filter_time:g} s and a delay of {delay:g} s: "
            f"it tolerates {max(tolerable, 0.0):.3g} s"
        )
    factors = [math.exp(-float(loop.gain(w))) for w in _roots(loop.phase, loop.frequencies)]
    return Margins(
        gain=min((each for each in factors if each > 1.0), default=math.inf),
        gain_reduction=max((each for each in factors if each <= 1.0), default=0.0),
        phase=min(float(loop.phase(w)) for w in crossovers),
        delay=tolerable - delay,
        sensitivity=_sensitivity(loop),
        crossover=max(crossovers),
    )


def _roots(function: Callable[[float | Array], Array], frequencies: Array) -> list[float]:
    """Return where a function of the frequency changes its sign."""
    values = function(frequencies)
    changes = np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1]))
    return [
        float(brentq(function, frequencies[k], frequencies[k + 1], xtol=1e-14, rtol=1e-13))
        for k in changes
    ]


def _sensitivity(loop: _Loop) -> float:
    """Return the largest magnitude of 1 / (1 + L), which is 1 far above the crossover."""
    distances = np.abs(1.0 + loop.response(loop.frequencies))
    k = int(np.argmin(distances))
    low, high = (loop.frequencies[j] for j in (max(k - 1, 0), min(k + 1, _POINTS - 1)))
    nearest = minimize_scalar(
        lambda w: float(np.abs(1.0 + loop.response(w))), bounds=(low, high), method="bounded"
    )
    return 1.0 / min(float(nearest.fun), float(distances[k]), 1.0)

"""The margins of one stable sampled loop: gain, phase, delay, disk, and the peaks of S and T.

S = 1 / (1 + L) is the sensitivity, T = L / (1 + L) the complementary sensitivity, both at the
effort. Source of the definitions: K. J. Astrom and R. M. Murray, "Feedback Systems" (2nd ed.),
chapter 10; of the disk margin, P. Seiler, A. Packard, P. Gahinet, "An introduction to disk
margins", IEEE Control Systems Magazine 40(5) (2020), with the balanced disk (skew 0).
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import GainError
from hpid_ros.frequency.loop import FrozenLoop
from hpid_ros.frequency.plant import Complexes

_BELOW = 1e-2  # of the lowest corner frequency, where a search begins
_POINTS = 1200
_POINTS_A_TURN = 32  # of the phase that a delay turns up to the Nyquist frequency
_ZOOMS, _ZOOM_POINTS = 4, 33
_NEWTON_STEPS, _STEP, _TOLERANCE = 30, 1e-6, 1e-12
_HALF_POWER = math.sqrt(0.5)


@dataclass(frozen=True)
class Margins:
    """How far a loop is from instability, and how it amplifies."""

    gain: float  # factor by which its gain may grow; infinite where any may
    gain_reduction: float  # factor to which its gain may fall; 0 where any may
    phase: float  # [rad] phase that may be lost or gained at a crossover
    delay: float  # [s] further dead time that it bears
    disk: float  # alpha, the balanced disk margin, in (0, 2]
    sensitivity: float  # ms, the peak of |S|
    sensitivity_at: float  # [rad/s] where that is
    complementary: float  # mt, the peak of |T|
    complementary_at: float  # [rad/s] where that is
    crossover: float  # [rad/s] the highest frequency at which its gain is one; 0 for none
    bandwidth: float  # [rad/s] the first frequency at which |T| has fallen by 3 dB

    @property
    def disk_gain(self) -> tuple[float, float]:
        """Factors between which the gain may vary at any frequency, by the disk margin alone."""
        half = 0.5 * self.disk
        return (1.0 - half) / (1.0 + half), (1.0 + half) / (1.0 - half) if half < 1.0 else math.inf

    @property
    def disk_phase(self) -> float:
        """Phase that may vary at any frequency, by the disk margin alone, in [rad]."""
        return 2.0 * math.atan(0.5 * self.disk)


def margins_of(loop: FrozenLoop) -> Margins:
    """Return the margins of a loop.

    They are found on a grid of frequencies up to the Nyquist frequency that is refined where
    something happens. The delay margin solves 1 + L = 0 for frequency and dead time together, with
    the hold's response to a fraction of a period, and is exact like the others.
    """
    if not loop.is_stable:
        raise GainError(
            f"the sampled loop of p {loop.gains.p:g}, i {loop.gains.i:g}, d {loop.gains.d:g} on "
            f"{loop.joint.inertia:g} kg m^2 is unstable: spectral radius "
            f"{loop.spectral_radius:.6g}"
        )
    grid = frequency_grid(loop)
    response = loop.response(grid)
    crossovers = _roots(lambda w: np.log(np.abs(loop.response(w))), grid, np.log(np.abs(response)))
    spare = [_spare_phase(loop, each) for each in crossovers]
    factors = _critical_factors(loop, grid, response)
    disk, _ = _peak(lambda w: _distance(loop.response(w)), grid, _distance(response))
    sensitivity, s_at = _peak(lambda w: _s(loop.response(w)), grid, _s(response))
    complementary, t_at = _peak(lambda w: _t(loop.response(w)), grid, _t(response))
    fallen = _roots(lambda w: _t(loop.response(w)) - _HALF_POWER, grid, _t(response) - _HALF_POWER)
    return Margins(
        gain=min((each for each in factors if each > 1.0), default=math.inf),
        gain_reduction=max((each for each in factors if each <= 1.0), default=0.0),
        phase=min((min(each, math.tau - each) for each in spare), default=math.inf),
        delay=_delay_margin(loop, crossovers, spare),
        disk=min(2.0 / disk, 2.0),
        sensitivity=max(sensitivity, 1.0),
        sensitivity_at=s_at,
        complementary=max(complementary, 1.0),
        complementary_at=t_at,
        crossover=max(crossovers, default=0.0),
        bandwidth=min(fallen, default=math.inf),
    )


def frequency_grid(loop: FrozenLoop, points: int = _POINTS) -> Numbers:
    """Return frequencies that show all of a loop, (N,), increasing, in [rad/s].

    From far below its lowest corner frequency up to the Nyquist frequency, even in their
    logarithm, and close enough for every turn of the phase that a delay makes.
    """
    gains, joint = loop.gains, loop.joint
    p, i, d = gains.p, gains.i, gains.d
    squares = (_over(p, joint.inertia), _over(i, d))
    corners = [
        *(_over(i, p), _over(p, d), _over(d, joint.inertia), _over(joint.friction, joint.inertia)),
        *(math.sqrt(each) for each in squares),
        _over(p, joint.friction),
        joint.nyquist,
    ]
    least = _BELOW * min(each for each in corners if each > 0.0)
    turns = _POINTS_A_TURN * (joint.held.whole_periods + 2)
    even = np.linspace(joint.nyquist / turns, joint.nyquist, turns)
    grid: Numbers = np.unique(np.concatenate([np.geomspace(least, joint.nyquist, points), even]))
    return grid[grid <= joint.nyquist]


def _over(above: float, below: float) -> float:
    return above / below if below > 0.0 else 0.0


def _s(response: Complexes) -> Numbers:
    return np.asarray(1.0 / np.abs(1.0 + response))


def _t(response: Complexes) -> Numbers:
    return np.asarray(np.abs(response / (1.0 + response)))


def _distance(response: Complexes) -> Numbers:
    """Return |S - T|, whose largest value is 2 over the balanced disk margin."""
    return np.asarray(np.abs((1.0 - response) / (1.0 + response)))


def _spare_phase(loop: FrozenLoop, frequency: float) -> float:
    """Return the phase beyond -180 degrees, in (0, 2 pi]: what a delay may take."""
    angle = cmath.phase(complex(loop.response(np.array([frequency]))[0])) + math.pi
    return angle if angle > 0.0 else math.tau


def _critical_factors(loop: FrozenLoop, grid: Numbers, response: Complexes) -> list[float]:
    """Return the factors that would bring the response to -1 at some frequency."""
    # At the Nyquist frequency the response is real, and its imaginary part mere rounding.
    inner, values = grid[:-1], response[:-1]
    places = _roots(lambda w: np.imag(loop.response(w)), inner, np.imag(values))
    real = np.real(loop.response(np.array([*places, grid[-1]])))
    return [-1.0 / float(each) for each in real if each < 0.0]


def _roots(function: Callable[[Numbers], Numbers], grid: Numbers, values: Numbers) -> list[float]:
    """Return where a function changes its sign without a jump."""
    found = []
    for k in np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1])):
        low, high = grid[k], grid[k + 1]
        for _ in range(_ZOOMS):
            inside = np.linspace(low, high, _ZOOM_POINTS)
            signs = np.sign(function(inside))
            (changes,) = np.nonzero(signs[1:] != signs[:-1])
            if not changes.size:
                break
            low, high = inside[changes[0]], inside[changes[0] + 1]
        at_low, at_high = function(np.array([low, high]))
        share = at_low / (at_low - at_high) if at_low != at_high else 0.5
        found.append(float(low + share * (high - low)))
    return found


def _peak(
    function: Callable[[Numbers], Numbers], grid: Numbers, values: Numbers
) -> tuple[float, float]:
    """Return the largest value of a function, and where it is."""
    k = int(np.argmax(values))
    largest, place = float(values[k]), float(grid[k])
    low, high = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
    for _ in range(_ZOOMS):
        inside = np.linspace(low, high, _ZOOM_POINTS)
        found = function(inside)
        k = int(np.argmax(found))
        if found[k] > largest:
            largest, place = float(found[k]), float(inside[k])
        low, high = inside[max(k - 1, 0)], inside[min(k + 1, inside.size - 1)]
    return largest, place


def _delay_margin(loop: FrozenLoop, crossovers: list[float], spare: list[float]) -> float:
    """Return the least dead time beyond the loop's own at which 1 + L = 0, in [s]."""
    return min(
        (_solved(loop, w, phase / w) for w, phase in zip(crossovers, spare, strict=True)),
        default=math.inf,
    )


def _solved(loop: FrozenLoop, frequency: float, late: float) -> float:
    """Improve a frequency and a dead time until the loop passes through -1, by Newton steps.

    A continuous loop would have the start for its answer; the hold makes its gain depend on the
    fraction of the period, by little.
    """
    own, nyquist = loop.joint.delay, loop.joint.nyquist
    begin = late

    def off(w: float, delay: float) -> complex:
        return cmath.log(-complex(loop.with_delay(own + delay).response(np.array([w]))[0]))

    for _ in range(_NEWTON_STEPS):
        here = off(frequency, late)
        if abs(here) < _TOLERANCE:
            return late
        dw, dt = _STEP * frequency, _STEP * loop.joint.period
        by_w = (off(frequency - dw, late) - here) / -dw
        by_t = (off(frequency, late + dt) - here) / dt
        jacobian = np.array([[by_w.real, by_t.real], [by_w.imag, by_t.imag]])
        try:
            step_w, step_t = np.linalg.solve(jacobian, (-here.real, -here.imag))
        except np.linalg.LinAlgError:
            return begin
        frequency = min(frequency + float(step_w), nyquist)
        late += float(step_t)
        if not (frequency > 0.0 and late > 0.0 and math.isfinite(late)):
            return begin
    return late

"""Margins of a loop's family: every inertia, and every frozen multiplier.

The homogeneous law is, at each instant, the PID of gains that its multiplier has scaled. The
margins of those PIDs, each with its multiplier frozen, are a band in place of a line. They prove
nothing about a multiplier that moves, which certificates do
(:mod:`hpid_ros.stability`); at rest, where the norm is at its floor, the law is linear and
its margins are its own.

S = 1 / (1 + L) is the sensitivity, T = L / (1 + L) the complementary sensitivity, both at the
effort. Source of the definitions: K. J. Astrom and R. M. Murray, "Feedback Systems" (2nd ed.),
chapter 10; of the disk margin, P. Seiler, A. Packard, P. Gahinet, "An introduction to disk
margins", IEEE Control Systems Magazine 40(5) (2020), with the balanced disk (skew 0).
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.control.settings import LARGEST_NORM as NO_CAP
from hpid_ros.control.settings import LoopSettings
from hpid_ros.stability.frequency import Complexes, FrozenLoop, SampledJoint
from hpid_ros.stability.gain_check import LARGEST_QUOTED_NORM

_BELOW = 1e-2  # of the lowest corner frequency, where a search begins
_POINTS = 1200
_POINTS_A_TURN = 32  # of the phase that a delay turns up to the Nyquist frequency
_ZOOMS, _ZOOM_POINTS = 4, 33
_NEWTON_STEPS, _STEP, _TOLERANCE = 30, 1e-6, 1e-12
_INSIDE, _RESOLUTION = 1e-4, 1e-9  # of a delay margin
_DELAYS = 32  # that are tried where no crossing is found, or not the first
_HALF_POWER = math.sqrt(0.5)


@dataclass(frozen=True)
class Margins:
    """How far a loop is from instability, and how it amplifies."""

    gain: float  # factor by which its gain may grow; infinite where any may
    gain_reduction: float  # factor to which its gain may fall; 0 where any may
    phase: float  # [rad] phase that may be lost or gained at a crossover
    delay: float  # [s] further dead time that it bears
    disk: float  # alpha, the balanced disk margin, in (0, 2]
    sensitivity: float  # Ms, the peak of |S|
    sensitivity_at: float  # [rad/s] where that is
    complementary: float  # Mt, the peak of |T|
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
    crossovers = roots(lambda w: np.log(np.abs(loop.response(w))), grid, np.log(np.abs(response)))
    spare = [_spare_phase(loop, each) for each in crossovers]
    factors = _critical_factors(loop, grid, response)
    disk, _ = peak(lambda w: _distance(loop.response(w)), grid, _distance(response))
    sensitivity, s_at = peak(lambda w: _s(loop.response(w)), grid, _s(response))
    complementary, t_at = peak(lambda w: _t(loop.response(w)), grid, _t(response))
    fallen = roots(lambda w: _t(loop.response(w)) - _HALF_POWER, grid, _t(response) - _HALF_POWER)
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
        _over(i, p),
        _over(p, d),
        _over(d, joint.inertia),
        _over(joint.friction, joint.inertia),
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
    places = roots(lambda w: np.imag(loop.response(w)), inner, np.imag(values))
    real = np.real(loop.response(np.array([*places, grid[-1]])))
    return [-1.0 / float(each) for each in real if each < 0.0]


def roots(function: Callable[[Numbers], Numbers], grid: Numbers, values: Numbers) -> list[float]:
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


def peak(
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
    if not crossovers:
        return math.inf
    starts = [(w, phase / w) for w, phase in zip(crossovers, spare, strict=True)]
    found = [late for late in (_solved(loop, *each) for each in starts) if late is not None]
    least = min(found or (late for _, late in starts))
    is_least = len(found) == len(starts) and _bears(loop, (1.0 - _INSIDE) * least)
    return least if is_least else _searched(loop, least)


def _bears(loop: FrozenLoop, late: float) -> bool:
    return loop.with_delay(loop.joint.delay + late).is_stable


def _searched(loop: FrozenLoop, guess: float) -> float:
    """Return the least dead time that the loop does not bear, near a guess or before it, in [s].

    A fraction of a period changes the gain at the Nyquist frequency, too: a loop may leave
    stability there, where no crossover was without that dead time.
    """
    while _bears(loop, guess):
        guess *= 1.0 + 1.0 / _DELAYS
        if guess > MOST_PERIODS_LATE * loop.joint.period:
            return guess
    low = 0.0
    for late in np.linspace(0.0, guess, _DELAYS + 1)[1:].tolist():
        if not _bears(loop, late):
            guess = late
            break
        low = late
    while guess - low > _RESOLUTION * guess:
        middle = 0.5 * (low + guess)
        if _bears(loop, middle):
            low = middle
        else:
            guess = middle
    return low


def _solved(loop: FrozenLoop, frequency: float, late: float) -> float | None:
    """Improve a frequency and a dead time until the loop passes through -1; None if it does not.

    A continuous loop would have the start for its answer; the hold makes its gain depend on the
    fraction of the period, by little.
    """
    own, nyquist = loop.joint.delay, loop.joint.nyquist

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
            return None
        frequency = min(frequency + float(step_w), nyquist)
        late += float(step_t)
        if not (frequency > 0.0 and late > 0.0 and math.isfinite(late)):
            return None
    return None


MOST_PERIODS_LATE = 200
"""A delay of more control periods than this is refused: the loop's state would be as long."""

_LEAST_NORM = 1e-6  # where the floor is 0; the least floor that is ever computed
_INERTIAS, _MULTIPLIERS = 5, 17


@dataclass(frozen=True)
class LoopFamily:
    """The frozen loops of one joint."""

    settings: LoopSettings  # of the loop
    inertia: tuple[float, float]  # [kg m^2] least and largest inertia
    friction: float  # [N m s/rad] viscous friction
    delay: float  # [s] from state to effort, beyond the hold
    norms: tuple[float, float]  # least and largest norm that the loop reaches

    @property
    def is_homogeneous(self) -> bool:
        return self.settings.degree != 0.0

    @cached_property
    def inertias(self) -> tuple[float, ...]:
        """The inertias that are looked at, from the least on, even in their logarithm."""
        return _even(*self.inertia, _INERTIAS)

    @cached_property
    def multipliers(self) -> tuple[float, ...]:
        """The multipliers that are looked at, increasing, 1 among them if it is reached."""
        least, largest = sorted(norm**self.settings.degree for norm in self.norms)
        found = set(_even(least, largest, _MULTIPLIERS))
        if least <= 1.0 <= largest:
            found.add(1.0)
        return tuple(sorted(found))

    @property
    def at_rest(self) -> float:
        """The multiplier where the norm is least: at its floor, near the target."""
        return float(self.norms[0] ** self.settings.degree)

    def norm_of(self, multiplier: float) -> float:
        degree = self.settings.degree
        return float(multiplier ** (1.0 / degree)) if degree else 1.0

    def loop(self, inertia: float, multiplier: float = 1.0) -> FrozenLoop:
        period = self.settings.timing.control_period
        joint = SampledJoint(inertia, period, self.friction, self.delay)
        return FrozenLoop(self.settings, joint, multiplier)


def loop_family(
    settings: LoopSettings,
    inertia: tuple[float, float],
    friction: float = 0.0,
    delay: float = 0.0,
    largest_norm: float | None = None,
) -> LoopFamily:
    """Return the frozen loops of one joint."""
    period = settings.timing.control_period
    if not 0.0 <= delay <= MOST_PERIODS_LATE * period:
        raise SettingError(
            f"the delay must lie in [0, {MOST_PERIODS_LATE * period:g}] s, {MOST_PERIODS_LATE} "
            f"control periods, not {delay:g} s"
        )
    if largest_norm is not None and not 0.0 < largest_norm < math.inf:
        raise SettingError(f"the largest norm must be positive and finite, not {largest_norm:g}")
    if settings.model.is_decoupling:
        friction = 0.0
    for each in inertia:
        SampledJoint(each, period, friction, delay)
    norms = (1.0, 1.0)
    if settings.degree != 0.0:
        cap = settings.norm.cap
        default = cap if cap < NO_CAP else LARGEST_QUOTED_NORM
        highest = min(cap, default if largest_norm is None else largest_norm)
        least = min(max(settings.norm_floor, _LEAST_NORM), highest)
        norms = (least, highest)
    return LoopFamily(settings, inertia, friction, delay, norms)


class Case(NamedTuple):
    """One of the loops and its margins."""

    inertia: float  # [kg m^2]
    multiplier: float  # lam
    margins: Margins | None  # None where it is unstable


@dataclass(frozen=True)
class FamilyMargins:
    """The margins of several loops of a family."""

    cases: tuple[Case, ...]  # at least one

    @property
    def is_stable(self) -> bool:
        return not self.unstable

    @property
    def unstable(self) -> tuple[Case, ...]:
        return tuple(each for each in self.cases if each.margins is None)

    @cached_property
    def where(self) -> dict[str, Case]:
        """The loop in which each margin is worst, by the name of the margin.

        Empty where a loop is unstable: there is no margin then.
        """
        if self.unstable:
            return {}
        return {
            name: choose(self.cases, key=lambda case: getattr(case.margins, name))
            for name, choose in _WORST.items()
        }

    @property
    def worst(self) -> Margins | None:
        """The worst of each margin; None where a loop is unstable."""
        if self.unstable:
            return None
        values = {name: getattr(at.margins, name) for name, at in self.where.items()}
        for name in _PEAKS:  # where the worst peak is, not a worst place
            values[f"{name}_at"] = getattr(self.where[name].margins, f"{name}_at")
        return Margins(**values)

    def of(self, multipliers: tuple[float, ...]) -> FamilyMargins:
        return FamilyMargins(tuple(each for each in self.cases if each.multiplier in multipliers))


_PEAKS = ("sensitivity", "complementary")
_WORST: dict[str, Callable[..., Case]] = {
    each.name: max if each.name in (*_PEAKS, "gain_reduction") else min for each in fields(Margins)
}


def family_margins(family: LoopFamily) -> FamilyMargins:
    """Return the margins over all inertias and multipliers of a family, and of its plain PID.

    The multiplier 1 is among the cases even where the loop does not reach it: there stands the
    linear PID.
    """
    cases = []
    for multiplier in sorted({*family.multipliers, 1.0}):
        for inertia in family.inertias:
            try:
                margins = margins_of(family.loop(inertia, multiplier))
            except GainError:
                margins = None
            cases.append(Case(inertia, multiplier, margins))
    return FamilyMargins(tuple(cases))


def _even(low: float, high: float, count: int) -> tuple[float, ...]:
    """Return numbers from one to another, both among them exactly."""
    if low == high:
        return (low,)
    inside: Iterator[float] = map(float, np.geomspace(low, high, count)[1:-1])
    return (low, *inside, high)

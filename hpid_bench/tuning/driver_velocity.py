"""The filter behind which a driver reports a joint's velocity, from its recorded positions.

A recording holds the filter's input (the positions' differences) and its output, so that it can
be found by comparing their spectra. Where the noise of both has nothing in common the velocity is
another sensor's; then the noise of the differences must not count, and the spectra are weighed by
the variance of what they differ by (maximum likelihood with errors in both).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.signal import butter, coherence, welch

from hpid_ros.base.units import Numbers
from hpid_ros.simulation.settings import VelocityFilter

_LEAST_SAMPLES = 200
_MOST_SAMPLES = 2**16
_SHORTEST, _LONGEST = 0.2, 0.2  # control periods, [s]: time constants that are tried
_TIMES = 33
_LATER = (0, 1, 2)  # control periods by which a report may be late besides
_SAME_GAIN = 0.05
_NO_GAIN = 0.05  # of the position's own rate: less is no velocity
_SEGMENT = 256  # samples
_NOISY = 4.0  # times the noise that is expected: less is hardly any motion
_LOUDER = 2.0  # than differences without noise: a velocity has noise of its own
_LIKE = 0.5  # coherence of noise that is of one source
_THIRD_DIFFERENCE = 20.0  # of white noise, over the variance of the noise itself
_PLAIN = 0.3  # control periods: a lag that is no other than that of a difference
_BETTER = 0.9  # of the misfit of a plainer kind
_UNEXPLAINED = 1e-4  # of the velocity
_LIKELIER = 10.0  # than a plainer kind, as a logarithm
_MOVING = 20.0  # times the noise: what is less says nothing of a filter behind another sensor


class DriverVelocity(NamedTuple):
    """How a driver makes the velocity that it reports."""

    filter: VelocityFilter
    lag: float  # [s] by which it is behind the difference of two positions
    words: str


Coefficients = tuple[tuple[float, ...], tuple[float, ...]]


def _one_pole(samples: float) -> Coefficients:
    kept = samples / (1.0 + samples)
    return (1.0 - kept,), (-kept,)


def _two_poles(samples: float) -> Coefficients:
    kept = 0.5 * samples / (1.0 + 0.5 * samples)
    return ((1.0 - kept) ** 2,), (-2.0 * kept, kept * kept)


def _butterworth(samples: float) -> Coefficients:
    cutoff = min(math.sqrt(2.0) / (math.pi * max(samples, 1e-9)), 0.99)  # of half the sampling's
    forward, back = butter(2, cutoff)
    return tuple(map(float, forward)), tuple(map(float, back[1:]))


def _mean(samples: float) -> Coefficients:
    count = max(1, round(2.0 * samples + 1.0))
    return (1.0 / count,) * count, ()


_KINDS: dict[str, Callable[[float], Coefficients]] = {
    "a low pass": _one_pole,
    "a low pass of two poles": _two_poles,
    "a Butterworth low pass": _butterworth,
    "a mean over samples": _mean,
}
"""From a mean lag in samples to a filter, the plainest first."""


def driver_velocity(
    time: Numbers, position: Numbers, velocity: Numbers, noise: float
) -> DriverVelocity | None:
    """Return how a driver makes its velocities; None where nothing can be said.

    Args:
        time: Of the states, (N,), in [s].
        position: As measured, (N,), in [rad].
        velocity: As reported, (N,), in [rad/s].
        noise: Standard deviation of the position's noise, its rounding included, in [rad].
    """
    if len(time) < _LEAST_SAMPLES:
        return None
    if not velocity.any():
        return DriverVelocity(VelocityFilter((0.0,)), 0.0, "zero throughout: it is not measured")
    steps = np.diff(time)
    period = float(np.median(steps))
    rate, told = np.diff(position) / steps, velocity[1:]
    spectra = _Spectra.of(rate[:_MOST_SAMPLES], told[:_MOST_SAMPLES], period, noise)
    own = None if _is_of_positions(rate, told, period, noise) else _white_noise(told)
    best, gain = spectra.best(own, _LONGEST / period)
    if not math.isfinite(gain) or abs(gain) < _NO_GAIN:
        return None
    is_same = abs(gain - 1.0) < _SAME_GAIN
    factor = 1.0 if is_same else gain
    forward = tuple(factor * each for each in best.forward)
    lag = best.lag * period
    words = f"behind {best.kind} of {lag * 1e3:.2g} ms" if best.lag > _PLAIN else "without a lag"
    source = "the differences of its positions" if own is None else "a sensor of its own"
    words = f"{source}, {words}" + ("" if is_same else f", times {gain:.3g}")
    return DriverVelocity(VelocityFilter(forward, best.back, own), lag, words)


def _is_of_positions(rate: Numbers, told: Numbers, period: float, noise: float) -> bool:
    """Return whether the noise of the positions is in the velocities that are reported."""
    frequency, power = welch(rate, 1.0 / period, nperseg=_SEGMENT)
    is_noise = power < _NOISY * _noise_density(frequency, period, noise)
    if not is_noise.any():
        return _white_noise(told) <= _LOUDER * _white_noise(rate)
    _, alike = coherence(rate, told, 1.0 / period, nperseg=_SEGMENT)
    return bool(np.median(alike[is_noise]) > _LIKE)


def _noise_density(frequency: Numbers, period: float, noise: float) -> Numbers:
    """Return the one-sided density of the noise in differences, in [rad^2/s]."""
    difference = np.abs(2.0 * np.sin(np.pi * frequency * period)) ** 2
    return np.asarray(2.0 * noise**2 * difference / period)


def _white_noise(values: Numbers) -> float:
    return math.sqrt(float(np.var(np.diff(values, 3))) / _THIRD_DIFFERENCE)


class _Candidate(NamedTuple):
    kind: str
    forward: tuple[float, ...]
    back: tuple[float, ...]

    @classmethod
    def made(cls, kind: str, samples: float, later: int) -> _Candidate:
        forward, back = _KINDS[kind](samples)
        return cls(kind, (0.0,) * later + forward, back)

    @property
    def lag(self) -> float:
        """Mean lag, in samples."""
        return VelocityFilter(self.forward, self.back).lag


class _Spectra(NamedTuple):
    """Differences of positions and reported velocities, tapered, by frequency."""

    turn: NDArray[np.complex128]  # one sample later, (F,)
    rate: NDArray[np.complex128]
    told: NDArray[np.complex128]
    noise: Numbers  # variance of what noise of the position makes of the rate, (F,)
    weight: float  # variance of white noise of unit variance

    @property
    def least(self) -> float:
        """Variance that is left by what no filter of a few numbers explains."""
        return _UNEXPLAINED**2 * float(np.mean(np.abs(self.told) ** 2))

    @classmethod
    def of(cls, rate: Numbers, told: Numbers, period: float, noise: float) -> _Spectra:
        taper = np.hanning(len(rate))
        turn = np.exp(-2j * np.pi * np.fft.rfftfreq(len(rate)))
        weight = float(np.sum(taper**2))
        floor = weight * (noise / period) ** 2 * np.abs(1.0 - turn) ** 2
        return cls(turn, np.fft.rfft(rate * taper), np.fft.rfft(told * taper), floor, weight)

    def best(self, own: float | None, longest: float) -> tuple[_Candidate, float]:
        """Return the filter that fits best, and the factor that it takes besides."""
        found = [self._of_kind(kind, own, longest) for kind in _KINDS]
        chosen = found[0]
        for each in found[1:]:
            # A likelihood is a logarithm, a misfit is not.
            limit = chosen[0] - _LIKELIER if own is not None else chosen[0] * _BETTER
            if each[0] < limit:
                chosen = each
        return chosen[1], self._misfit(chosen[1], own)[1]

    def _of_kind(self, kind: str, own: float | None, longest: float) -> tuple[float, _Candidate]:
        def misfit(logarithm: float, later: int) -> float:
            return self._misfit(_Candidate.made(kind, math.exp(logarithm), later), own)[0]

        grid = np.log(np.geomspace(_SHORTEST, max(longest, 2.0 * _SHORTEST), _TIMES))
        tried = [
            (misfit(float(each), later), float(each), later) for later in _LATER for each in grid
        ]
        least, at, later = min(tried)
        if kind != "a mean over samples":
            step = float(grid[1] - grid[0])
            refined = minimize_scalar(
                misfit, bounds=(at - step, at + step), args=(later,), method="bounded"
            )
            if refined.fun <= least:
                least, at = float(refined.fun), float(refined.x)
        return least, _Candidate.made(kind, math.exp(at), later)

    def _misfit(self, candidate: _Candidate, own: float | None) -> tuple[float, float]:
        """Return how badly a filter fits, and the best factor."""
        top = np.polynomial.polynomial.polyval(self.turn, candidate.forward)
        bottom = np.polynomial.polynomial.polyval(self.turn, (1.0, *candidate.back))
        response = top / bottom
        made = response * self.rate
        if own is None:
            gain = float(np.vdot(made, self.told).real / max(np.vdot(made, made).real, 1e-300))
            return float(np.sum(np.abs(self.told - gain * made) ** 2)), gain
        variance = self.weight * own**2 + np.abs(response) ** 2 * self.noise + self.least
        moves = np.abs(self.rate) ** 2 > _MOVING * self.noise
        made, variance, told = made[moves], variance[moves], self.told[moves]
        size = float(np.sum(np.abs(made) ** 2 / variance))
        gain = float(np.sum((made.conj() * told).real / variance)) / max(size, 1e-300)
        left = np.abs(told - gain * made) ** 2 / variance
        return float(np.sum(left + np.log(variance))), gain

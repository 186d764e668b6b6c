"""Courses of one joint: sums of sines and steps, as large as limits allow, from rest to rest.

Sources: M. R. Schroeder, "Synthesis of low-peak-factor signals and binary sequences with low
autocorrelation", IEEE Transactions on Information Theory 16, 1970 (the first phases that are
tried); J. Swevers et al., "Optimal robot excitation and identification", IEEE Transactions on
Robotics and Automation 13, 1997 (sums of sines within the joint's limits); T. Flash and N. Hogan,
"The coordination of arm movements", Journal of Neuroscience 5, 1985 (minimum jerk).
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import SettingError

_DRAWS = 48  # of phases, beside Schroeder's
_LINES = 8  # sines in a sum
_SHORTEST_MOVE = 0.1  # [s]
_MOVE_KNOTS = 12  # in each step
_LEVELS = (1.0, -1.0, 0.5, -0.5, 0.0)
_PEAK_VELOCITY, _PEAK_ACCELERATION = 1.875, 10.0 / math.sqrt(3.0)  # of a minimum jerk step of 1

DWELL = 0.5
"""After each step in [s]."""

KNOTS_A_PERIOD = 20
"""Of the fastest sine; a quintic between them is off by 1e-5 of it."""


class Peaks(NamedTuple):
    """Largest absolute values; "rad" reads "m" where the joint slides."""

    position: float  # [rad] away from where the joint stood
    velocity: float  # [rad/s]
    acceleration: float  # [rad/s^2]


class Course(NamedTuple):
    """Where a joint is told to be, from where it stood; knots of a quintic spline."""

    times: Numbers  # [s] since its start, shape (knots,)
    position: Numbers  # [rad]
    velocity: Numbers  # [rad/s]
    acceleration: Numbers  # [rad/s^2]

    @property
    def peaks(self) -> Peaks:
        """Largest absolute values."""
        return Peaks(*(float(np.max(np.abs(each))) for each in self[1:]))

    @property
    def crest_factor(self) -> float:
        """Largest velocity over its root mean square; of one sine it is 1.41."""
        return self.peaks.velocity / float(np.sqrt(np.mean(self.velocity**2)))

    def scaled(self, factor: float) -> Course:
        """Return it so many times as large."""
        return Course(self.times, *(factor * each for each in self[1:]))

    def factor_within(self, limits: Peaks) -> float:
        """Return how many times as large it may be."""
        return min(limit / peak for limit, peak in zip(limits, self.peaks, strict=True))


def multisine(
    duration: float, band: tuple[float, float], fade: float, limits: Peaks, seed: int = 0
) -> Course:
    """Return the largest sum of sines within limits, of the phases that are tried.

    Its sines are harmonics of the whole, spread evenly over the logarithm of the frequency, each
    with the same velocity: friction shows at the slow ones, inertia at the fast ones.
    """
    low, high = band
    if not 0.0 < low < high < math.inf:
        raise SettingError(
            f"frequencies must be two positive numbers, the lower first, not {low:g} and {high:g}"
        )
    if not (math.isfinite(duration) and duration >= max(2.5 * fade, 1.0 / low)):
        least = max(2.5 * fade, 1.0 / low)
        raise SettingError(
            f"a sum of sines from {low:g} Hz on must last {least:g} s at least, not {duration:g}"
        )
    base = 1.0 / duration
    turns = np.unique(np.rint(np.geomspace(low / base, high / base, _LINES)).clip(1))
    knots = math.ceil(duration * turns[-1] * base * KNOTS_A_PERIOD) + 1
    times = np.linspace(0.0, duration, knots)
    window = faded(times, fade)
    count = len(turns)
    draw = np.random.default_rng(seed)
    schroeder = -np.pi * np.arange(count) * (np.arange(count) + 1) / count
    tried = [schroeder, *draw.uniform(0.0, 2.0 * np.pi, (_DRAWS, count))]
    courses = [_sum(times, 2.0 * np.pi * base * turns, phases, window) for phases in tried]
    factors = [_even_factor(each, limits) for each in courses]
    best = int(np.argmax(factors))
    course = courses[best]
    return course.scaled(course.factor_within(limits))


def _even_factor(course: Course, limits: Peaks) -> float:
    """Return how large a course gets within limits, by its root mean square velocity."""
    return course.factor_within(limits) * float(np.sqrt(np.mean(course.velocity**2)))


def _sum(times: Numbers, rates: Numbers, phases: Numbers, window: Course) -> Course:
    """Return sines of one velocity each, in a window; product rule for the derivatives."""
    angles = np.outer(times, rates) + phases
    wave = np.sum(np.sin(angles) / rates, axis=1)
    rate = np.sum(np.cos(angles), axis=1)
    bend = -np.sum(np.sin(angles) * rates, axis=1)
    w, dw, ddw = window[1:]
    return Course(times, w * wave, dw * wave + w * rate, ddw * wave + 2.0 * dw * rate + w * bend)


def faded(times: Numbers, fade: float) -> Course:
    """Return a window that rises from 0 to 1 in the time of a fade, and falls at the end."""
    end = float(times[-1])
    up = _minimum_jerk(times / fade, fade)
    down = _minimum_jerk((end - times) / fade, fade)
    return Course(
        times,
        up.position * down.position,
        up.velocity - down.velocity,  # nowhere do both move: the course is longer than two fades
        up.acceleration + down.acceleration,
    )


def _minimum_jerk(s: Numbers, duration: float) -> Course:
    """Return a step from 0 to 1 over s in [0, 1], with derivatives by time."""
    s = np.clip(s, 0.0, 1.0)
    return Course(
        s * duration,
        s**3 * (10.0 - 15.0 * s + 6.0 * s * s),
        30.0 * s**2 * (1.0 - s) ** 2 / duration,
        60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / duration**2,
    )


def steps(duration: float, limits: Peaks) -> Course:
    """Return steps up and down, each of minimum jerk and as fast as limits allow, with rests."""
    pattern = [move_time(abs(b - a), limits) for a, b in pairwise((0.0, *_LEVELS))]
    whole = sum(pattern) + DWELL * len(pattern)
    if not (math.isfinite(duration) and duration >= whole):
        raise SettingError(f"these steps must last {whole:.3g} s at least, not {duration:g}")
    parts = [Course(*(np.zeros(1) for _ in range(4)))]
    level, begin = 0.0, 0.0
    for wanted in _LEVELS * int(duration / whole):
        move = move_time(abs(wanted - level), limits)
        parts += moved(begin, move, level * limits.position, wanted * limits.position)
        level, begin = wanted, begin + move + DWELL
    return Course(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def move_time(levels: float, limits: Peaks) -> float:
    """Return the least time of a step over so many amplitudes, in [s]."""
    distance = levels * limits.position
    return max(
        _PEAK_VELOCITY * distance / limits.velocity,
        math.sqrt(_PEAK_ACCELERATION * distance / limits.acceleration),
        _SHORTEST_MOVE,
    )


def longest_move(duration: float, limits: Peaks) -> float:
    """Return how far a step of so many seconds may go, in [rad]."""
    return min(
        limits.position,
        limits.velocity * duration / _PEAK_VELOCITY,
        limits.acceleration * duration**2 / _PEAK_ACCELERATION,
    )


def moved(
    begin: float, move: float, start: float, end: float, dwell: float = DWELL
) -> list[Course]:
    """Return the knots after the first one of a step, and the one at the end of its rest."""
    rise = _minimum_jerk(np.linspace(0.0, 1.0, _MOVE_KNOTS + 1)[1:], move)
    way = end - start
    moving = Course(begin + rise.times, start + way * rise[1], way * rise[2], way * rise[3])
    rest = np.zeros(1)
    return [moving, Course(rest + begin + move + dwell, rest + end, rest, rest)]

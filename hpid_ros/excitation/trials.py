"""Courses on which a person tries a joint: as large as is wished, and smaller where limits say so.

Source: T. Flash and N. Hogan, "The coordination of arm movements", Journal of Neuroscience 5, 1985
(minimum jerk).
"""

from __future__ import annotations

import math

import numpy as np

from hpid_ros.base.errors import SettingError
from hpid_ros.excitation.courses import (
    DWELL,
    KNOTS_A_PERIOD,
    Course,
    Peaks,
    faded,
    longest_move,
    move_time,
    moved,
)

_LEAST_DWELL = 0.2  # [s]
_LONGEST_DWELL = 0.2  # of the time for one way
_FADE_SHARE = 0.4  # of the whole, at most: two fades and what is between them


def there_and_back(duration: float, limits: Peaks, *, is_fast: bool) -> Course:
    """Return a move of minimum jerk to the amplitude, a rest, the way back, and a rest."""
    fastest = move_time(1.0, limits)
    half = 0.5 * duration
    least = (fastest if is_fast else 0.0) + _LEAST_DWELL
    if not (math.isfinite(duration) and half >= 1.01 * least):
        raise SettingError(f"this must last {2.02 * least:.3g} s at least, not {duration:g}")
    move = fastest if is_fast else half - min(DWELL, max(_LEAST_DWELL, _LONGEST_DWELL * half))
    dwell = half - move
    size = longest_move(move, limits)
    start = [Course(*(np.zeros(1) for _ in range(4)))]
    parts = start + moved(0.0, move, 0.0, size, dwell) + moved(half, move, size, 0.0, dwell)
    return Course(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def sine(duration: float, frequency: float, fade: float, limits: Peaks) -> Course:
    """Return whole periods of a sine with a soft start and a soft end.

    Args:
        duration: In [s]; the nearest whole number of periods is taken, at least one.
        frequency: In [Hz].
        fade: Time of the soft start, and of the soft end, in [s]; at most 0.4 of the whole.
        limits: Its amplitude, and what else it may reach.

    Raises:
        SettingError: A number is none that can be used.
    """
    for name, value in (("duration", duration), ("frequency", frequency), ("fade", fade)):
        if not 0.0 < value < math.inf:
            raise SettingError(f"the {name} of a sine must be positive, not {value:g}")
    periods = max(1, round(duration * frequency))
    whole = periods / frequency
    fade = min(fade, _FADE_SHARE * whole)
    knots = math.ceil(KNOTS_A_PERIOD * max(periods, whole / fade)) + 1
    times = np.linspace(0.0, whole, knots)
    rate = 2.0 * math.pi * frequency
    wave, slope = np.sin(rate * times), rate * np.cos(rate * times)
    w, dw, ddw = faded(times, fade)[1:]
    course = Course(
        times, w * wave, dw * wave + w * slope, ddw * wave + 2.0 * dw * slope - w * rate**2 * wave
    )
    return course.scaled(course.factor_within(limits))

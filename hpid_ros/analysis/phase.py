"""A joint's path in the plane of its error and its error's rate."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.analysis.series import JointSeries

RATE_WINDOW = 0.025
"""Time over which the error's rate is fitted, in [s]."""


LEAST_JUMP = 1e-3
"""Lower jumps of a reference are not told from its own resolution, in [rad]."""
JUMP_RATIO = 10.0
"""A reference jumps where it moves so many times further than in the periods before and after."""


class PhaseCurve(NamedTuple):
    """Error in [rad] and error rate in [rad/s] of a joint, (N,) each.

    The rate is NaN where the curve is torn: from one side of a jump of the reference to the other
    no joint has moved.
    """

    error: NDArray[np.float64]
    rate: NDArray[np.float64]


def phase_curve(series: JointSeries, points: int) -> PhaseCurve:
    """Return a joint's error and the rate of its error; nothing without a reference.

    The rate is the slope of a parabola fitted over 25 ms, since a bare difference of encoder
    counts would hide everything. A jump of the reference is in no fit.

    Args:
        series: The joint.
        points: So many at most, evenly spaced.
    """
    if not series.has_reference:
        return PhaseCurve(np.empty(0), np.empty(0))
    t, error = series.time, series.error
    stride = max(1, -(-error.size // points))
    if error.size < 4 or t[-1] <= t[0]:
        return PhaseCurve(error[::stride], np.zeros_like(error[::stride]))
    smooth, rate = np.empty_like(error), np.empty_like(error)
    jumps = _jumps(series.reference)
    for first, stop in pairwise((0, *jumps, error.size)):
        smooth[first:stop], rate[first:stop] = _fitted(t[first:stop], error[first:stop])
    torn = {(at - 1) // stride for at in jumps}  # the last one shown before a jump
    smooth, rate = smooth[::stride], rate[::stride]
    rate[list(torn)] = np.nan
    return PhaseCurve(smooth, rate)


def _jumps(reference: NDArray[np.float64]) -> list[int]:
    """Return the first samples after the jumps of a reference."""
    moved = np.abs(np.diff(reference))
    beside = np.zeros_like(moved)
    beside[1:] = moved[:-1]
    beside[:-1] = np.maximum(beside[:-1], moved[1:])
    found = (moved >= LEAST_JUMP) & (moved > JUMP_RATIO * beside)
    return [int(at) + 1 for at in np.flatnonzero(found)]


def _fitted(
    t: NDArray[np.float64], error: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return an error and its rate, each smoothed over :data:`RATE_WINDOW`."""
    if error.size < 4 or t[-1] <= t[0]:
        return error, np.full_like(error, np.nan)
    from scipy.signal import savgol_filter  # slow to import, and only needed here

    period = float(t[-1] - t[0]) / (error.size - 1)
    half = max(1, min(round(0.5 * RATE_WINDOW / period), (error.size - 1) // 2))
    even = np.interp(np.linspace(t[0], t[-1], error.size), t, error)
    rate = savgol_filter(even, 2 * half + 1, min(2, 2 * half), deriv=1, delta=period)
    return savgol_filter(even, 2 * half + 1, min(2, 2 * half)), rate

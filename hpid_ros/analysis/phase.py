"""A joint's path in the plane of its error and its error's rate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.analysis.series import JointSeries

RATE_WINDOW = 0.025
"""Time over which the error's rate is fitted, in [s]."""


class PhaseCurve(NamedTuple):
    """Error in [rad] and error rate in [rad/s] of a joint, (N,) each."""

    error: NDArray[np.float64]
    rate: NDArray[np.float64]


def phase_curve(series: JointSeries, points: int) -> PhaseCurve:
    """Return a joint's error and the rate of its error; nothing without a reference.

    The rate is the slope of a parabola fitted over 25 ms, since a bare difference of encoder
    counts would hide everything.

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
    from scipy.signal import savgol_filter  # slow to import, and only needed here

    period = float(t[-1]) / (error.size - 1)
    half = max(1, min(round(0.5 * RATE_WINDOW / period), (error.size - 1) // 2))
    even = np.interp(np.linspace(0.0, t[-1], error.size), t, error)
    rate = savgol_filter(even, 2 * half + 1, min(2, 2 * half), deriv=1, delta=period)
    smooth = savgol_filter(even, 2 * half + 1, min(2, 2 * half))
    return PhaseCurve(smooth[::stride], rate[::stride])

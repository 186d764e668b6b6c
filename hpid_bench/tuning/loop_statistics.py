"""Figures of one joint's recording: errors, largest velocity, resolution, noise, period."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.messages.series import JointSeries

_LEAST_STATES = 10
_SAME_STEP = 1e-9  # [rad]; closer positions are the same count, told apart by rounding
_WINDOW = 200  # samples
_THIRD_DIFFERENCE = 20.0  # of white noise, over the variance of the noise itself: 1 + 9 + 9 + 1
_BELOW_A_COUNT = 0.2  # of a count: less noise than that cannot be told from rounding


@dataclass(frozen=True)
class LoopStatistics:
    """Figures of one joint's recording."""

    largest_error: float  # [rad]
    mean_square_error: float  # [rad^2]
    largest_rate: float  # [rad/s] largest velocity of the joint, filtered as the loop would
    resolution: float  # [rad] smallest step of the measured position; 0 when it has none
    period: float  # [s] median time between two states
    states: int  # how many states there were


def loop_statistics(series: JointSeries, filter_time_constant: float) -> LoopStatistics:
    """Return the statistics of one joint's recording."""
    error = series.error
    if len(error) < _LEAST_STATES:
        raise SettingError(
            f"{series.joint!r} has {len(error)} states in the bag; at least {_LEAST_STATES} are "
            f"needed"
        )
    largest = float(np.max(np.abs(error)))
    if largest == 0.0:
        raise SettingError(f"the error of {series.joint!r} is zero throughout the bag")
    return LoopStatistics(
        largest_error=largest,
        mean_square_error=float(np.mean(np.square(error))),
        largest_rate=_largest_rate(series, filter_time_constant),
        resolution=position_resolution(series),
        period=median_period(series),
        states=len(error),
    )


def _largest_rate(series: JointSeries, filter_time_constant: float) -> float:
    """Return the largest velocity of the joint, filtered as the loop would.

    Not of the error: where the reference jumps the error's rate has no bound.
    """
    rate, largest = 0.0, 0.0
    time = series.time
    for dt, step in zip(np.diff(time), np.diff(series.position), strict=True):
        rate += dt / (filter_time_constant + dt) * (step / dt - rate)
        largest = max(largest, abs(rate))
    return float(largest)


def median_period(series: JointSeries) -> float:
    return float(np.median(np.diff(series.state_stamps_ns))) * SECONDS_PER_NANOSECOND


def position_resolution(series: JointSeries) -> float:
    """Return the smallest step between two positions, in [rad]; 0 where steps are no grid."""
    steps = np.diff(np.unique(series.position))
    steps = steps[steps > _SAME_STEP]
    if len(steps) == 0:
        return 0.0
    smallest = float(np.min(steps))
    counts = steps / smallest
    is_grid = np.all(np.abs(counts - np.round(counts)) < 0.05)
    return smallest if is_grid else 0.0


def position_noise(series: JointSeries, resolution: float) -> float:
    """Return the standard deviation of a position's noise before it is rounded, in [rad].

    From third differences, in which smooth motion leaves no trace; the median over windows, so
    that jumps and gaps do not count.
    """
    differences = np.diff(series.position, 3)
    windows = max(1, len(differences) // _WINDOW)
    if len(differences) < 2:
        return 0.0
    each = [float(np.var(window)) for window in np.array_split(differences, windows)]
    whole = float(np.median(each)) / _THIRD_DIFFERENCE
    noise = math.sqrt(max(0.0, whole - resolution**2 / 12.0))
    return 0.0 if noise < _BELOW_A_COUNT * resolution else noise

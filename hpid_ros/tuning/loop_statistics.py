"""What a recording says about a loop: how large its errors are, how coarse its sensor is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hpid_ros.analysis.series import JointSeries
from hpid_ros.errors import SettingError

_NANOSECONDS = 1e-9
_LEAST_STATES = 10
_SAME_STEP = 1e-9  # [rad]; closer positions are the same count, told apart by rounding


@dataclass(frozen=True)
class LoopStatistics:
    """Figures of one joint's recording.

    Attributes:
        largest_error: In [rad].
        largest_rate: Largest velocity of the joint, filtered as the loop would, in [rad/s].
        resolution: Smallest step of the measured position in [rad]; 0 when it has none.
        period: Median time between two states in [s].
        states: How many states there were.
    """

    largest_error: float
    largest_rate: float
    resolution: float
    period: float
    states: int


def loop_statistics(series: JointSeries, filter_time_constant: float) -> LoopStatistics:
    """Return the statistics of one joint's recording.

    Args:
        series: The recording.
        filter_time_constant: Of the velocity filter that the loop will have, in [s].

    Raises:
        SettingError: The recording is too short, or the error is zero throughout.
    """
    error = series.error
    if len(error) < _LEAST_STATES:
        raise SettingError(
            f"{series.joint!r} has {len(error)} states in the bag; at least {_LEAST_STATES} are "
            f"needed"
        )
    largest = float(np.max(np.abs(error)))
    if largest == 0.0:
        raise SettingError(f"the error of {series.joint!r} is zero throughout the bag")
    period = float(np.median(np.diff(series.state_stamps_ns))) * _NANOSECONDS
    return LoopStatistics(
        largest_error=largest,
        largest_rate=_largest_rate(series, filter_time_constant),
        resolution=_resolution(series),
        period=period,
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


def _resolution(series: JointSeries) -> float:
    """Return the smallest step between two different positions, if steps repeat themselves."""
    steps = np.diff(np.unique(series.position))
    steps = steps[steps > _SAME_STEP]
    if len(steps) == 0:
        return 0.0
    smallest = float(np.min(steps))
    counts = steps / smallest
    is_grid = np.all(np.abs(counts - np.round(counts)) < 0.05)
    return smallest if is_grid else 0.0

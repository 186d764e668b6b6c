"""Steps of a reference, and the response of a joint.

Definitions of rise, settling and overshoot as MATLAB's ``stepinfo`` and python-control's
``step_info`` have them: 10 % to 90 %, 2 %, percent of the height.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.analysis.indices.integrals import exact_sum
from hpid_ros.base.arrays import Numbers
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.recordings.series import JointSeries

SHORTEST_HOLD = 0.1
"""A reference that moves again within this time has not stepped, in [s]."""
LEAST_HEIGHT = 1e-3
"""Lower steps are not told from sensor noise, in [rad]."""
LEAST_SHARE = 0.1
"""Steps lower than this share of the joint's highest are left out."""
RISE_FROM, RISE_TO = 0.1, 0.9
SETTLED_WITHIN = 0.02
STEADY_SHARE = 0.1
"""The steady-state error is the mean over this last part of the hold."""


class Step(NamedTuple):
    """One step: samples ``first`` to ``stop`` (exclusive) of the joint hold the new value."""

    first: int  # the first sample at the new reference
    stop: int  # the first sample after the hold
    start: float  # [rad] what is left
    goal: float  # [rad] the new reference

    @property
    def height(self) -> float:
        """Goal minus start, in [rad]."""
        return self.goal - self.start


class StepResponse(NamedTuple):
    """How a joint answered one step; see docs/indices.md."""

    rise_time: float  # [s] from 10 % to 90 % of the height; infinite if 90 % is never reached
    settling_time: float  # [s] from the step until the joint stays within 2 % of the height
    overshoot: float  # [%] largest excursion beyond the goal of the height
    steady_state_error: float  # [rad] magnitude of the mean error over the last tenth of the hold


def find_steps(series: JointSeries) -> list[Step]:
    """Return the steps of a joint's reference.

    A step is a jump between two samples, out of rest into a hold; at the first sample, the jump
    is from the measured position. Smooth motions have none.
    """
    reference, stamps = series.reference, series.state_stamps_ns
    if not series.has_reference:
        return []
    steps = []
    for begin, stop in _holds(reference, stamps):
        if begin == 0:
            start = float(series.position[0])
        elif begin >= 2 and reference[begin - 2] != reference[begin - 1]:
            continue  # the end of a motion
        else:
            start = float(reference[begin - 1])
        steps.append(Step(begin, stop, start, float(reference[begin])))
    highest = max((abs(step.height) for step in steps), default=0.0)
    least = max(LEAST_HEIGHT, LEAST_SHARE * max(highest, _range(reference)))
    return [step for step in steps if abs(step.height) >= least]


def _holds(reference: Numbers, stamps_ns: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield first sample and end of every stretch of one value that lasts long enough.

    Made for hours of motion, in which nearly every sample is another: beside one flag for each
    sample nothing is kept but what holds.
    """
    is_same = np.zeros(reference.size + 1, dtype=np.bool_)
    np.equal(reference[1:], reference[:-1], out=is_same[1:-1])
    edges = np.flatnonzero(is_same[1:] != is_same[:-1])
    pairs = {int(first): int(last) + 1 for first, last in edges.reshape(-1, 2)}
    # A value of one sample holds as well, where the next sample is late.
    least_ns = round(SHORTEST_HOLD * NANOSECONDS)
    for index in np.flatnonzero(np.diff(stamps_ns) >= least_ns):
        if not is_same[index] and not is_same[index + 1]:
            pairs[int(index)] = int(index) + 1
    for first in sorted(pairs):
        # The value lasts to the next one.
        end = min(pairs[first], reference.size - 1)
        if stamps_ns[end] - stamps_ns[first] >= least_ns:
            yield first, pairs[first]


def step_response(series: JointSeries, step: Step) -> StepResponse:
    """Return how a joint answered a step."""
    t = series.time[step.first : step.stop]
    position = series.position[step.first : step.stop]
    progress = (position - step.start) / step.height
    begin, end = (_first_crossing(t, progress, level) for level in (RISE_FROM, RISE_TO))
    tail = t >= t[-1] - STEADY_SHARE * (t[-1] - t[0])
    error = step.goal - position[tail]
    return StepResponse(
        rise_time=end - begin if math.isfinite(end) else math.inf,
        settling_time=_settling_time(t, progress),
        overshoot=100.0 * max(0.0, float(progress.max()) - 1.0),
        steady_state_error=abs(exact_sum(error)) / error.size,
    )


def _range(values: Numbers) -> float:
    return float(values.max() - values.min())


def _first_crossing(t: Numbers, x: Numbers, level: float) -> float:
    """Return when x first reaches a level, on straight lines between samples, in [s]."""
    reached = np.flatnonzero(x >= level)
    if not reached.size:
        return math.inf
    k = int(reached[0])
    if k == 0:
        return float(t[0])
    share = (level - x[k - 1]) / (x[k] - x[k - 1])
    return float(t[k - 1] + share * (t[k] - t[k - 1]))


def _settling_time(t: Numbers, progress: Numbers) -> float:
    """Return the time after which progress stays near one, on straight lines, in [s]."""
    deviation = np.abs(progress - 1.0)
    outside = np.flatnonzero(deviation > SETTLED_WITHIN)
    if not outside.size:
        return 0.0
    k = int(outside[-1])
    if k + 1 == t.size:
        return math.inf
    share = (deviation[k] - SETTLED_WITHIN) / (deviation[k] - deviation[k + 1])
    return float(t[k] + share * (t[k + 1] - t[k]) - t[0])

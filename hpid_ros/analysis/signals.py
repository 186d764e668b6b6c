"""Signals between a run's arrays and a drawing: their norm over joints, and fewer samples."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.analysis.quantities import Data
from hpid_ros.base.arrays import Numbers
from hpid_ros.recordings.series import JointSeries, RunSeries, seconds_since


class Signal(NamedTuple):
    """One signal: integer stamps in [ns], (N,), and its values at them, (N,)."""

    stamps_ns: NDArray[np.int64]
    values: Numbers


NO_SIGNAL = Signal(np.empty(0, dtype=np.int64), np.empty(0))


def position_of(series: JointSeries) -> Signal:
    """Return a joint's measured position, in [rad]."""
    return Signal(series.state_stamps_ns, series.position)


def reference_of(series: JointSeries) -> Signal:
    """Return a joint's reference, in [rad]; nothing if it has none."""
    return Signal(series.state_stamps_ns, series.reference) if series.has_reference else NO_SIGNAL


def error_of(series: JointSeries) -> Signal:
    """Return a joint's error, in [rad]; nothing without a reference."""
    return Signal(series.state_stamps_ns, series.error) if series.has_reference else NO_SIGNAL


def effort_of(series: JointSeries) -> Signal:
    """Return a joint's effort, in [N m]."""
    return Signal(series.command_stamps_ns, series.effort)


def has_any(runs: Sequence[RunSeries], data: Data) -> bool:
    """Tell whether any joint of some runs has a reference, or an effort."""
    joints = [series for run in runs for series in run.joints]
    if data is Data.REFERENCE:
        return any(series.has_reference for series in joints)
    return any(series.has_effort for series in joints)


class GainSignals(NamedTuple):
    """What a joint's homogeneous law did to its gains."""

    norm: Signal  # homogeneous norm of error and error rate at each state, before floor and cap
    # factor of the loop's bandwidth: the norm, within floor and cap, to the power of the degree
    multiplier: Signal


Gains = Mapping[str, Mapping[str, GainSignals]]
"""What the laws did, by label and joint."""


def norm_over_joints(signals: Sequence[Signal]) -> Signal:
    """Return the Euclidean norm over joints of their signals, at all stamps that any has.

    Between its samples a joint's value lies on a straight line, as the indices see it; before
    its first and after its last sample it counts as zero.

    Source: the paper's equation of the norm over joints in the experimental section.
    """
    stamps = signals[0].stamps_ns
    if not all(np.array_equal(stamps, signal.stamps_ns) for signal in signals[1:]):
        stamps = np.unique(np.concatenate([signal.stamps_ns for signal in signals]))
    squares = np.zeros(stamps.size)
    for stamps_ns, values in signals:
        if stamps_ns.size == stamps.size:  # as many as there are: the same ones
            squares += np.square(values)
        elif stamps_ns.size:
            origin = int(stamps[0])
            at, known = seconds_since(stamps, origin), seconds_since(stamps_ns, origin)
            squares += np.square(np.interp(at, known, values, left=0.0, right=0.0))
    return Signal(stamps, np.sqrt(squares))


def norm_of_run(run: RunSeries, signal_of: Callable[[JointSeries], Signal]) -> Signal:
    """Return the norm over a run's joints; nothing where one of them has no signal."""
    signals = [signal_of(series) for series in run.joints]
    return norm_over_joints(signals) if all(each.values.size for each in signals) else NO_SIGNAL


def envelope(signal: Signal, buckets: int) -> Signal:
    """Return the samples of a signal that a drawing of some width needs; no peak is lost.

    The signal is cut into buckets of equally many samples; of each, the first, the lowest, the
    highest and the last stay. Drawn with at least one bucket a pixel, the line covers the same
    pixels as the whole signal.
    """
    stamps_ns, values = signal
    if values.size <= 4 * buckets:
        return signal
    edges = np.linspace(0, values.size, buckets + 1).astype(np.intp)
    kept = [edges[:-1], edges[1:] - 1]
    for first, stop in itertools.pairwise(edges):
        bucket = values[first:stop]
        kept.append(first + np.array([bucket.argmin(), bucket.argmax()]))
    indices = np.unique(np.concatenate(kept))
    return Signal(stamps_ns[indices], values[indices])

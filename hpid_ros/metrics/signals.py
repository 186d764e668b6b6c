"""Signals of a recording over time, as figures show them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import Numbers
from hpid_ros.messages.series import JointSeries, RunSeries, seconds_since
from hpid_ros.metrics.quantities import Data


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
    return _known(series, series.reference) if series.has_reference else NO_SIGNAL


def error_of(series: JointSeries) -> Signal:
    """Return a joint's error, in [rad]; nothing without a reference."""
    return _known(series, series.error) if series.has_reference else NO_SIGNAL


def _known(series: JointSeries, values: Numbers) -> Signal:
    """Return values at the states at which there is a reference."""
    if series.known is None:
        return Signal(series.state_stamps_ns, values)
    return Signal(series.state_stamps_ns[series.known], values[series.known])


def effort_of(series: JointSeries) -> Signal:
    """Return a joint's effort, in [N m]."""
    return Signal(series.command_stamps_ns, series.effort)


def has_any(runs: Sequence[RunSeries], data: Data) -> bool:
    """Return whether any joint of some runs has a reference, or an effort."""
    joints = (each for run in runs for each in run.outlines)
    return any(each.has_reference if data is Data.REFERENCE else each.commands for each in joints)


def norm_over_joints(signals: Iterable[Signal]) -> Signal:
    """Return the Euclidean norm over joints of their signals, at all stamps that any has.

    The signals are gone through twice, and only one of them need be in memory.

    Between its samples a joint's value lies on a straight line, as the indices see it; before
    its first and after its last sample it counts as zero.

    Source: the paper's equation of the norm over joints in the experimental section.
    """
    unlike: list[NDArray[np.int64]] = []  # stamps that others do not have
    for each in signals:
        if not any(np.array_equal(each.stamps_ns, known) for known in unlike):
            unlike.append(each.stamps_ns)
    stamps = unlike[0] if len(unlike) == 1 else np.unique(np.concatenate(unlike))
    squares = np.zeros(stamps.size)
    for stamps_ns, values in signals:
        if stamps_ns.size == stamps.size:  # as many as there are: the same ones
            squares += np.square(values)
        elif stamps_ns.size:
            origin = int(stamps[0])
            at, known = seconds_since(stamps, origin), seconds_since(stamps_ns, origin)
            squares += np.square(np.interp(at, known, values, left=0.0, right=0.0))
    return Signal(stamps, np.sqrt(squares))


class _SignalsOf:
    """The signals of a run's joints, each made when it is looked at."""

    def __init__(self, run: RunSeries, signal_of: Callable[[JointSeries], Signal]) -> None:
        self._run, self._signal_of = run, signal_of

    def __iter__(self) -> Iterator[Signal]:
        return map(self._signal_of, self._run.joints)


def norm_of_run(run: RunSeries, signal_of: Callable[[JointSeries], Signal]) -> Signal:
    """Return the norm over a run's joints; nothing where one of them has no signal."""
    signals = _SignalsOf(run, signal_of)
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

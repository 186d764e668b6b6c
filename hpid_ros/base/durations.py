"""Durations, noted in the hot path for the price of one append and summed up beside it."""

from __future__ import annotations

from array import array
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_MICROSECOND = 1e3  # [ns]
_DECADES = (2, 12)  # of the histogram: 100 ns to 1000 s, in powers of ten of [ns]
_BINS_PER_DECADE = 200  # neighbours differ by 1.2 %
_BINS = (_DECADES[1] - _DECADES[0]) * _BINS_PER_DECADE


class DurationSpread(NamedTuple):
    """How a set of durations is distributed."""

    samples: int  # how many there were
    median: float  # [us]
    p99: float  # [us] what 99 of 100 do not exceed
    maximum: float  # [us]

    def readings(self, what: str) -> dict[str, float]:
        """Return the figures by name, for ``/diagnostics``."""
        return {
            f"{what}, median [us]": self.median,
            f"{what}, 99th percentile [us]": self.p99,
            f"{what}, largest [us]": self.maximum,
        }


NO_DURATIONS = DurationSpread(0, 0.0, 0.0, 0.0)
"""Of no durations at all."""


_EDGES = np.ceil(10.0 ** (_DECADES[0] + np.arange(1, _BINS) / _BINS_PER_DECADE)).astype(np.int64)


class Durations:
    """Durations of one kind: medians and percentiles to within one percent."""

    def __init__(self) -> None:
        self._fresh = array("q")
        self._whole: NDArray[np.int64] = np.zeros(_BINS, dtype=np.int64)
        self._maximum = 0
        self.note = self._fresh.append

    def recent(self) -> DurationSpread:
        """Return the spread of what was noted since the last call, and add it to the whole.

        With few calls of numpy: a node does this between two samples.
        """
        # Another thread may append meanwhile: what is deleted is what was copied.
        fresh = self._fresh[:]
        values = np.array(fresh, dtype=np.int64)
        # Emptied in place: the hot path holds its append.
        del self._fresh[: len(fresh)]
        if not values.size:
            return NO_DURATIONS
        histogram = np.bincount(_EDGES.searchsorted(values, "right"), minlength=_BINS)
        self._whole += histogram
        maximum = int(values.max())
        self._maximum = max(self._maximum, maximum)
        return _spread(histogram, maximum)

    def whole(self) -> DurationSpread:
        """Return the spread of everything ever noted."""
        self.recent()
        return _spread(self._whole, self._maximum)


def _spread(histogram: NDArray[np.int64], maximum: int) -> DurationSpread:
    cumulated = histogram.cumsum()
    count = int(cumulated[-1])
    if not count:
        return NO_DURATIONS
    largest = maximum / _MICROSECOND
    ranks = cumulated.searchsorted((0.5 * count, 0.99 * count)).tolist()
    median, p99 = (
        min(10.0 ** (_DECADES[0] + (rank + 0.5) / _BINS_PER_DECADE) / _MICROSECOND, largest)
        for rank in ranks
    )
    return DurationSpread(count, median, p99, largest)

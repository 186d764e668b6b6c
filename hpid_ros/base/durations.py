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


NOTHING = DurationSpread(0, 0.0, 0.0, 0.0)
"""Of no durations at all."""


class Durations:
    """Durations of one kind."""

    def __init__(self) -> None:
        self._fresh = array("q")
        self._histogram: NDArray[np.int64] = np.zeros(_BINS, dtype=np.int64)
        self._maximum = 0
        self.note = self._fresh.append

    def recent(self) -> DurationSpread:
        """Return the spread of what was noted since the last call, and add it to the whole."""
        values = np.array(self._fresh, dtype=np.int64)
        # Emptied in place: the hot path holds its append.
        del self._fresh[:]
        if not values.size:
            return NOTHING
        self._maximum = max(self._maximum, int(values.max()))
        np.add.at(self._histogram, _bins(values), 1)
        median, p99 = np.percentile(values, (50.0, 99.0)) / _MICROSECOND
        return DurationSpread(values.size, float(median), float(p99), values.max() / _MICROSECOND)

    def whole(self) -> DurationSpread:
        """Return the spread of everything ever noted, median and p99 to within one percent."""
        self.recent()
        cumulated = np.cumsum(self._histogram)
        count = int(cumulated[-1])
        if not count:
            return NOTHING
        ranks = np.searchsorted(cumulated, [0.5 * count, 0.99 * count])
        median, p99 = 10.0 ** (_DECADES[0] + (ranks + 0.5) / _BINS_PER_DECADE) / _MICROSECOND
        largest = self._maximum / _MICROSECOND
        return DurationSpread(
            count, min(float(median), largest), min(float(p99), largest), largest
        )


def _bins(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the histogram's bin of each duration."""
    places = (np.log10(np.maximum(values, 1)) - _DECADES[0]) * _BINS_PER_DECADE
    return np.clip(places.astype(np.int64), 0, _BINS - 1)

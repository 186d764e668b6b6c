"""Samples put in the order of their stamps, each stamp once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hpid_ros.bags.batches import Integers, Numbers
from hpid_ros.bags.samples import JointSamples


class Ordered(NamedTuple):
    """Samples with strictly increasing stamps.

    Attributes:
        stamps_ns: Stamps, (n,), in [ns].
        values: Their numbers, (n,).
        repeated: Samples whose stamp was there; of several the last stands.
        out_of_order: Samples with an earlier stamp than the one before in the log.
        not_finite: Samples whose number was NaN or infinite.
    """

    stamps_ns: Integers
    values: Numbers
    repeated: int = 0
    out_of_order: int = 0
    not_finite: int = 0

    def within(self, first_ns: int, last_ns: int) -> Ordered:
        """Return the samples of a window, both ends included."""
        begin = int(np.searchsorted(self.stamps_ns, first_ns))
        end = int(np.searchsorted(self.stamps_ns, last_ns, "right"))
        if (begin, end) == (0, len(self.stamps_ns)):
            return self
        return self._replace(
            stamps_ns=self.stamps_ns[begin:end].copy(), values=self.values[begin:end].copy()
        )


def finite(samples: JointSamples) -> tuple[JointSamples, int]:
    """Return the samples whose numbers are finite, and how many were not."""
    is_finite = np.isfinite(samples.values)
    if is_finite.all():
        return samples, 0
    return samples.picked(is_finite), int(np.count_nonzero(~is_finite))


def ordered(stamps_ns: Integers, values: Numbers, not_finite: int) -> Ordered:
    """Put samples in the order of their stamps.

    Args:
        stamps_ns: Stamps in the order of the log, (n,), in [ns].
        values: Their numbers, (n,).
        not_finite: Kept in the result.
    """
    is_late = stamps_ns[1:] > stamps_ns[:-1]
    if is_late.all():
        return Ordered(stamps_ns, values, not_finite=not_finite)
    out_of_order = int(np.count_nonzero(stamps_ns[1:] < stamps_ns[:-1]))
    by_stamp = np.argsort(stamps_ns, kind="stable")
    stamps = stamps_ns[by_stamp]
    is_last = np.ones(len(stamps), dtype=np.bool_)
    is_last[:-1] = stamps[1:] != stamps[:-1]
    kept = by_stamp[is_last]
    return Ordered(
        stamps[is_last], values[kept], len(stamps_ns) - len(kept), out_of_order, not_finite
    )


def carried(
    log_times_ns: Integers, state_log_times_ns: Integers, state_stamps_ns: Integers
) -> Integers:
    """Carry receive times to the clock of the states' headers.

    Between two states linearly, before the first and after the last by their distance.

    Args:
        log_times_ns: What is to be carried, (m,), in [ns].
        state_log_times_ns: When the states were received, not falling, (n,), in [ns].
        state_stamps_ns: What their headers say, (n,), in [ns].
    """
    is_last = np.ones(len(state_log_times_ns), dtype=np.bool_)
    is_last[:-1] = state_log_times_ns[1:] > state_log_times_ns[:-1]
    received, stamps = state_log_times_ns[is_last], state_stamps_ns[is_last]
    since = (log_times_ns - received[0]).astype(float)
    inner = np.interp(
        since, (received - received[0]).astype(float), (stamps - stamps[0]).astype(float)
    )
    result: Integers = stamps[0] + np.rint(inner).astype(np.int64)
    result += np.minimum(log_times_ns - received[0], 0) + np.maximum(
        log_times_ns - received[-1], 0
    )
    return result

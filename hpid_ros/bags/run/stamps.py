"""Samples in the order of their stamps, and what their stamps say of those that are missing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hpid_ros.bags.columns.batches import Integers
from hpid_ros.bags.columns.samples import JointSamples
from hpid_ros.base.arrays import Numbers
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.recordings.quality import StampQuality


class Ordered(NamedTuple):
    """Samples with strictly increasing stamps."""

    stamps_ns: Integers  # [ns] stamps, (n,)
    values: Numbers  # their numbers, (n,)
    repeated: int = 0  # samples whose stamp was there; of several the last stands
    out_of_order: int = 0  # samples with an earlier stamp than the one before in the log
    not_finite: int = 0  # samples whose number was NaN, infinite or beyond 1e50

    def within(self, first_ns: int, last_ns: int) -> Ordered:
        """Return the samples of a window, both ends included."""
        begin = int(np.searchsorted(self.stamps_ns, first_ns))
        end = int(np.searchsorted(self.stamps_ns, last_ns, "right"))
        if (begin, end) == (0, len(self.stamps_ns)):
            return self
        return self._replace(
            stamps_ns=self.stamps_ns[begin:end].copy(), values=self.values[begin:end].copy()
        )


LARGEST = 1e50
"""Beyond this a number is no joint's, and its powers soon are no numbers, either."""


def finite(samples: JointSamples) -> tuple[JointSamples, int]:
    """Return the samples whose numbers can be a joint's, and how many cannot."""
    is_finite = np.abs(samples.values) < LARGEST  # false of NaN, too
    if is_finite.all():
        return samples, 0
    return samples.picked(is_finite), int(np.count_nonzero(~is_finite))


_RESET_NS = 1_000_000_000
"""By which a clock that was set back goes back at least; less is disorder on the way."""
RUN_SPACING_NS = 1_000_000_000_000_000
"""Added to the stamps of each run after another one: longer than any run."""


def separated(stamps_ns: Integers) -> Integers:
    """Return stamps in which a run that began anew follows the one before."""
    resets = np.diff(stamps_ns) <= -_RESET_NS
    if not resets.any():
        return stamps_ns
    runs = np.concatenate([[0], np.cumsum(resets)])
    later: Integers = stamps_ns + RUN_SPACING_NS * runs
    return later


def ordered(stamps_ns: Integers, values: Numbers, not_finite: int) -> Ordered:
    """Put samples in the order of their stamps."""
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


_LATE = 1.5
"""Periods between two stamps from which on a sample is taken to be missing."""


def stamp_quality(
    stamps_ns: Integers,
    origin_ns: int,
    *,
    repeated: int = 0,
    out_of_order: int = 0,
    not_finite: int = 0,
) -> StampQuality:
    """Return what the stamps of one joint's samples say."""
    counts = {"repeated": repeated, "out_of_order": out_of_order, "not_finite": not_finite}
    if not len(stamps_ns):
        return StampQuality(**counts)
    begin, end = ((int(stamps_ns[k]) - origin_ns) / NANOSECONDS for k in (0, -1))
    if len(stamps_ns) < 2:
        return StampQuality(count=1, begin=begin, end=end, **counts)
    steps = np.diff(stamps_ns)
    period = float(np.median(steps))
    late = np.flatnonzero(steps > _LATE * period)
    longest = int(late[np.argmax(steps[late])]) if len(late) else -1
    missing = int(np.sum(np.rint(steps[late] / period) - 1.0))
    # Samples that came late and then in a bunch are not missing.
    room = round(int(stamps_ns[-1] - stamps_ns[0]) / period) + 1 - len(stamps_ns)
    return StampQuality(
        count=len(stamps_ns),
        period=period / NANOSECONDS,
        begin=begin,
        end=end,
        gaps=len(late),
        lost=max(min(missing, room), 0),
        gap_time=float(np.sum(steps[late])) / NANOSECONDS,
        longest_gap=float(steps[longest]) / NANOSECONDS if len(late) else 0.0,
        longest_gap_at=((int(stamps_ns[longest]) - origin_ns) / NANOSECONDS if len(late) else 0.0),
        **counts,
    )

"""What stamps say about samples that are missing, repeated or out of order."""

from __future__ import annotations

import numpy as np

from hpid_ros.analysis.quality import StampQuality
from hpid_ros.bags.batches import Integers

_NS_PER_S = 1e9
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
    """Return what the stamps of one joint's samples say.

    Args:
        stamps_ns: Stamps, strictly increasing, (n,), in [ns].
        origin_ns: First state of any joint, in [ns].
        repeated: Samples that were dropped because their stamp was there.
        out_of_order: Samples that had to be moved.
        not_finite: Samples that were dropped because they were NaN or infinite.
    """
    counts = {"repeated": repeated, "out_of_order": out_of_order, "not_finite": not_finite}
    if not len(stamps_ns):
        return StampQuality(**counts)
    begin, end = ((int(stamps_ns[k]) - origin_ns) / _NS_PER_S for k in (0, -1))
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
        period=period / _NS_PER_S,
        begin=begin,
        end=end,
        gaps=len(late),
        lost=max(min(missing, room), 0),
        gap_time=float(np.sum(steps[late])) / _NS_PER_S,
        longest_gap=float(steps[longest]) / _NS_PER_S if len(late) else 0.0,
        longest_gap_at=((int(stamps_ns[longest]) - origin_ns) / _NS_PER_S if len(late) else 0.0),
        **counts,
    )

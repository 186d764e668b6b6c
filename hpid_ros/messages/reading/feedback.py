"""Where controllers say that a joint was, against where its states say that it was."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hpid_ros.messages.columns import Ordered
from hpid_ros.messages.reading.turns import CONTINUOUS, gaps, in_nearest_turn, unwrapped

_STATES_LATE = 4  # by so many states a controller's stamps may be off


class Away(NamedTuple):
    """How far the positions of a joint that a controller reports are from its states."""

    usual: float  # [rad] median
    largest: float  # [rad]
    range: float  # [rad] of the states

    def exceeds(self, least: float, share: float, most: float = math.inf) -> bool:
        """Return whether they are usually off by more than an angle and a share of the range."""
        return self.usual > min(max(least, share * self.range), most)


def feedback_away(feedback: Ordered, states: Ordered, *, turns: bool) -> Away | None:
    """Return how far a controller's feedback is from the states; None without common time.

    It is compared with all states about its stamp, as stamps may be those of a later cycle.
    """
    begin = int(np.searchsorted(feedback.stamps_ns, states.stamps_ns[0]))
    end = int(np.searchsorted(feedback.stamps_ns, states.stamps_ns[-1], "right"))
    if begin >= end:
        return None
    fed = Ordered(feedback.stamps_ns[begin:end], feedback.values[begin:end])
    stamps_ns, reported = fed[:2]
    following = np.searchsorted(states.stamps_ns, stamps_ns)
    lowest = highest = states.values[np.minimum(following, len(states.values) - 1)]
    for shift in range(-_STATES_LATE, _STATES_LATE):
        here = states.values[np.clip(following + shift, 0, len(states.values) - 1)]
        lowest, highest = np.minimum(lowest, here), np.maximum(highest, here)
    is_seen = np.concatenate(([True], ~gaps(states.stamps_ns)))[following]
    if not is_seen.any():
        return None
    if turns:
        whole, _ = unwrapped(fed, CONTINUOUS)
        reported = in_nearest_turn(whole.values, 0.5 * (lowest + highest), stamps_ns, is_seen)
    off = np.maximum(np.maximum(lowest - reported, reported - highest), 0.0)[is_seen]
    return Away(float(np.median(off)), float(off.max()), float(np.ptp(states.values)))

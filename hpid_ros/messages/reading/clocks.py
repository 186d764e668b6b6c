"""What is wrong with clocks: stamps of zero, clocks that were set back, and two that differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.columns import Integers, JointSamples, carried

RESET_NS = NANOSECONDS
"""By which a clock goes back at least whose recording began again; less is a clock set right."""
STRAYS = 30
"""States that come so much late; more are a clock of their own."""

_BEGIN_PERIODS = 10.0  # from stamp 0 to the next, at most, where simulated time begins
_SET_BACK_PERIODS, _SET_BACK_NS = 5.0, 10_000_000  # less is a message that came late
_DENSE = 0.7  # share of the messages that a sender has in the time that its clock repeats
_FEWEST = 3  # messages before and after by which a clock that was set back is known
_FOLLOWING = 9  # messages after a step back, most of which are behind
_DELAYS_NS = 2 * NANOSECONDS  # before and after, in which delays are compared
_LEAST_RISE, _MOST_RISE = 0.5, 1.5  # of the step back: by so much they rise for good
_NEAR_NS = NANOSECONDS  # so near to the states' topics of that clock are set back
_APART_PERIODS, _APART_NS = 3.0, 50_000_000  # clocks that differ by more differ
_ENOUGH = 20_000  # samples that tell a median
_EARLY = 0.02  # quantile of the delays: what comes in bunches is late, but not all of it


def unstamped(stamps_ns: Integers) -> NDArray[np.bool_] | None:
    """Return which stamps are zero among others; None if none is.

    Zero shortly before others is where simulated time begins. Where all are zero none is.
    """
    is_zero: NDArray[np.bool_] = stamps_ns == 0
    if not is_zero.any() or is_zero.all():
        return None
    stamped = np.flatnonzero(~is_zero)
    near = _BEGIN_PERIODS * _period(stamps_ns[stamped]) or NANOSECONDS
    zeros = np.flatnonzero(is_zero)
    following = np.searchsorted(stamped, zeros)
    next_ns = stamps_ns[stamped[np.minimum(following, len(stamped) - 1)]]
    is_begin = (following < len(stamped)) & (next_ns <= near)
    is_zero[zeros[is_begin]] = False
    return is_zero if is_zero.any() else None


def _period(stamps_ns: Integers) -> float:
    """Return the usual step of stamps, in [ns]; zero without any."""
    steps = np.diff(stamps_ns)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.0


class SetBack(NamedTuple):
    """A clock that was set back, as the states have it."""

    at: int  # index of the first state after it, in the order of the log
    log_time_ns: int  # [ns] when that was received
    by_ns: int  # [ns] by how much; what follows is shifted by as much


def set_backs(samples: JointSamples) -> list[SetBack]:
    """Return where the clock of a sender was set back by less than a second.

    Its stamps repeat a time then, in which there are as many before as after. Messages that come
    late fill a time that has none.
    """
    stamps_ns = samples.stamps_ns
    if (stamps_ns[1:] > stamps_ns[:-1]).all():
        return []
    steps, period = np.diff(stamps_ns), _period(stamps_ns)
    if not period:
        return []
    least = max(_SET_BACK_PERIODS * period, _SET_BACK_NS)
    at = np.flatnonzero((steps < -least) & (steps > -RESET_NS))
    # Messages that come late are alone, or few.
    following = at[:, None] + np.arange(1, 1 + _FOLLOWING)
    is_behind = stamps_ns[np.minimum(following, len(stamps_ns) - 1)] < stamps_ns[at][:, None]
    at = at[np.count_nonzero(is_behind, axis=1) > _FOLLOWING // 2]
    found: list[SetBack] = []
    done = 0
    for k in at.tolist() if len(at) <= STRAYS else ():
        size = int(-steps[k] / period)
        before = stamps_ns[max(k - 3 * size, 0) : k + 1]
        after = stamps_ns[k + 1 : k + 1 + 3 * size]
        first_ns, last_ns = int(after[0]), int(stamps_ns[k])
        is_beyond = after > last_ns
        is_beyond[:-1] &= is_beyond[1:]  # but for one that came late
        end = int(np.argmax(is_beyond)) if is_beyond.any() else len(after)
        counts = (
            (np.count_nonzero(before >= first_ns), last_ns - max(first_ns, int(before.min()))),
            (end, min(last_ns, int(after[:end].max())) - first_ns),
        )
        by_ns = last_ns - first_ns + round(period)
        if (
            k >= done
            and all(n >= max(_FEWEST, _DENSE * span / period) for n, span in counts)
            and _LEAST_RISE * by_ns <= _rise(samples, done, k + 1) <= _MOST_RISE * by_ns
        ):
            found.append(SetBack(k + 1, int(samples.log_times_ns[k + 1]), by_ns))
            done = k + 1 + end
    return found


def _rise(samples: JointSamples, begin: int, at: int) -> float:
    """Return by how much longer messages seem to be on their way from one on, in [ns]."""
    logged = samples.log_times_ns
    first = max(begin, int(logged.searchsorted(logged[at] - _DELAYS_NS)))
    end = int(logged.searchsorted(logged[at] + _DELAYS_NS))
    if not first < at < end:
        return 0.0
    delays = logged[first:end] - samples.stamps_ns[first:end]
    return float(np.median(delays[at - first :]) - np.median(delays[: at - first]))


def states_set_right(samples: JointSamples, found: Sequence[SetBack]) -> Integers:
    """Return the states' stamps as if their clock had gone on: a period between two."""
    if not found:
        return samples.stamps_ns
    stamps_ns: Integers = samples.stamps_ns.copy()
    for each in found:
        stamps_ns[each.at :] += each.by_ns
    return stamps_ns


def set_right(samples: JointSamples, found: Sequence[SetBack], states: JointSamples) -> Integers:
    """Return the stamps of another topic on the states' clock, as that would have gone on.

    Args:
        samples: Of the other topic, which may have a clock that was not set back.
        found: Where the clock of the states was.
        states: The states, with stamps set right.
    """
    stamps_ns: Integers = samples.stamps_ns.copy()
    logged = samples.log_times_ns
    steps, period = np.diff(samples.stamps_ns), _period(samples.stamps_ns)
    expected: Integers | None = None
    for each in found:
        near = logged.searchsorted((each.log_time_ns - _NEAR_NS, each.log_time_ns + _NEAR_NS))
        inner = steps[near[0] : max(near[1] - 1, near[0])]
        if len(inner) and inner.min() < period - each.by_ns / 2:
            stamps_ns[near[0] + int(inner.argmin()) + 1 :] += each.by_ns
            continue
        if expected is None:
            expected = carried(logged, states.log_times_ns, states.stamps_ns)
        after = int(logged.searchsorted(each.log_time_ns))
        off = expected - stamps_ns
        before_ns = float(np.median(off[:after])) if after else 0.0
        if after < len(off) and float(np.median(off[after:])) - before_ns > each.by_ns / 2:
            stamps_ns[after:] += each.by_ns
    return stamps_ns


def ahead_ns(samples: JointSamples, states: JointSamples) -> int:
    """Return by how much a topic's stamps are ahead of the states'; zero if that is no matter.

    Both are compared with the times at which they were received: what comes in bunches, with a
    delay that varies, or on a clock of another speed is not ahead.
    """
    if not len(samples.values) or len(states.values) < _FEWEST:
        return 0
    least = _least_apart(states)
    samples, states = _thinned(samples), _thinned(states)
    carried_ns = carried(samples.log_times_ns, states.log_times_ns, states.stamps_ns)
    found = [float(np.median(samples.stamps_ns - carried_ns))]
    if abs(found[0]) <= least:
        return 0
    first, end = states.log_times_ns.searchsorted(samples.log_times_ns[[0, -1]]).tolist()
    logged, stamps = states.log_times_ns[first : end + 1], states.stamps_ns[first : end + 1]
    if len(logged):
        origin_ns = int(logged[0])
        since, delays = (logged - origin_ns).astype(float), (logged - stamps).astype(float)
        own_since = (samples.log_times_ns - origin_ns).astype(float)
        own = (samples.log_times_ns - samples.stamps_ns).astype(float)
        if len(logged) > 1 and np.ptp(since) > 0.0:  # simulated time has a speed of its own
            slope = np.polyfit(since / np.ptp(since), delays - delays[0], 1)[0] / np.ptp(since)
            delays, own = delays - slope * since, own - slope * own_since
        for share in (_EARLY, 0.5):
            found.append(float(np.quantile(delays, share) - np.quantile(own, share)))
    if min(found) > least or max(found) < -least:
        return round(found[-1])
    return 0


def _thinned(samples: JointSamples) -> JointSamples:
    """Return so many samples as tell the median, and no more."""
    each = slice(None, None, 1 + len(samples.values) // _ENOUGH)
    stamps_ns, log_times_ns, places, values = samples
    return JointSamples(stamps_ns[each], log_times_ns[each], places[each], values[each])


def late_ns(times_ns: Sequence[tuple[int, int]], states: JointSamples) -> int:
    """Return by how much messages were stamped before they came; zero if that is no matter.

    Those that are stamped ahead are planned so.

    Args:
        times_ns: Stamp and log time of each.
        states: States of the joint.
    """
    stamps_ns, logged = np.array(times_ns, dtype=np.int64).T
    now_ns = carried(logged, states.log_times_ns, states.stamps_ns)
    late = float(np.median(now_ns - stamps_ns))
    return round(late) if late > _least_apart(states) else 0


def _least_apart(states: JointSamples) -> float:
    return max(_APART_PERIODS * _period(states.stamps_ns), _APART_NS)

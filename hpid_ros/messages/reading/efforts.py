"""Efforts of a joint on several topics: one sequence, where they follow each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.columns import Ordered
from hpid_ros.messages.series import stretches

_LATE = 1.5  # periods without an effort are a hole, in which another topic may go on
_GAP_PERIODS = 10.0  # so are these where both topics go on at once,
_SHORTEST_GAP = 0.5  # [s] and no less than this
_AT_A_CHANGE = 2  # samples that two controllers in turn may have at once, at each change
_SHARE_APART = 0.05  # of their range; efforts that differ by less say the same
_ROUNDING = 1e-9
_MOSTLY = 0.5  # a topic of which so much is beside another one is not in turn with it


class EffortCandidate(NamedTuple):
    """The efforts of one joint on one topic."""

    samples: Ordered
    clock: str  # whose time they have
    topics: tuple[str, ...]  # in the order of their first efforts


class EffortContradiction(NamedTuple):
    """Two topics with unlike efforts at one time."""

    taken: str  # topic whose efforts are taken at that time
    left: str  # topic of the others
    is_left_out: bool  # whether nothing of the other is taken
    largest: float  # [N m] how far they are apart


def in_turn(
    candidates: Sequence[EffortCandidate],
) -> tuple[EffortCandidate, list[EffortContradiction]]:
    """Return the one sequence that candidates make by time, the first before the others."""
    found, contradictions = candidates[0], []
    for other in candidates[1:]:
        takes, contradiction = _taken(found, other)
        if contradiction is not None:
            contradictions.append(contradiction)
        if takes.any():
            found = _merged(found, other, takes)
    return found, contradictions


def _taken(
    found: EffortCandidate, other: EffortCandidate
) -> tuple[NDArray[np.bool_], EffortContradiction | None]:
    """Return which efforts of another topic lie where there are none, and what contradicts."""
    is_free = _free(found.samples, other.samples, _LATE * _period(found.samples))
    turns = sum(1 for _ in stretches(is_free))
    beside = int(np.count_nonzero(~is_free))
    if beside <= _AT_A_CHANGE * turns:
        return is_free, None
    period = max(_period(found.samples), _period(other.samples))
    longest = max(_GAP_PERIODS * period, _SHORTEST_GAP * NANOSECONDS)
    largest = _apart(found.samples, other.samples, ~is_free)
    is_free = _free(found.samples, other.samples, longest)
    if largest is None:
        return is_free, None
    is_left_out = beside >= _MOSTLY * len(is_free) or not is_free.any()
    if is_left_out:
        is_free = np.zeros_like(is_free)
    names = " and ".join(found.topics), " and ".join(other.topics)
    return is_free, EffortContradiction(*names, is_left_out, largest)


def _period(samples: Ordered) -> float:
    steps = np.diff(samples.stamps_ns)
    return float(np.median(steps)) if len(steps) else 0.0


def _free(found: Ordered, other: Ordered, longest: float) -> NDArray[np.bool_]:
    """Return which samples of another topic lie before, after, or in a hole of the found ones."""
    stamps_ns = found.stamps_ns
    is_hole = np.concatenate(([True], np.diff(stamps_ns) > longest, [True]))
    following = np.searchsorted(stamps_ns, other.stamps_ns)
    is_same = stamps_ns[np.minimum(following, len(stamps_ns) - 1)] == other.stamps_ns
    free: NDArray[np.bool_] = is_hole[following] & ~is_same
    return free


def _apart(found: Ordered, other: Ordered, where: NDArray[np.bool_]) -> float | None:
    """Return how far two topics are apart at most; None if they say the same."""
    origin = found.stamps_ns[0]
    values = other.values[where]
    mine = np.interp(
        (other.stamps_ns[where] - origin).astype(float),
        (found.stamps_ns - origin).astype(float),
        found.values,
    )
    off = np.abs(values - mine)
    within = max(_ROUNDING, _SHARE_APART * max(float(np.ptp(values)), float(np.ptp(mine))))
    return float(off.max()) if np.median(off) > within else None


def _merged(
    found: EffortCandidate, other: EffortCandidate, takes: NDArray[np.bool_]
) -> EffortCandidate:
    one, two = found.samples, other.samples
    stamps_ns = np.concatenate((one.stamps_ns, two.stamps_ns[takes]))
    values = np.concatenate((one.values, two.values[takes]))
    order = np.argsort(stamps_ns)
    counts = (a + b for a, b in zip(one[2:], two[2:], strict=True))
    topics = (*found.topics, *other.topics)
    if two.stamps_ns[takes][0] < one.stamps_ns[0]:
        topics = (*other.topics, *found.topics)
    clock = found.clock if found.clock == other.clock else "receive"
    return EffortCandidate(Ordered(stamps_ns[order], values[order], *counts), clock, topics)

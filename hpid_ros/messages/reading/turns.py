"""Turns of joints whose drivers report one turn alone, as [-pi, pi) or [0, 2 pi)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.columns import Integers, Ordered

Flags = NDArray[np.bool_]

CONTINUOUS, PRISMATIC = "continuous", "prismatic"  # types of joints, as in a URDF
_LARGEST = math.tau * (1.0 + 1e-6)  # [rad] a driver that wraps reports none beyond it
# Where nobody says that a joint turns without end, what it moved besides the turn is little:
_LEFT, _LEAST_LEFT = math.pi / 2.0, 0.2  # [rad] at most, and at least what is allowed
_LEFT_STEPS = 8.0  # so many of its usual steps
_LARGEST_STEP = 0.4  # [rad] a usual step; with longer ones a turn cannot be told
_FEWEST = 8  # states by which the usual step is known
_GAP_PERIODS = 10.0  # states farther apart may be any number of turns apart
_SHORTEST_GAP = 0.5  # [s]


def unwrapped(samples: Ordered, kind: str | None) -> tuple[Ordered, int]:
    """Return positions without jumps by a turn, and how many there were.

    Args:
        samples: Positions in the order of their stamps, in [rad].
        kind: Type of the joint as its description has it; None where there is none.
    """
    x = samples.values
    if kind == PRISMATIC or len(x) < 2:
        return samples, 0
    steps = np.diff(x)
    if max(float(steps.max()), -float(steps.min())) <= math.pi:
        return samples, 0
    turns = np.round(steps / math.tau)
    is_turn = (turns != 0.0) & (np.maximum(np.abs(x[1:]), np.abs(x[:-1])) <= _LARGEST)
    if kind != CONTINUOUS:
        rest = np.abs(steps - math.tau * turns)
        usual = float(np.median(rest))
        if len(x) < _FEWEST or usual > _LARGEST_STEP:
            return samples, 0
        left = min(max(_LEAST_LEFT, _LEFT_STEPS * usual), _LEFT)
        is_turn &= (rest <= left) & ~gaps(samples.stamps_ns)
    turns[~is_turn] = 0.0
    count = int(np.count_nonzero(is_turn))
    if not count:
        return samples, 0
    values = x - math.tau * np.concatenate(([0.0], np.cumsum(turns)))
    return samples._replace(values=values), count


def in_nearest_turn(
    reference: Numbers, positions: Numbers, stamps_ns: Integers, known: Flags
) -> Numbers:
    """Return a reference in the turn that is nearest to the joint where each of its parts begins.

    A part begins where the reference becomes known, where it jumps by more than half a turn, and
    after missing states. Within one the error is what it is, however far the joint falls behind.
    """
    at = np.flatnonzero(known)
    if not len(at):
        return reference
    error, known_values = (reference - positions)[at], reference[at]
    is_first = np.ones(len(at), dtype=np.bool_)
    is_first[1:] = (np.diff(at) > 1) | (np.abs(np.diff(known_values)) > math.pi)
    is_first[1:] |= gaps(stamps_ns)[at[1:] - 1]
    first = np.maximum.accumulate(np.where(is_first, np.arange(len(at)), 0))
    turns = np.round(error[first] / math.tau)
    if not turns.any():
        return reference
    nearest: Numbers = reference - math.tau * turns[_nearest(at, stamps_ns)]
    return nearest


def _nearest(at: Integers, stamps_ns: Integers) -> Integers:
    """Return which of some ascending places is the nearest in time to each stamp."""
    every = np.arange(len(stamps_ns))
    following = np.minimum(np.searchsorted(at, every), len(at) - 1)
    before = np.maximum(np.searchsorted(at, every, "right") - 1, 0)
    is_nearer = stamps_ns[at[following]] - stamps_ns < stamps_ns - stamps_ns[at[before]]
    found: Integers = np.where(is_nearer, following, before)
    return found


def gaps(stamps_ns: Integers) -> Flags:
    """Return after which stamps so many are missing that the joint may have turned."""
    steps = np.diff(stamps_ns)
    if not len(steps):
        return np.zeros(0, dtype=np.bool_)
    longest = max(_GAP_PERIODS * float(np.median(steps)), _SHORTEST_GAP * NANOSECONDS)
    return np.asarray(steps > longest)

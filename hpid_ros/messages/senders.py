"""Several senders of one joint on one topic: recognised, counted, and told apart.

A joint has one driver. Where a second node publishes it (``joint_state_publisher`` next to a
driver, two drivers), a recording has two sequences that take turns. They are told apart by what
their messages look like (names and their order, fields, ``frame_id``), by their clocks, and by
their periods. Sequences that say the same, or that follow each other, are one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import NANOSECONDS, Numbers

_Integers = NDArray[np.int64]

FEWEST = 3  # messages of a sender; fewer are strays
_SWITCHES = 4  # there, back, there again and back again
_CLOCKS_APART_NS = NANOSECONDS  # two clocks differ by more
_OFF = 3.0  # times what a sender strays from the line between its own neighbours
_LEAST_OFF = 1e-4  # [rad], [N m] and by more than this
_AGREE = 0.02  # [rad] positions as near are of one sender, as for controllers
_RETURNED = 0.25  # of the step to the message between
_EARLY = 0.45  # periods by which a message of a sender may come too early or too late
_SHORT = 0.6  # of the usual period: such intervals are between two senders
_SHARE = 0.02  # of the intervals; fewer are late messages
_REGULAR = 0.8  # of the steps of one sender are as long as its period, within a fifth
_WITHIN = 0.2
_EXACT = 0.15  # so near are most steps of a sender to its period; of what comes by chance fewer
_MOST = 0.7  # share of the steps, of few a larger one
_EXPLAINED = 0.9  # share of the messages that are of the first two sequences of as many senders
_MADE_UP = 0.9  # share of the other messages that come for one that is missing: they are late ones
_PROBED = 1500  # messages from which periods are guessed
_LAGS = 4  # at most so many senders share a layout
_JOINTS = 4  # whose values are compared while sequences are followed


class Part(NamedTuple):
    """Messages of one layout, or of one sender among them, in the order of the log."""

    text: str  # what they look like, in words
    stamps_ns: _Integers  # (n,)
    log_times_ns: _Integers  # (n,)
    places: _Integers  # (n,)
    values: Mapping[str, Numbers]  # positions by joint, (n,)
    efforts: Mapping[str, Numbers]  # by joint, (n,); only where they are read and sent

    def picked(self, which: _Integers) -> Part:
        times = self.stamps_ns[which], self.log_times_ns[which]
        values, efforts = (
            {name: x[which] for name, x in each.items()} for each in (self.values, self.efforts)
        )
        return Part(self.text, *times, self.places[which], values, efforts)

    @property
    def times_ns(self) -> _Integers:
        """Stamps; receive times where there are none, or where their clock was set back."""
        is_set_back = (np.diff(self.stamps_ns) <= -_CLOCKS_APART_NS).any()
        return self.log_times_ns if is_set_back or not self.stamps_ns.any() else self.stamps_ns

    @property
    def span(self) -> float:
        """Time from the first to the last message, in [s]."""
        return float(np.ptp(self.log_times_ns)) / NANOSECONDS

    @property
    def rate(self) -> float:
        """Messages a second, in [Hz]."""
        steps = np.diff(np.sort(self.log_times_ns))
        period = float(np.median(steps)) if len(steps) else 0.0
        return NANOSECONDS / period if period else 0.0

    @property
    def is_moving(self) -> bool:
        numbers = (*self.values.values(), *self.efforts.values())
        return any(float(np.ptp(each)) > _LEAST_OFF for each in numbers)


@dataclass(frozen=True)
class Senders:
    """Who sends the same joints: the first is the one that moves, goes on longest, sends most."""

    each: tuple[Part, ...]
    taken: int  # which of them counts, from 1 on
    left: tuple[int, ...]  # which of them are left out; the others contradict none that counts
    is_wanted: bool  # whether that is the one that was asked for
    left_out: _Integers  # places of the messages of the others

    def texts(self) -> list[str]:
        return [
            f"sender {number}: {len(part.places)} messages, {part.rate:.3g} Hz ({part.text})"
            for number, part in enumerate(self.each, 1)
        ]


def find_senders(parts: Sequence[Part], wanted: str | None = None) -> Senders | None:
    """Return the senders of the same joints; None where there is one, or none contradicts another.

    Args:
        parts: The messages by layout.
        wanted: Which to take, see :func:`matches`; the first if None, or where it matches none.
    """
    found = [each for part in parts for each in _by_clock(part)]
    found = [each for part in found for each in _by_period(part)]
    found = [each for each in found if len(each.places) >= FEWEST]
    if len(found) < 2:
        return None
    longest = max(each.span for each in found)

    def worth(part: Part) -> tuple[bool, bool, int]:
        return part.is_moving, part.span >= 0.9 * longest, len(part.places)

    found.sort(key=worth, reverse=True)
    clashes = {
        (a, b)
        for a in range(len(found))
        for b in range(a)
        if _take_turns(found[a], found[b]) and _contradict(found[b], found[a])
    }
    if not clashes:
        return None
    in_doubt = sorted({each for pair in clashes for each in pair})
    named = [
        k for n, k in enumerate(in_doubt, 1) if wanted is not None and matches(found[k], n, wanted)
    ]
    order = sorted(range(len(found)), key=lambda k: (k not in named[:1], k not in in_doubt, k))
    kept: list[int] = []
    for k in order:
        if not any((max(k, j), min(k, j)) in clashes for j in kept):
            kept.append(k)
    left = [found[k].places for k in order if k not in kept]
    return Senders(
        tuple(found[k] for k in in_doubt),
        1 + in_doubt.index(order[0]),
        tuple(n for n, k in enumerate(in_doubt, 1) if k not in kept),
        bool(named),
        np.sort(np.concatenate(left)),
    )


def matches(part: Part, number: int, wanted: str) -> bool:
    """Return whether a sender is meant by its number, its rate (``50Hz``) or its layout."""
    text = wanted.strip()
    if text.isdecimal():
        return int(text) == number
    if text.lower().endswith("hz"):
        try:
            return abs(float(text[:-2]) - part.rate) <= 0.1 * part.rate
        except ValueError:
            return False
    return text.replace(" ", "") in part.text.replace(" ", "")


def _by_clock(part: Part) -> list[Part]:
    """Separate senders with clocks of their own."""
    if not part.stamps_ns.any() or len(part.places) < 2 * FEWEST:
        return [part]
    if not has_several_clocks(part.stamps_ns, part.log_times_ns):
        return [part]
    offsets = part.log_times_ns - part.stamps_ns
    ascending = np.sort(offsets)
    steps = np.diff(ascending)
    at = int(np.argmax(steps))
    if steps[at] < _CLOCKS_APART_NS:
        return [part]
    is_late = offsets > ascending[at]
    if np.count_nonzero(np.diff(is_late)) < _SWITCHES:
        return [part]  # a clock that was set
    return [
        *_by_clock(part.picked(np.flatnonzero(~is_late))),
        part.picked(np.flatnonzero(is_late)),
    ]


def contradict_at_one_instant(stamps_ns: _Integers, numbers: Numbers) -> bool:
    """Return whether stamps come with two numbers, again and again."""
    if len(stamps_ns) < 2 * FEWEST or (stamps_ns[1:] > stamps_ns[:-1]).all():
        return False
    order = np.argsort(stamps_ns, kind="stable")
    stamps, x = stamps_ns[order], numbers[order]
    begins = np.flatnonzero(np.concatenate(([True], stamps[1:] != stamps[:-1])))
    if len(stamps) - len(begins) < FEWEST or len(begins) < 2:
        return False
    first, last = x[begins], x[np.concatenate((begins[1:], [len(x)])) - 1]
    # From one stamp to the next a sender goes the shortest of the ways.
    ways = [np.abs(b[1:] - a[:-1]) for a in (first, last) for b in (first, last)]
    usual = float(np.median(np.min(ways, axis=0)))
    unlike = np.count_nonzero(np.abs(last - first) > max(_LEAST_OFF, _OFF * usual))
    return bool(unlike >= max(FEWEST, _SHARE * len(begins)))


def has_several_clocks(stamps_ns: _Integers, log_times_ns: _Integers) -> bool:
    """Return whether stamps are farther from the receive times now and then."""
    offsets = log_times_ns - stamps_ns
    return bool(stamps_ns.any() and np.ptp(offsets) >= _CLOCKS_APART_NS)


def may_be_several(times_ns: _Integers) -> bool:
    """Return whether messages of one layout come too irregularly for one sender."""
    if len(times_ns) < 2 * FEWEST:
        return False
    steps = np.diff(times_ns)
    if (steps < 0).any():
        steps = np.diff(np.sort(times_ns))
    if (steps == 0).any():
        return True
    period = float(np.median(steps))
    if np.count_nonzero(steps < _SHORT * period) > max(FEWEST, _SHARE * len(steps)):
        return True
    some = np.cumsum(steps[:_PROBED].astype(float))
    spreads = []
    for lag in range(1, _LAGS + 1):
        apart = some[lag:] - some[:-lag]
        low, middle, high = (
            np.quantile(apart, (0.25, 0.5, 0.75)) if len(apart) else (0.0, 1.0, 0.0)
        )
        spreads.append((high - low) / middle)
    # Of one sender what is late once is made up for: the spread falls with the lag, and no faster.
    return spreads[0] > 0.05 and min(spreads[1:]) < spreads[0] / 8.0


def returns(positions: Numbers) -> int:
    """Return after how many messages positions come back to where they were; 0 if they do not.

    Positions of one sender are farther away the later they are, and those of a noisy encoder are
    equally far.
    """
    if len(positions) < 4 * _LAGS:
        return 0
    steps = [
        float(np.median(np.abs(positions[lag:] - positions[:-lag]))) for lag in range(1, _LAGS + 1)
    ]
    if steps[0] < _AGREE:
        return 0
    return next((k for k, x in enumerate(steps[1:], 2) if x < _RETURNED * steps[0]), 0)


def stands_every_other(efforts: Numbers) -> bool:
    """Return whether every other effort is one number, and those between are not."""
    if len(efforts) < 4 * _LAGS:
        return False
    spans = [float(np.ptp(efforts[first::2])) for first in (0, 1)]
    return min(spans) == 0.0 and max(spans) > _LEAST_OFF


def _by_period(part: Part) -> list[Part]:
    """Separate senders of one layout by their periods, and by what they send at one instant."""
    order = np.argsort(part.times_ns, kind="stable")
    fewest = max((returns(each[order]) for each in part.values.values()), default=0)
    if not fewest and any(stands_every_other(each[order]) for each in part.efforts.values()):
        fewest = 2
    if not fewest and not may_be_several(part.times_ns):
        return [part]
    times = (part.times_ns[order] - part.times_ns[order[0]]).astype(float)
    values = _scaled(part, order)
    free = np.ones(len(order), dtype=np.bool_)
    found: list[_Integers] = []
    for _ in range(_LAGS):
        period = _period(times[free], values[free], 1 if found else max(fewest, 1))
        if period is None:
            break
        chain = np.flatnonzero(free)[_chain(times[free], values[free], period)]
        free[chain] = False
        found.append(np.sort(order[chain]))
        if np.count_nonzero(free) < FEWEST:
            break
    if not fewest and not _tells_several(part, order, times, found):
        return [part]
    if free.any() and found:
        rest = np.sort(order[free])
        if len(rest) >= FEWEST or len(found) < 2:
            found.append(rest)
    return [part.picked(each) for each in found] if len(found) > 1 else [part]


def _tells_several(
    part: Part, order: _Integers, times: Numbers, found: Sequence[_Integers]
) -> bool:
    """Return whether the first of some sequences is a sender's by its times, and not the only one.

    What comes by hand or by chance keeps no period. What one sender sends late comes where a
    message of its own is missing; that of another one comes besides.
    """
    if not found or has_equal(part.times_ns):
        return True
    is_first = np.isin(order, found[0])
    first, others = times[is_first], times[~is_first]
    steps = np.diff(first)
    if not len(steps) or not len(others):
        return bool(len(steps))
    period = float(np.median(steps))
    exact = np.mean(np.abs(steps - period) < _EXACT * period)
    is_regular = exact >= min(_MOST + 1.0 / math.sqrt(len(steps)), 1.0)
    if not is_regular and sum(map(len, found[:2])) < _EXPLAINED * len(times):
        return False
    missing = np.maximum(np.rint(steps / period).astype(np.int64) - 1, 0)
    after = np.clip(np.searchsorted(first, others) - 1, 0, len(missing) - 1)
    came = np.bincount(after, minlength=len(missing))
    before = np.concatenate(([0], np.maximum(missing - came, 0)[:-1]))
    return bool(np.minimum(came, missing + before).sum() < _MADE_UP * len(others))


def has_equal(times_ns: _Integers) -> bool:
    """Return whether two messages have one time."""
    return bool((np.diff(np.sort(times_ns)) == 0).any())


def _scaled(part: Part, order: _Integers) -> Numbers:
    """Return positions, and efforts, in units of how far they jump, (n, some)."""
    columns = []
    for numbers in (part.values, part.efforts):
        jumps = {k: float(np.quantile(np.abs(np.diff(x[order])), 0.9)) for k, x in numbers.items()}
        for name in sorted(jumps, key=lambda name: -jumps[name])[:_JOINTS]:
            if jumps[name] > 0.0:
                columns.append(numbers[name][order] / jumps[name])
    return np.stack(columns, axis=1) if columns else np.zeros((len(order), 1))


def _period(times: Numbers, values: Numbers, fewest: int) -> float | None:
    """Return the shortest period that one of so many senders keeps among the first messages."""
    times, values = times[:_PROBED], values[:_PROBED]
    if len(times) < FEWEST:
        return None
    guesses: list[float] = []
    for lag in range(fewest, min(_LAGS + 1, len(times))):
        apart = times[lag:] - times[:-lag]
        guesses += (
            np.quantile(apart[apart > 0.0], (0.25, 0.5, 0.75)).tolist() if apart.any() else []
        )
    for period in sorted(guesses):
        chain = _chain(times, values, period)
        steps = np.diff(times[chain]) / period
        is_whole = np.abs(steps - 1.0) < _WITHIN
        span = (times[-1] - times[0]) / period
        if len(steps) >= FEWEST - 1 and np.mean(is_whole) >= _REGULAR and len(steps) > 0.5 * span:
            return float(np.median(np.diff(times[chain])))
    return None


def _chain(times: Numbers, values: Numbers, period: float) -> _Integers:
    """Return the messages that follow each other by a period, the likeliest where several may."""
    chain, k = [0], 0
    while True:
        due = times[k] + period
        first = int(np.searchsorted(times, due - _EARLY * period, "right"))
        first = max(first, k + 1)
        if first >= len(times):
            break
        # Where some are lost, the next one is among those of a period.
        due = max(due, times[first])
        end = max(int(np.searchsorted(times, due + _EARLY * period, "right")), first + 1)
        late = np.abs(times[first:end] - due) / period
        off = np.abs(values[first:end] - values[k]).mean(axis=1)
        k = first + int(np.argmin(2.0 * late + np.minimum(off, 2.0)))
        chain.append(k)
    return np.array(chain, dtype=np.int64)


def _take_turns(one: Part, other: Part) -> bool:
    """Return whether two sequences come to and fro, and not one after the other."""
    places = np.concatenate((one.places, other.places))
    is_other = np.repeat([False, True], [len(one.places), len(other.places)])
    return int(np.count_nonzero(np.diff(is_other[np.argsort(places)]))) >= _SWITCHES


def _contradict(one: Part, other: Part) -> bool:
    """Return whether a sequence lies off the line between another's numbers."""
    if len(other.places) > len(one.places):
        one, other = other, one
    fields = ((one.values, other.values, math.tau), (one.efforts, other.efforts, 0.0))
    on_stamps = one.stamps_ns.any() and other.stamps_ns.any()
    on_stamps = on_stamps and one.stamps_ns.min() <= other.stamps_ns.max()
    on_stamps = on_stamps and other.stamps_ns.min() <= one.stamps_ns.max()
    at, of_other = (x.stamps_ns if on_stamps else x.log_times_ns for x in (one, other))
    order = np.argsort(at, kind="stable")
    at = at[order]
    inner = (of_other >= at[0]) & (of_other <= at[-1])
    if np.count_nonzero(inner) < FEWEST:
        return False
    t = (at - at[0]).astype(float)
    t_other = (of_other[inner] - at[0]).astype(float)
    for numbers, others, turn in fields:
        for name in numbers.keys() & others.keys():
            x = numbers[name][order]
            x = np.unwrap(x) if turn else x
            off = _less_turns(others[name][inner] - np.interp(t_other, t, x), turn)
            own = _less_turns(x[1:-1] - 0.5 * (x[:-2] + x[2:]), turn) if len(x) > 2 else off * 0.0
            usual = float(np.quantile(np.abs(own), 0.75)) if own.size else 0.0
            if np.quantile(np.abs(off), 0.75) > max(_LEAST_OFF, _OFF * usual):
                return True
    return False


def _less_turns(x: Numbers, turn: float) -> Numbers:
    """Return differences without whole turns."""
    less: Numbers = x - turn * np.round(x / turn) if turn else x
    return less

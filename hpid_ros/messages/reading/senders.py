"""Several senders of one joint on one topic: recognised, counted, and told apart.

A joint has one driver. Where a second node publishes it (``joint_state_publisher`` next to a
driver, two drivers), a recording has two sequences that take turns. They are told apart by what
their messages look like (names and their order, fields, ``frame_id``), by their clocks, and by
their periods. Sequences that say the same, or that follow each other, are one, and so are layouts
that make one regular sequence of one motion. Efforts that alternate prove nothing: controllers
chatter.
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
_LOOKED, _LOOKS = 3000, 5  # messages at a time, and how often, to tell one sequence
_UNEVEN, _EVEN = 0.15, 0.06  # shares of those that may be off, and of a step by which others are
_SOON = 2  # steps of a sender within which what is late comes
_PROBED = 1500  # messages from which periods are guessed
_LAGS = 4  # at most so many senders share a layout
_ACCELERATION = 3000.0  # [rad/s^2], [m/s^2] beyond it no joint swings from state to state
_STANDS = 0.4  # of the messages, at least, are those of one of two senders that stands still
_MOVES = 0.9  # and at most
_NEAR = 3.0  # usual steps between the neighbours of what is compared with the line between them
_COARSE = 0.6  # stamps a message; fewer are coarse, where receive times are one sequence
_OR = " or "  # between the layouts of a sender
_OVERLAP = 0.05  # of the messages; what shares less of its time comes one after the other
_SMALLEST = 1e-9  # [rad], [N m] smaller steps are rounding
_TEXTS = 3  # layouts of a sender that are named
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
        """Stamps; receive times where there are none, or coarse ones, or a clock was set back."""
        return self.stamps_ns if self.is_on_stamps else self.log_times_ns

    @property
    def is_on_stamps(self) -> bool:
        if (np.diff(self.stamps_ns) <= -_CLOCKS_APART_NS).any() or not self.stamps_ns.any():
            return False
        return not coarse_ns(self.stamps_ns, self.log_times_ns)

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
    found = [each for part in _united(parts) for each in _by_clock(part)]
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
    """Return whether every other effort is one number, and those between are not.

    So does one sender that chatters against a limit, or that measures every other cycle.
    """
    if len(efforts) < 4 * _LAGS:
        return False
    spans = [float(np.ptp(efforts[first::2])) for first in (0, 1)]
    return min(spans) == 0.0 and max(spans) > _LEAST_OFF


def coarse_ns(stamps_ns: _Integers, log_times_ns: _Integers) -> int:
    """Return the step of stamps that several messages of one sender share; 0 of others, in [ns].

    What several senders send at one instant comes at once, or nearly so.
    """
    if len(stamps_ns) < 2 * FEWEST or (stamps_ns[1:] > stamps_ns[:-1]).all():
        return 0
    stamps, counts = np.unique(stamps_ns, return_counts=True)
    if len(stamps) < 2 or len(stamps) > _COARSE * len(stamps_ns):
        return 0
    if np.median(counts) <= _LAGS and may_be_several(log_times_ns):
        return 0
    return int(np.median(np.diff(stamps)))


def _united(parts: Sequence[Part]) -> list[Part]:
    """Unite layouts that make one regular sequence of one motion."""
    if len(parts) < 2:
        return list(parts)
    is_one = _is_one_sequence(_joined(parts))
    found: list[Part] = []
    for part in sorted(parts, key=lambda each: -len(each.places)):
        for n, each in enumerate(found):
            if _contradict(each, part, by_efforts=False):
                continue
            both = _joined((each, part))
            if is_one or _is_one_sequence(both):
                found[n] = both
                break
        else:
            found.append(part)
    return found


def _joined(parts: Sequence[Part]) -> Part:
    """Return the messages of some layouts as those of one."""
    places = np.concatenate([each.places for each in parts])
    order = np.argsort(places, kind="stable")

    def columns(of: Sequence[Mapping[str, Numbers]]) -> dict[str, Numbers]:
        names = [name for name in of[0] if all(name in each for each in of)]
        return {name: np.concatenate([each[name] for each in of])[order] for name in names}

    texts = list(dict.fromkeys(text for each in parts for text in each.text.split(_OR)))
    return Part(
        _OR.join(texts[:_TEXTS]),
        np.concatenate([each.stamps_ns for each in parts])[order],
        np.concatenate([each.log_times_ns for each in parts])[order],
        places[order],
        columns([each.values for each in parts]),
        columns([each.efforts for each in parts]),
    )


def _is_one_sequence(part: Part) -> bool:
    """Return whether messages can be of one sender, by the times of some of them."""
    count = len(part.places)
    firsts = np.linspace(0, max(count - _LOOKED, 0), min(_LOOKS, 1 + count // _LOOKED))
    looks = (
        _without_repeats(part.picked(np.arange(first, min(first + _LOOKED, count))))
        for first in firsts.astype(np.int64).tolist()
    )
    return len(_by_clock(part)) == 1 and all(
        len(_by_period(each, by_positions=False)) == 1 for each in looks
    )


def _without_repeats(part: Part) -> Part:
    """Return the messages without those that say again what was said at their time."""
    times_ns = part.times_ns
    order = np.argsort(times_ns, kind="stable")
    is_again = times_ns[order[1:]] == times_ns[order[:-1]]
    if not is_again.any():
        return part
    for x in (*part.values.values(), *part.efforts.values()):
        is_again &= np.abs(x[order[1:]] - x[order[:-1]]) <= _LEAST_OFF
    return part.picked(np.sort(order[np.concatenate(([True], ~is_again))]))


def _senders_by_positions(x: Numbers, times_ns: _Integers) -> int:
    """Return how many senders come in turn, by positions that are no motion; 0 if they may be one.

    A joint can swing at half the rate of its states, but neither at any acceleration, nor so that
    every other position is the very same number.
    """
    lag = returns(x)
    if not lag:
        return 0
    period = float(np.median(np.diff(times_ns))) / NANOSECONDS
    swing = float(np.median(np.abs(x[2:] - 2.0 * x[1:-1] + x[:-2])))
    if swing > _ACCELERATION * period**2:
        return lag
    still = x[lag:][x[lag:] == x[:-lag]]
    does_stand = _STANDS * 2.0 / lag * len(x) <= len(still) <= _MOVES * len(x)
    return lag if does_stand and np.ptp(still) == 0.0 else 0


def _by_period(part: Part, by_positions: bool = True) -> list[Part]:
    """Separate senders of one layout by their periods, and by what they send at one instant."""
    times_ns = part.times_ns
    order = np.argsort(times_ns, kind="stable")
    fewest = 0
    if by_positions:
        counts = (_senders_by_positions(x[order], times_ns[order]) for x in part.values.values())
        fewest = max(counts, default=0)
    is_even = not may_be_several(times_ns)
    if not fewest and is_even:
        return [part]
    times = (times_ns[order] - times_ns[order[0]]).astype(float)
    values = _scaled(part, order)
    free = np.ones(len(order), dtype=np.bool_)
    found: list[_Integers] = []
    for _ in range(_LAGS):
        shortest = max(fewest, 1) if is_even and not found else 1
        period = _period(times[free], values[free], shortest)
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
    if _fill_in(first, others):
        return False
    # Where many are lost, others seem to make up for them.
    if _contradict(part.picked(order[is_first]), part.picked(order[~is_first]), by_efforts=False):
        return True
    missing = np.maximum(np.rint(steps / period).astype(np.int64) - 1, 0)
    after = np.clip(np.searchsorted(first, others) - 1, 0, len(missing) - 1)
    came = np.bincount(after, minlength=len(missing))
    soon = np.convolve(came, np.ones(_SOON, dtype=np.int64))[_SOON - 1 :]
    balance = np.cumsum(np.minimum(missing, soon) - came)
    besides = -min(int(balance.min()), 0)  # those before which none was missing
    return besides > (1.0 - _MADE_UP) * len(others)


def _fill_in(times: Numbers, others: Numbers) -> bool:
    """Return whether others divide the steps between some times into equal ones."""
    steps = np.diff(times)
    after = np.searchsorted(times, others, "right") - 1
    is_inner = (after >= 0) & (after < len(steps))
    after, others = after[is_inner], others[is_inner]
    share = len(others) / len(steps)
    parts = 1 + round(share)
    if parts < 2 or abs(share - parts + 1) > _UNEVEN * (parts - 1):
        return False
    places = parts * (others - times[after]) / steps[after]
    off = places - np.rint(places)
    is_between = (np.rint(places) > 0.0) & (np.rint(places) < parts)
    is_even = abs(float(np.median(off))) < _EVEN and float(np.median(np.abs(off))) < _WITHIN
    return bool(is_even and np.mean(is_between) > _MOST)


def has_equal(times_ns: _Integers) -> bool:
    """Return whether two messages have one time."""
    return bool((np.diff(np.sort(times_ns)) == 0).any())


def _scaled(part: Part, order: _Integers) -> Numbers:
    """Return positions in units of how far they jump, efforts where none moves, (n, some)."""
    columns: list[Numbers] = []
    for numbers in (part.values, part.efforts):
        if columns:
            break  # efforts may alternate
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


def _contradict(one: Part, other: Part, by_efforts: bool = True) -> bool:
    """Return whether a sequence lies off the line between another's neighbouring numbers."""
    if len(other.places) > len(one.places):
        one, other = other, one
    fields = [(one.values, other.values, math.tau)]
    if by_efforts:
        fields.append((one.efforts, other.efforts, 0.0))
    on_stamps = one.is_on_stamps and other.is_on_stamps
    on_stamps = on_stamps and bool(one.stamps_ns.min() <= other.stamps_ns.max())
    on_stamps = on_stamps and bool(other.stamps_ns.min() <= one.stamps_ns.max())
    at, of_other = (x.stamps_ns if on_stamps else x.log_times_ns for x in (one, other))
    order = np.argsort(at, kind="stable")
    at = at[order]
    inner = _beside(at, of_other)
    if np.count_nonzero(inner) < max(FEWEST, _OVERLAP * len(inner)):
        return False
    t = (at - at[0]).astype(float)
    t_other = (of_other[inner] - at[0]).astype(float)
    for numbers, others, turn in fields:
        for name in numbers.keys() & others.keys():
            x = numbers[name][order]
            x = np.unwrap(x) if turn else x
            off = _less_turns(others[name][inner] - np.interp(t_other, t, x), turn)
            own = np.abs(_less_turns(_off_neighbours(t, x), turn))
            usual = float(np.quantile(own, 0.75)) if own.size else 0.0
            apart = float(np.quantile(np.abs(off), 0.75)) if len(off) else 0.0
            if apart <= max(_LEAST_OFF, _OFF * usual):
                continue
            if apart > min(map(_resolution, (x, others[name]))):
                return True
    return False


def _resolution(x: Numbers) -> float:
    """Return how far numbers are apart that are next to each other; 0 where all are one."""
    steps = np.diff(np.unique(x))
    steps = steps[steps > _SMALLEST]
    return float(steps.min()) if len(steps) else 0.0


def _beside(at: _Integers, of_other: _Integers) -> NDArray[np.bool_]:
    """Return which times have neighbours on both sides that follow each other closely."""
    inner: NDArray[np.bool_] = (of_other >= at[0]) & (of_other <= at[-1])
    after = np.clip(np.searchsorted(at, of_other), 1, max(len(at) - 1, 1))
    if len(at) < 2:
        return inner
    steps = np.diff(at)
    usual = float(np.median(steps))
    if not usual:
        return inner
    inner &= (
        (steps[after - 1] <= _NEAR * usual) | (at[after] == of_other) | (at[after - 1] == of_other)
    )
    return inner


def _off_neighbours(t: Numbers, x: Numbers) -> Numbers:
    """Return how far numbers are from the line between the one before and the one after."""
    if len(x) < 3:
        return np.zeros(0)
    whole = t[2:] - t[:-2]
    share = np.divide(t[1:-1] - t[:-2], whole, out=np.full(len(whole), 0.5), where=whole > 0.0)
    off: Numbers = x[1:-1] - (x[:-2] + share * (x[2:] - x[:-2]))
    if len(whole) and (usual := float(np.median(np.diff(t)))):
        off = off[whole <= _NEAR * usual]
    return off


def _less_turns(x: Numbers, turn: float) -> Numbers:
    """Return differences without whole turns."""
    less: Numbers = x - turn * np.round(x / turn) if turn else x
    return less

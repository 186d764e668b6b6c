"""What a joint was to follow: references that were asked for, and those that controllers report.

A candidate is one topic's reference at a joint's states, and at which states it says anything.
Candidates are compared by what the joint did: where two say different things, the one that the
joint followed counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.messages.columns import Integers, JointSamples, Ordered
from hpid_ros.messages.quality_lines import SHARE_OF_RANGE, SMALL_ERROR
from hpid_ros.messages.series import stretches
from hpid_ros.motion.joint_trajectory import (
    Column,
    Knot,
    ReferenceSample,
    SplineReference,
    approach,
    segment,
)

Flags = NDArray[np.bool_]


class ReferenceEvent(NamedTuple):
    """A trajectory or setpoint of one joint, and its place in the log."""

    log_time_ns: int  # [ns] when it was recorded
    place: int  # its place in the files
    column: Column  # what the joint follows


class _Span(NamedTuple):
    """A reference, its knots, and the index of the first state that it holds for."""

    begin: int
    reference: SplineReference
    times_ns: list[int]
    knots: list[Knot]


def setpoint_events(joint: str, setpoints: JointSamples) -> Iterator[ReferenceEvent]:
    """Yield setpoints as trajectories of one point that are taken at once."""
    columns = (part.tolist() for part in setpoints[1:])
    for log_time_ns, place, position in zip(*columns, strict=True):
        yield ReferenceEvent(log_time_ns, place, Column(joint, (Knot(0, position),)))


def sample_setpoints(
    setpoints: JointSamples, states: JointSamples, stamps_ns: Integers, first_position: float
) -> Numbers | None:
    """Return what :func:`sample_events` gives for setpoints alone, all at once."""
    order = np.lexsort((setpoints.places, setpoints.log_times_ns))
    log_times, places = setpoints.log_times_ns[order], setpoints.places[order]
    following = np.searchsorted(states.log_times_ns, log_times)
    last = np.searchsorted(states.log_times_ns, log_times, "right")
    for index in np.flatnonzero(following < last).tolist():  # logged in the same nanosecond
        following[index] = states.first_after(int(log_times[index]), int(places[index]))
    is_heard = following < len(states.stamps_ns)
    begins = np.searchsorted(stamps_ns, states.stamps_ns[following[is_heard]])
    if (begins[1:] < begins[:-1]).any():
        return None
    positions = np.concatenate(([first_position], setpoints.values[order][is_heard]))
    # Of several before one state the last stands.
    sampled: Numbers = positions[np.searchsorted(begins, np.arange(len(stamps_ns)), "right")]
    return sampled


def sample_events(
    events: Iterable[ReferenceEvent],
    states: JointSamples,
    stamps_ns: Integers,
    first_position: float,
) -> Numbers:
    """Sample the reference of a joint at each of its states.

    As in :class:`hpid_ros.control.JointLoop`, a trajectory takes over with the next state (the
    first that was logged after it) from where the reference is then; one whose stamp lies ahead
    at its stamp. A stamp earlier than that state moves the take-over back to the stamp: a
    recorder that started late got the latched message later than the controllers. A later
    message supersedes an earlier one that does not begin before it. Before any the joint holds
    its first position. Glides, what fades, whole turns and stops are not in it.
    """
    spans: list[_Span] = []
    for event in events:
        begin = first_state(event, states, stamps_ns)
        if begin == len(stamps_ns):
            continue
        now_ns = int(stamps_ns[begin])
        if event.column.begin_ns > now_ns:  # it begins then, whenever the states come
            now_ns = event.column.begin_ns
            begin = int(np.searchsorted(stamps_ns, now_ns))
        while spans and spans[-1].begin >= begin:
            spans.pop()
        before = ReferenceSample(first_position, 0.0, 0.0)
        if spans:
            before = spans[-1].reference.sample(now_ns)
        spans.append(_span(begin, event.column, now_ns, before))
    reference = np.full(len(stamps_ns), first_position)
    end = len(stamps_ns)
    for span in reversed(spans):
        _fill(reference[span.begin : end], span, stamps_ns[span.begin : end])
        end = span.begin
    return reference


def first_state(event: ReferenceEvent, states: JointSamples, stamps_ns: Integers) -> int:
    """Return the index of the first state under a reference; the length if there is none."""
    begin = len(stamps_ns)
    following = states.first_after(event.log_time_ns, event.place)
    if following < len(states.stamps_ns):
        begin = int(np.searchsorted(stamps_ns, states.stamps_ns[following]))
    if event.column.stamp_ns:
        begin = min(begin, int(np.searchsorted(stamps_ns, event.column.stamp_ns)))
    return begin


def _span(begin: int, column: Column, now_ns: int, before: ReferenceSample) -> _Span:
    """Start a column, keeping its knots as :class:`SplineReference` has them."""
    reference = column.start(now_ns, before.position, before.velocity)
    start_ns = column.stamp_ns or now_ns
    knots: Sequence[Knot] = column.knots
    if now_ns - start_ns < knots[0].time_ns:
        here = Knot(now_ns - start_ns, before.position, before.velocity)
        knots = (approach(here, knots[0]), *knots)
    return _Span(begin, reference, [start_ns + knot.time_ns for knot in knots], list(knots))


def _fill(target: Numbers, span: _Span, stamps_ns: Integers) -> None:
    """Sample one reference at ascending stamps, to the bit as :class:`SplineReference` does."""
    knots, times = span.knots, span.times_ns
    bounds = [0, *np.searchsorted(stamps_ns, times).tolist(), len(stamps_ns)]
    for index in range(-1, len(knots)):
        begin, end = bounds[index + 1], bounds[index + 2]
        if begin == end:
            continue
        if 0 <= index < len(knots) - 1:
            c0, c1, c2, c3, c4, c5 = segment(knots[index], knots[index + 1])
        else:
            c0, c1, c2, c3, c4, c5 = (knots[max(index, 0)].position, 0.0, 0.0, 0.0, 0.0, 0.0)
        from_ns = times[index] if index >= 0 else int(stamps_ns[begin])
        t = (stamps_ns[begin:end] - from_ns) * SECONDS_PER_NANOSECOND
        target[begin:end] = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))


@dataclass(frozen=True)
class ReferenceCandidate:
    """What one topic says that a joint was to follow at its states."""

    text: str  # kind and topic, for instance "trajectory /joint_trajectory"
    count: int  # messages that concern the joint
    values: Numbers  # at each state, (N,), in [rad]; arbitrary where it says nothing
    known: Flags  # at which states it says something, (N,)
    period_ns: int = 0  # [ns] usual time between two messages of one that is sampled
    begin_ns: int | None = None  # [ns] stamp from which on; None if it never begins

    @property
    def topic(self) -> str:
        return self.text.partition(" ")[2] or self.text


_JITTER = 0.05  # periods by which a state may lie beyond the first or the last report
_BRIDGED = 1.5  # periods from one controller's last report to another's first are no gap
_GAP_PERIODS = 10.0  # reports so far apart have lost none: nobody reported in between
_SHORTEST_GAP = 0.5  # [s] however fast they come


def reported(text: str, known: Ordered, stamps_ns: Integers) -> ReferenceCandidate:
    """Return reports at a joint's states, linear between two of them.

    A controller reports while it is active: long before the first, after the last, and in a gap
    that no lost messages explain there is no reference.
    """
    origin = known.stamps_ns[0]  # differences of stamps are exact as doubles, stamps are not
    values: Numbers = np.interp(
        (stamps_ns - origin).astype(float),
        (known.stamps_ns - origin).astype(float),
        known.values,
    )
    steps = np.diff(known.stamps_ns)
    of_states = np.diff(stamps_ns)
    period = max(float(np.median(each)) if len(each) else 0.0 for each in (steps, of_states))
    is_gap = steps > max(_GAP_PERIODS * period, _SHORTEST_GAP * NANOSECONDS)
    begins = known.stamps_ns[np.concatenate(([True], is_gap))]
    ends = known.stamps_ns[np.concatenate((is_gap, [True]))]
    for index in np.flatnonzero(is_gap).tolist():  # on either side what is held there
        last_ns, next_ns = known.stamps_ns[index : index + 2].tolist()
        middle_ns = last_ns + (next_ns - last_ns) // 2
        first, half, end = np.searchsorted(stamps_ns, (last_ns, middle_ns, next_ns)).tolist()
        values[first:half], values[half:end] = known.values[index], known.values[index + 1]
    margin = round(_JITTER * period)
    found = ReferenceCandidate(
        text,
        len(known.values) + known.repeated,
        values,
        _is_within(stamps_ns, begins - margin, ends + margin),
        round(period),
        max(int(origin), int(stamps_ns[0])),
    )
    _go_on(found, known, stamps_ns)
    return found


def _go_on(found: ReferenceCandidate, known: Ordered, stamps_ns: Integers) -> None:
    """Let reports go on at the states before the first and after the last, within a period.

    They go as fast as between those next to them: at the slower of two rates of one sign, else
    they hold. So a motion goes on, and a step does not.
    """
    at, steps = np.flatnonzero(found.known), np.diff(known.stamps_ns)
    if len(steps) < 2 or not len(at):
        return
    first, last, period = int(at[0]), int(at[-1]), float(np.median(steps))
    before = slice(0, first), [0, 1, 2], stamps_ns[first] - stamps_ns[0]
    after = slice(last + 1, None), [-1, -2, -3], stamps_ns[-1] - stamps_ns[last]
    for states, nearest, time in (before, after):
        reported_ns, positions = known.stamps_ns[nearest], known.values[nearest]
        apart = np.diff(reported_ns)
        rates = np.diff(positions) / apart
        is_steady = (rates > 0.0).all() or (rates < 0.0).all()
        is_whole = np.abs(apart).max() <= _BRIDGED * period
        if 0 < time < found.period_ns and is_steady and is_whole:
            away = np.clip(stamps_ns[states] - reported_ns[0], -period, period)
            found.values[states] = positions[0] + rates[np.argmin(np.abs(rates))] * away


def _is_within(stamps_ns: Integers, begins: Integers, ends: Integers) -> Flags:
    """Return which stamps lie in one of some spans, both ends included."""
    last = np.searchsorted(begins, stamps_ns, "right") - 1
    inside: Flags = (last >= 0) & (stamps_ns <= ends[last])
    return inside


_APART = 0.005  # [rad] references that differ by less say the same
_SHARE_APART = 0.01  # so do those that differ by a lower share of their range
_MOST = 0.9  # what holds for this share of the states holds
_WINDOW = 1.0  # [s] in which one of two references is chosen


MOMENT_NS = NANOSECONDS // 5
"""For so long two candidates differ that contradict each other; less is between two samples."""


def lasts(flags: Flags, stamps_ns: Integers, longer_than_ns: int) -> bool:
    """Return whether flags are set for longer than some time at a stretch."""
    return any(
        stamps_ns[end - 1] - stamps_ns[first] > longer_than_ns for first, end in stretches(flags)
    )


class Disagreement(NamedTuple):
    """Two candidates that say different things at the same time."""

    taken: str  # topic of the one that the joint followed
    left: str  # topic of the other
    largest: float  # [rad] how far they are apart
    is_mixed: bool  # whether the joint followed either for a while


def apart(one: ReferenceCandidate, other: ReferenceCandidate) -> Flags:
    """Return at which states two candidates say different things."""
    both: Flags = one.known & other.known
    if not both.any():
        return both
    values = np.concatenate((one.values[both], other.values[both]))
    within = max(_APART, _SHARE_APART * float(np.ptp(values)))
    differ: Flags = both & (np.abs(one.values - other.values) > within)
    return differ


def together(
    candidates: Sequence[ReferenceCandidate], positions: Numbers, stamps_ns: Integers
) -> tuple[ReferenceCandidate, list[Disagreement]]:
    """Return the one reference that several candidates make by time, and where they disagree.

    Of two that say different things the one counts that the joint follows: over all of that time
    where that is clear, else in each second. One that adds nothing is not named.
    """
    order = sorted(candidates, key=lambda x: (-int(np.count_nonzero(x.known)), -x.count))
    found, disagreements = order[0], []
    named = [found]
    for other in order[1:]:
        differ = apart(found, other)
        takes_other = other.known & ~found.known
        period_ns = max(each.period_ns for each in (other, *named))
        if lasts(differ, stamps_ns, max(MOMENT_NS, round(_BRIDGED * period_ns))):
            closer = _closer(found, other, differ, positions, stamps_ns)
            largest = float(np.abs(found.values - other.values)[differ].max())
            takes_other = closer | (takes_other & _is_followed(other, takes_other, positions))
            left = named_topics(named)
            if closer[differ].all():
                alone = found.known & ~other.known
                if not _is_followed(found, alone, positions).any():
                    found, named = other, []
                    takes_other = other.known
                disagreements.append(Disagreement(other.topic, left, largest, False))
            else:
                is_mixed = bool(closer.any())
                disagreements.append(Disagreement(left, other.topic, largest, is_mixed))
        if takes_other.any():
            named.append(other)
            found = ReferenceCandidate(
                found.text,
                found.count,
                np.where(takes_other, other.values, found.values),
                found.known | takes_other,
            )
    values, known = _bridged(found, named, stamps_ns)
    begins = [each.begin_ns for each in named if each.begin_ns is not None]
    return (
        ReferenceCandidate(
            " and ".join(dict.fromkeys(each.text for each in sorted(named, key=_begin))),
            sum(each.count for each in named),
            values,
            known,
            begin_ns=min(begins, default=None),
        ),
        disagreements,
    )


def _begin(candidate: ReferenceCandidate) -> int:
    return candidate.begin_ns or 0


def named_topics(named: Iterable[ReferenceCandidate]) -> str:
    return " and ".join(dict.fromkeys(each.topic for each in named))


def _bridged(
    found: ReferenceCandidate, named: Sequence[ReferenceCandidate], stamps_ns: Integers
) -> tuple[Numbers, Flags]:
    """Return a sampled reference and where it is known, without what is shorter than a period.

    Such is the time before the first sample and after the last, in which the samples go on, and
    that between two controllers' samples, which a line bridges.
    """
    period_ns = max(each.period_ns for each in named)
    values, known = found.values.copy(), found.known.copy()
    at = np.flatnonzero(known)
    if not len(at) or known.all():
        return values, known
    first, last = int(at[0]), int(at[-1])
    if stamps_ns[first] - stamps_ns[0] < period_ns:
        values[:first], known[:first] = _owner(found, named, first).values[:first], True
    if stamps_ns[-1] - stamps_ns[last] < period_ns:
        values[last + 1 :] = _owner(found, named, last).values[last + 1 :]
        known[last + 1 :] = True
    for begin, end in stretches(~known):
        if begin == 0 or end == len(known):
            continue
        a, b = stamps_ns[begin - 1], stamps_ns[end]
        if b - a <= _BRIDGED * period_ns:
            share = (stamps_ns[begin:end] - a) / (b - a)
            values[begin:end] = values[begin - 1] + share * (values[end] - values[begin - 1])
            known[begin:end] = True
    return values, known


def _owner(
    found: ReferenceCandidate, named: Sequence[ReferenceCandidate], at: int
) -> ReferenceCandidate:
    """Return the candidate whose value a reference has at a state."""
    owners = (x for x in named if x.known[at] and x.values[at] == found.values[at])
    return next(owners, found)


def _is_followed(candidate: ReferenceCandidate, where: Flags, positions: Numbers) -> Flags:
    """Return the states if the joint is near the candidate at most of them, else none."""
    if not where.any():
        return where
    values = candidate.values[where]
    within = max(SMALL_ERROR, SHARE_OF_RANGE * float(np.ptp(values)))
    is_near = np.median(np.abs(values - positions[where])) <= within
    return where if is_near else np.zeros_like(where)


def followed(
    alone: Sequence[ReferenceCandidate], positions: Numbers, stamps_ns: Integers
) -> tuple[set[str], list[Disagreement]]:
    """Return the texts of those candidates that are not only a plan which nothing followed.

    A plan is one that says something else than another, which the joint follows instead, and that
    the joint does not follow where it is alone, either.
    """
    dropped: dict[str, Disagreement] = {}
    for one in alone:
        for other in alone:
            differ = apart(one, other)
            if other is one or other.text in dropped or np.count_nonzero(differ) < 2:
                continue
            if not _closer(one, other, differ, positions, stamps_ns)[differ].all():
                continue
            rest = one.known & ~other.known
            if not _is_followed(one, rest, positions).any():
                largest = float(np.abs(one.values - other.values)[differ].max())
                dropped[one.text] = Disagreement(other.topic, one.topic, largest, False)
                break
    return {each.text for each in alone} - set(dropped), list(dropped.values())


_REST = 0.05  # [rad] a joint whose positions range over no more than this has not moved


def held_at_rest(positions: Numbers, begin: int) -> Flags:
    """Return at which states a reference is known that begins with one of them.

    Before it a controller holds the joint. Where the joint moved, something else did.
    """
    known = np.ones(len(positions), dtype=np.bool_)
    if begin and np.ptp(positions[:begin]) > _REST:
        known[:begin] = False
    return known


_SAME = 1e-6  # [rad] what was asked and what is reported are one, but for rounding


def finer(
    found: ReferenceCandidate, asked: ReferenceCandidate, is_sampled: Flags
) -> ReferenceCandidate:
    """Return samples of a reference, and between two that it explains what was asked.

    A controller samples its reference more rarely than it follows it.
    """
    at = np.flatnonzero(is_sampled & found.known & asked.known)
    if not len(at):
        return found
    is_same = np.abs(found.values[at] - asked.values[at]) <= _SAME
    following = np.searchsorted(at, np.arange(len(found.values)))
    before = np.clip(np.searchsorted(at, np.arange(len(found.values)), "right") - 1, 0, None)
    following = np.minimum(following, len(at) - 1)
    takes_asked = found.known & asked.known & is_same[before] & is_same[following]
    if not takes_asked.any():
        return found
    if is_same.all():
        return asked
    values = np.where(takes_asked, asked.values, found.values)
    return replace(found, text=f"{found.text} and {asked.text}", values=values)


def _closer(
    one: ReferenceCandidate,
    other: ReferenceCandidate,
    differ: Flags,
    positions: Numbers,
    stamps_ns: Integers,
) -> Flags:
    """Return at which of the states that both know the joint follows the other candidate."""
    of_one, of_other = (np.abs(each.values - positions) for each in (one, other))
    if np.quantile(of_one[differ], _MOST) <= np.median(of_other[differ]):
        return np.zeros_like(differ)
    both: Flags = one.known & other.known
    if np.quantile(of_other[differ], _MOST) <= np.median(of_one[differ]):
        return both
    window = (stamps_ns - stamps_ns[0]) // round(_WINDOW * NANOSECONDS)
    _, window = np.unique(window, return_inverse=True)
    sums = [np.bincount(window, np.where(differ, each, 0.0)) for each in (of_one, of_other)]
    closer: Flags = both & (sums[1] < sums[0])[window]
    return closer

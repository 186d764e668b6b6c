"""The reference of a recorded run, sampled where the states are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.bags.columns.batches import Integers
from hpid_ros.bags.columns.samples import JointSamples
from hpid_ros.base.arrays import Numbers
from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.trajectory import Column, Knot, ReferenceSample, SplineReference
from hpid_ros.trajectory.spline import segment


class ReferenceEvent(NamedTuple):
    """A trajectory or setpoint of one joint, and its place in the log."""

    log_time_ns: int  # [ns] when it was recorded
    place: int  # its place in the files
    column: Column  # what the joint was told


class LoggedStates(NamedTuple):
    """One joint's states in the order of the log."""

    log_times_ns: Integers  # [ns] when they were recorded, (n,)
    places: Integers  # their places in the files, (n,)
    stamps_ns: Integers  # [ns] their stamps, (n,)

    def first_after(self, log_time_ns: int, place: int) -> int:
        """Return the index of the first state that was logged after something else."""
        begin = int(np.searchsorted(self.log_times_ns, log_time_ns))
        end = int(np.searchsorted(self.log_times_ns, log_time_ns, "right"))
        return begin + int(np.searchsorted(self.places[begin:end], place))


class _Span(NamedTuple):
    """A reference, its knots, and the index of the first state that it holds for."""

    begin: int
    reference: SplineReference
    times_ns: list[int]
    knots: list[Knot]


def setpoint_events(joint: str, setpoints: JointSamples) -> Iterator[ReferenceEvent]:
    """Yield setpoints as trajectories of one point that are taken at once."""
    assert setpoints.log_times_ns is not None
    assert setpoints.places is not None
    for log_time_ns, place, position in zip(
        setpoints.log_times_ns.tolist(),
        setpoints.places.tolist(),
        setpoints.values.tolist(),
        strict=True,
    ):
        yield ReferenceEvent(log_time_ns, place, Column(joint, (Knot(0, position),)))


def sample_setpoints(
    setpoints: JointSamples, states: LoggedStates, stamps_ns: Integers, first_position: float
) -> Numbers | None:
    """Return what :func:`sample_events` gives for setpoints alone, all at once."""
    assert setpoints.log_times_ns is not None
    assert setpoints.places is not None
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
    states: LoggedStates,
    stamps_ns: Integers,
    first_position: float,
) -> Numbers:
    """Sample what a joint was told to follow at each of its states.

    As in :class:`hpid_ros.control.JointLoop`, a trajectory takes over with the next state (the
    first that was logged after it) from where the reference stood at the state before, also when
    its stamp lies ahead. A stamp earlier than that state moves the take-over back to the stamp:
    a recorder that started late got the latched message later than the controllers. A later
    message supersedes an earlier one. Before any the joint holds its first position.
    """
    spans: list[_Span] = []
    for event in events:
        begin = first_state(event, states, stamps_ns)
        if begin == len(stamps_ns):
            continue
        while spans and spans[-1].begin >= begin:
            spans.pop()
        before = ReferenceSample(first_position, 0.0, 0.0)
        if spans:
            before = spans[-1].reference.sample(int(stamps_ns[begin - 1]))
        spans.append(_span(begin, event.column, int(stamps_ns[begin]), before))
    reference = np.full(len(stamps_ns), first_position)
    end = len(stamps_ns)
    for span in reversed(spans):
        _fill(reference[span.begin : end], span, stamps_ns[span.begin : end])
        end = span.begin
    return reference


def interpolate(stamps_ns: Integers, times_ns: Integers, values: Numbers) -> Numbers:
    """Return a sampled reference at other stamps: linear between, constant before and after."""
    origin = times_ns[0]  # differences of stamps are exact as doubles, stamps are not
    sampled: Numbers = np.interp(
        (stamps_ns - origin).astype(float), (times_ns - origin).astype(float), values
    )
    return sampled


def first_state(event: ReferenceEvent, states: LoggedStates, stamps_ns: Integers) -> int:
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
    first = knots[0]
    if now_ns - start_ns < first.time_ns:
        acceleration = None if first.acceleration is None else 0.0
        here = Knot(now_ns - start_ns, before.position, before.velocity, acceleration)
        knots = (here, *knots)
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

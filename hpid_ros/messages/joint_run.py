"""One joint of a recording as a series, with what was lost and on what it stands."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.messages.columns import Integers, JointSamples
from hpid_ros.messages.selection import BagSelection, RecordedRun
from hpid_ros.messages.series import (
    HOLD,
    MEASURED,
    NO_EFFORT,
    NONE,
    DataQuality,
    JointSeries,
    Losses,
    SeriesError,
    StampQuality,
)
from hpid_ros.motion.joint_trajectory import (
    Column,
    JointTrajectory,
    Knot,
    ReferenceSample,
    SplineReference,
    segment,
)

_LATE = 1.5
"""Periods between two stamps from which on a sample is taken to be missing."""


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

    def quality(self, origin_ns: int) -> StampQuality:
        """Return what the stamps say."""
        stamps_ns, _, repeated, out_of_order, not_finite = self
        counts = {"repeated": repeated, "out_of_order": out_of_order, "not_finite": not_finite}
        if not len(stamps_ns):
            return StampQuality(**counts)
        begin, end = ((int(stamps_ns[k]) - origin_ns) / NANOSECONDS for k in (0, -1))
        if len(stamps_ns) < 2:
            return StampQuality(1, begin=begin, end=end, **counts)
        steps = np.diff(stamps_ns)
        period = float(np.median(steps))
        late = np.flatnonzero(steps > _LATE * period)
        missing = int(np.sum(np.rint(steps[late] / period) - 1.0))
        # Samples that came late and then in a bunch are not missing.
        room = round(int(stamps_ns[-1] - stamps_ns[0]) / period) + 1 - len(stamps_ns)
        longest, at = 0.0, 0.0
        if len(late):
            where = int(late[np.argmax(steps[late])])
            longest = float(steps[where]) / NANOSECONDS
            at = (int(stamps_ns[where]) - origin_ns) / NANOSECONDS
        return StampQuality(
            len(stamps_ns),
            period / NANOSECONDS,
            begin,
            end,
            gaps=len(late),
            lost=max(min(missing, room), 0),
            gap_time=float(np.sum(steps[late])) / NANOSECONDS,
            longest_gap=longest,
            longest_gap_at=at,
            **counts,
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
_STRAYS = 30  # states that come so much late; more are a clock of their own
RUN_SPACING_NS = 1_000_000_000_000_000
"""Added to the stamps of each run after another one: longer than any run."""


def separated(stamps_ns: Integers) -> Integers:
    """Return stamps in which a run that started again follows the one before."""
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


def _overlap(one: Integers, other: Integers) -> bool:
    """Return whether two ranges of times have something in common."""
    return bool(one.min() <= other.max() and other.min() <= one.max())


_FOREVER_NS = 2**63 - 1
_EMPTY = Ordered(np.empty(0, dtype=np.int64), np.empty(0))


class Window(NamedTuple):
    """The time that is read, both ends included."""

    origin_ns: int  # [ns] first state of any joint
    first_ns: int  # [ns] its first instant
    last_ns: int  # [ns] its last instant

    @classmethod
    def of(cls, origin_ns: int, start: float | None, end: float | None) -> Window:
        """Return the window between two times since the first state, in [s]; None is no bound."""
        first_ns = -_FOREVER_NS if start is None else origin_ns + round(start * NANOSECONDS)
        last_ns = _FOREVER_NS if end is None else origin_ns + round(end * NANOSECONDS)
        return cls(origin_ns, first_ns, last_ns)


_Reference = tuple[Numbers, str, int, int | None]
"""A joint's reference at its states, kind and topic, its messages, when it began, in [ns]."""


class JointRun:
    """One joint of a recording; taking it frees the recording's columns."""

    def __init__(self, recording: RecordedRun, joint: str, selection: BagSelection) -> None:
        self._recording, self._joint, self._selection = recording, joint, selection
        self._clock = clock = selection.clock
        taken = recording.take_states(joint)
        if taken is None:
            raise SeriesError(f"joint {joint!r}: no state carries its position")
        samples, not_finite = finite(taken)
        if not len(samples.values):
            raise SeriesError(
                f"joint {joint!r}: position must be finite and below {LARGEST:g}, but no "
                "state's is"
            )
        self._header_ns = samples.stamps_ns
        self._samples = samples._replace(stamps_ns=self._times(samples))
        if not selection.separates_runs:
            self._require_one_run()
        self.states = ordered(self._samples.stamps_ns, samples.values, not_finite)
        if clock == "header" and len(samples.values) > 1 and not self.states.stamps_ns.any():
            raise SeriesError(
                f"joint {joint!r}: its states carry no stamps; read them with clock 'receive'"
            )

    def _require_one_run(self) -> None:
        """Refuse runs on a clock that began again: they would be laid over each other."""
        stamps_ns = self._samples.stamps_ns
        behind = np.maximum.accumulate(stamps_ns) - stamps_ns
        if np.count_nonzero(behind >= _RESET_NS) > _STRAYS:
            raise SeriesError(
                f"joint {self._joint!r}: the clock of its states went back by "
                f"{behind.max() / NANOSECONDS:.3g} s, or two senders have clocks of their own; "
                f"read them with clock 'receive'"
            )

    def is_within(self, window: Window) -> bool:
        """Return whether the joint has a state in a window."""
        return len(self.states.within(window.first_ns, window.last_ns).stamps_ns) > 0

    def series(self, window: Window) -> tuple[JointSeries, Losses, DataQuality]:
        """Return the joint's series within a window, its losses and its quality."""
        whole = self.states
        reference, kind, count, begin = self._reference(whole, window)
        states = whole.within(window.first_ns, window.last_ns)
        if not len(states.stamps_ns):
            raise SeriesError(f"joint {self._joint!r}: no state in the window")
        commands, command_clock, effort = self._commands()
        commands = commands.within(window.first_ns, window.last_ns)
        if np.array_equal(commands.stamps_ns, states.stamps_ns):
            commands = commands._replace(stamps_ns=states.stamps_ns)
        losses, answers = self._losses(states, commands, command_clock)
        if len(reference):
            reference = Ordered(whole.stamps_ns, reference).within(*window[1:]).values
        for array in (*states[:2], *commands[:2], reference):
            array.setflags(write=False)
        series = JointSeries(self._joint, *states[:2], reference, *commands[:2])
        quality = DataQuality(
            states=states.quality(window.origin_ns),
            commands=commands.quality(window.origin_ns),
            state_clock=self._clock,
            command_clock=command_clock,
            answers_states=answers,
            reference=kind,
            references=count,
            reference_from=None if begin is None else (begin - window.origin_ns) / NANOSECONDS,
            effort=effort if len(commands.stamps_ns) else NONE,
            no_effort="" if len(commands.stamps_ns) else self._no_effort,
        )
        return series, losses, quality

    def _times(self, samples: JointSamples) -> Integers:
        """Return the samples' times on the chosen clock."""
        times = samples.stamps_ns if self._clock == "header" else samples.log_times_ns
        return separated(times) if self._selection.separates_runs else times

    def _commands(self) -> tuple[Ordered, str, str]:
        """Return the commands in the order of their stamps, whose clock these are, their topic."""
        choice = self._recording.choice
        self._no_effort = self._why_no_effort()
        command = choice.command_topics.get(self._joint)
        if command is not None:
            samples = self._recording.floats[command.topic].take(self._joint)
            if samples is not None:
                return self._unstamped(samples), "receive", command.topic
        for topic, stream in self._recording.commands.items():
            samples = stream.take(self._joint)
            if samples is None:
                continue
            if choice.is_measured:
                return self._measured(samples), self._clock, f"{MEASURED}, of {topic}"
            if self._is_unstamped(samples):
                return self._unstamped(samples), "receive", topic
            samples, not_finite = self._finite_efforts(samples)
            return ordered(self._times(samples), samples.values, not_finite), self._clock, topic
        return _EMPTY, self._clock, ""

    def _measured(self, samples: JointSamples) -> Ordered:
        """Return measured efforts; none where the driver fills the field without measuring."""
        samples, not_finite = finite(samples)
        is_asked_for = self._selection.commands is not None
        if not len(samples.values) or not (is_asked_for or samples.values.any()):
            state = "not a number" if not len(samples.values) else "zero"
            topic = " and ".join(self._recording.choice.states)
            self._no_effort = f"the efforts that {topic} measured are {state} throughout"
            return _EMPTY
        return ordered(self._times(samples), samples.values, not_finite)

    def _why_no_effort(self) -> str:
        choice = self._recording.choice
        if not choice.has_commands:
            return "no efforts were read, as asked for"
        if choice.in_doubt:
            return f"{NO_EFFORT} as such ({', '.join(choice.in_doubt)} may carry them)"
        return NO_EFFORT

    def _is_unstamped(self, samples: JointSamples) -> bool:
        """Tell whether messages that should have stamps have none."""
        is_stamped = self._clock == "header" and len(samples.values) > 1
        return is_stamped and not samples.stamps_ns.any()

    def _is_on_another_clock(self, samples: JointSamples) -> bool:
        """Tell whether messages were received beside the states, and stamped at another time."""
        mine = self._samples
        return (
            self._clock == "header"
            and not _overlap(samples.stamps_ns, mine.stamps_ns)
            and _overlap(samples.log_times_ns, mine.log_times_ns)
        )

    def _unstamped(self, samples: JointSamples) -> Ordered:
        samples, not_finite = self._finite_efforts(samples)
        times, states = samples.log_times_ns, self._samples
        if self._clock == "header":
            times = carried(times, states.log_times_ns, states.stamps_ns)
        return ordered(times, samples.values, not_finite)

    def _finite_efforts(self, samples: JointSamples) -> tuple[JointSamples, int]:
        samples, not_finite = finite(samples)
        if not len(samples.values):
            raise SeriesError(
                f"joint {self._joint!r}: effort must be finite and below {LARGEST:g}, but no "
                "command's is"
            )
        return samples, not_finite

    def _losses(self, states: Ordered, commands: Ordered, clock: str) -> tuple[Losses, bool]:
        """Return what went missing, and whether commands answer states at all."""
        count = len(states.stamps_ns)
        if not len(commands.stamps_ns):
            choice = self._recording.choice
            return Losses(count if choice.has_commands and not choice.is_measured else 0, 0), True
        if commands.stamps_ns is states.stamps_ns:
            return Losses(0, commands.repeated), True
        places = np.searchsorted(commands.stamps_ns, states.stamps_ns)
        places = np.minimum(places, len(commands.stamps_ns) - 1)
        answered = int(np.count_nonzero(commands.stamps_ns[places] == states.stamps_ns))
        if clock == "receive" or not answered:
            return Losses(0, commands.repeated), False
        return Losses(count - answered, commands.repeated), True

    def _reference(self, states: Ordered, window: Window) -> _Reference:
        """Return the reference at the states and where it comes from; none without one."""
        asked = self._selection.reference
        if asked == HOLD:
            held = np.full(len(states.stamps_ns), states.values[0])
            return held, HOLD, 0, None
        if isinstance(asked, JointTrajectory):
            trajectories, setpoints = self._given(asked, window), None
        else:
            trajectories = [
                (kind, self._on_clock(event))
                for kind, event in sorted(self._trajectories(), key=lambda each: each[1][:2])
            ]
            setpoints = self._setpoints()
        if trajectories or setpoints is not None:
            return self._followed(trajectories, setpoints, states)
        for topic, stream in self._recording.sampled.items():
            samples = stream.take(self._joint)
            if samples is None:
                continue
            samples, not_finite = finite(samples)
            if len(samples.values):
                is_sampled = topic in self._recording.choice.references.sampled
                kind = f"{'sampled' if is_sampled else 'controller_state'} {topic}"
                times = self._times(samples)
                if self._is_unstamped(samples) or self._is_on_another_clock(samples):
                    mine = self._samples
                    times = carried(samples.log_times_ns, mine.log_times_ns, mine.stamps_ns)
                    kind += ", by the times at which it was received"
                known = ordered(times, samples.values, not_finite)
                values = interpolate(states.stamps_ns, known.stamps_ns, known.values)
                values[states.stamps_ns < known.stamps_ns[0]] = states.values[0]
                begin_ns = max(int(known.stamps_ns[0]), int(states.stamps_ns[0]))
                return values, kind, len(samples.values), begin_ns
        return np.empty(0), NONE, 0, None

    def _followed(
        self,
        trajectories: list[tuple[str, ReferenceEvent]],
        setpoints: tuple[str, JointSamples] | None,
        states: Ordered,
    ) -> _Reference:
        """Return the reference that trajectories and setpoints make together."""
        logged, stamps_ns = self._samples, states.stamps_ns
        first = float(states.values[0])
        kinds = dict.fromkeys(kind for kind, _ in trajectories)
        events = [event for _, event in trajectories]
        count, values = len(events), None
        if setpoints is not None:
            kind, positions = setpoints
            kinds[kind] = None
            count += len(positions.values)
            if not events:
                values = sample_setpoints(positions, logged, stamps_ns, first)
            events += setpoint_events(self._joint, positions)
            events.sort(key=lambda each: each[:2])
        # Where setpoints could be sampled at once, they take effect in the order of the log.
        taken = events if values is None else events[:1]
        begin = min(first_state(each, logged, stamps_ns) for each in taken)
        begin_ns = int(stamps_ns[begin]) if begin < len(stamps_ns) else None
        if values is None:
            values = sample_events(events, logged, stamps_ns, first)
        return values, " and ".join(kinds), count, begin_ns

    def _given(
        self, trajectory: JointTrajectory, window: Window
    ) -> list[tuple[str, ReferenceEvent]]:
        """Return a trajectory that was followed from the first state of any joint on."""
        if self._joint not in trajectory.joint_names:
            return []
        column = trajectory.column(self._joint)
        if window.origin_ns > 0:
            column = dataclasses.replace(column, stamp_ns=window.origin_ns)
        return [("given", ReferenceEvent(-_FOREVER_NS, -1, column))]

    def _trajectories(self) -> Iterator[tuple[str, ReferenceEvent]]:
        """Yield the trajectories that concern the joint, with kind and topic."""
        for log_time_ns, place, topic, arrays in self._recording.trajectories:
            if self._joint in arrays.names:
                event = ReferenceEvent(log_time_ns, place, arrays.column(self._joint))
                yield f"trajectory {topic}", event

    def _setpoints(self) -> tuple[str, JointSamples] | None:
        """Return the setpoints of the joint with kind and topic; None if it has none."""
        topic = self._recording.choice.references.setpoint.get(self._joint, "")
        samples = self._recording.setpoints[topic].take(self._joint) if topic else None
        if samples is None:
            return None
        samples, _ = finite(samples)
        return (f"setpoint {topic}", samples) if len(samples.values) else None

    def _on_clock(self, event: ReferenceEvent) -> ReferenceEvent:
        """Carry the start of a trajectory to the clock of the series."""
        column, header, states = event.column, self._header_ns, self._samples
        if self._clock == "header" or not column.stamp_ns:
            return event
        following = min(states.first_after(event.log_time_ns, event.place), len(header) - 1)
        start_ns = column.stamp_ns + int(states.stamps_ns[following] - header[following])
        if not header.any() or start_ns <= 0:
            start_ns = 0  # the states' headers do not say when it began
        return event._replace(column=dataclasses.replace(column, stamp_ns=start_ns))

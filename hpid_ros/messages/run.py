"""From the bag of a run to the arrays that the indices are computed from."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import BagError, TrajectoryError, listed_names
from hpid_ros.base.names import NamePatterns
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.control.reference import GRACE_NS, LATCHED_WITHIN, require_timely
from hpid_ros.messages.clocks import (
    RESET_NS,
    STRAYS,
    SetBack,
    ahead_ns,
    late_ns,
    set_backs,
    set_right,
    states_set_right,
    unstamped,
)
from hpid_ros.messages.columns import (
    LARGEST,
    Integers,
    JointSamples,
    JointStream,
    Ordered,
    carried,
    finite,
    ordered,
)
from hpid_ros.messages.efforts import EffortCandidate, in_turn
from hpid_ros.messages.feedback import feedback_away
from hpid_ros.messages.references import (
    MOMENT_NS,
    Flags,
    ReferenceCandidate,
    ReferenceEvent,
    apart,
    finer,
    first_state,
    followed,
    held_at_rest,
    lasts,
    reported,
    sample_events,
    sample_setpoints,
    setpoint_events,
    together,
)
from hpid_ros.messages.selection import (
    FOREIGN,
    REPORTS,
    UNLIKE,
    BagSelection,
    RecordedRun,
    TopicChoice,
    choose_topics,
    glimpse,
)
from hpid_ros.messages.series import (
    GIVEN,
    HOLD,
    MEASURED,
    NO_EFFORT,
    NONE,
    DataQuality,
    JointSeries,
    KeptJoints,
    Losses,
    RecordingQuality,
    RunSeries,
    SeriesError,
    StampQuality,
    stretches,
)
from hpid_ros.messages.spill import Kept, Spill
from hpid_ros.messages.storage import (
    Progress,
    Storage,
    missed_messages,
    no_progress,
    opened,
    time_stood_still,
)
from hpid_ros.messages.turns import CONTINUOUS, PRISMATIC, in_nearest_turn, unwrapped
from hpid_ros.motion.joint_trajectory import Column, JointTrajectory


def _overlap(one: Integers, other: Integers) -> bool:
    """Return whether two ranges of times have something in common."""
    return bool(one.min() <= other.max() and other.min() <= one.max())


_RUN_SPACING_NS = 1_000_000_000_000_000
"""Added to the stamps of each run after another one: longer than any run."""
_FOREVER_NS = 2**63 - 1
_MOST, _IN_TURN = 0.9, math.pi / 2.0  # [rad] for most of the time, a joint is so near its turn
_AT_END = 0.05  # [rad] a joint that is no farther from the end of a trajectory has followed it
_NO_EFFORT_WITHIN = "no effort lies within the time that is read, or efforts are on another clock"
_EMPTY = Ordered(np.empty(0, dtype=np.int64), np.empty(0))


class Window(NamedTuple):
    """The time that is read, both ends included."""

    origin_ns: int  # [ns] first state of any joint
    first_ns: int  # [ns] its first instant
    last_ns: int  # [ns] its last instant


def _of_window(
    found: ReferenceCandidate | None, whole_ns: Integers, stamps_ns: Integers
) -> tuple[Numbers, Flags]:
    """Return a reference at the states of a window, and where it is known; empty without one."""
    if found is not None:
        first = int(np.searchsorted(whole_ns, stamps_ns[0]))
        inner = slice(first, first + len(stamps_ns))
        if found.known[inner].any():
            return found.values[inner].copy(), found.known[inner].copy()
    return np.empty(0), np.zeros(len(stamps_ns), dtype=np.bool_)


def _spans(known: Flags, stamps_ns: Integers) -> Iterator[Integers]:
    """Yield the stamps of the first and the last state of each stretch that is known."""
    for first, end in stretches(known):
        yield stamps_ns[[first, end - 1]]


class NoNumberError(SeriesError):
    """A joint whose positions are no numbers."""


class JointRun:
    """One joint of a recording; taking it frees the recording's columns."""

    def __init__(self, recording: RecordedRun, joint: str, selection: BagSelection) -> None:
        self._recording, self._joint, self._selection = recording, joint, selection
        self._clock = clock = selection.clock
        self._topic = recording.topic_of_states(joint)
        taken = recording.take_states(joint)
        if taken is None:
            raise SeriesError(f"joint {joint!r}: no state carries its position")
        samples, not_finite = finite(self._stamped(self._topic, taken))
        if not len(samples.values):
            raise NoNumberError(
                f"joint {joint!r}: position must be finite and below {LARGEST:g}, but no state's "
                "is"
            )
        self._header_ns = samples.stamps_ns
        self._aside: tuple[Spill, Kept, Kept] | None = None
        self._begun_ns: Integers | None = None  # when runs but the first began, by their states
        self._set_backs: list[SetBack] = set_backs(samples) if clock == "header" else []
        times = self._separated(samples, self._state_times(samples))
        self._samples = samples._replace(stamps_ns=times)
        if not selection.separates_runs:
            self._require_one_run()
        states = ordered(self._samples.stamps_ns, samples.values, not_finite)
        self._kind = selection.kinds.get(joint)
        self.states, turns = unwrapped(states, self._kind)
        self._turns = turns > 0 or self._kind == CONTINUOUS
        if turns and self._kind != CONTINUOUS:
            recording.unwrap(joint, turns, self._kind)
        if clock == "header" and len(samples.values) > 1 and not self.states.stamps_ns.any():
            raise SeriesError(
                f"joint {joint!r}: its states carry no stamps; read them with clock 'receive' "
                "(--clock receive)"
            )

    def set_aside(self, spill: Spill) -> None:
        """Keep the numbers where they need no memory until the series is asked for."""
        samples, states = self._samples.values, self.states.values
        kept = spill.keep(samples)
        self._aside = spill, kept, kept if states is samples else spill.keep(states)
        self._samples = self._samples._replace(values=_EMPTY.values)
        self.states = self.states._replace(values=_EMPTY.values)

    def _take_up(self) -> None:
        if self._aside is not None:
            spill, kept, of_states = self._aside
            samples = spill.array(kept)
            states = samples if of_states is kept else spill.array(of_states)
            self._samples = self._samples._replace(values=samples)
            self.states = self.states._replace(values=states)
            self._aside = None

    def _require_one_run(self) -> None:
        """Refuse runs on a clock that began again: they would be laid over each other."""
        stamps_ns = self._samples.stamps_ns
        behind = np.maximum.accumulate(stamps_ns) - stamps_ns
        if np.count_nonzero(behind >= RESET_NS) > STRAYS:
            raise SeriesError(
                f"joint {self._joint!r}: the clock of its states went back by "
                f"{behind.max() / NANOSECONDS:.3g} s, or two senders have clocks of their own; "
                f"read them with clock 'receive' (--clock receive)"
            )

    def series(self, window: Window) -> tuple[JointSeries, Losses, DataQuality] | None:
        """Return the series, losses and quality within a window; None without a state in it."""
        self._take_up()
        whole = self.states
        states = whole.within(window.first_ns, window.last_ns)
        if not len(states.stamps_ns):
            return None
        found = self._reference(whole, window)
        commands, command_clock, effort = self._commands()
        no_effort = _NO_EFFORT_WITHIN if len(commands.stamps_ns) else self._no_effort
        commands = commands.within(window.first_ns, window.last_ns)
        if np.array_equal(commands.stamps_ns, states.stamps_ns):
            commands = commands._replace(stamps_ns=states.stamps_ns)
        losses, answers = self._losses(states, commands, command_clock, effort)
        reference, known = _of_window(found, whole.stamps_ns, states.stamps_ns)
        for array in (*states[:2], *commands[:2], reference):
            array.setflags(write=False)
        is_known = None if not len(reference) or known.all() else known
        series = JointSeries(self._joint, *states[:2], reference, *commands[:2], known=is_known)
        begin = None if found is None else found.begin_ns
        quality = DataQuality(
            states=self._recording.quality(states, window.origin_ns),
            commands=self._recording.quality(commands, window.origin_ns),
            state_clock=self._clock,
            command_clock=command_clock,
            answers_states=answers,
            reference=NONE if found is None else found.text,
            references=0 if found is None else found.count,
            reference_from=None if begin is None else (begin - window.origin_ns) / NANOSECONDS,
            reference_spans=tuple(
                tuple((int(stamp) - window.origin_ns) / NANOSECONDS for stamp in span)
                for span in _spans(known, states.stamps_ns)
            ),
            effort=effort if len(commands.stamps_ns) else NONE,
            no_effort="" if len(commands.stamps_ns) else no_effort,
        )
        return series, losses, quality

    def _stamped(self, topic: str, samples: JointSamples) -> JointSamples:
        """Return the samples without those that alone have no stamp."""
        without = unstamped(samples.stamps_ns) if self._clock == "header" else None
        if without is None:
            return samples
        self._recording.note_unstamped(topic, int(np.count_nonzero(without)))
        return samples.picked(~without)

    def _state_times(self, samples: JointSamples) -> Integers:
        """Return the states' times on the chosen clock, as if it had never been set back."""
        if self._clock != "header":
            return samples.log_times_ns
        if not self._set_backs:
            return samples.stamps_ns
        times = states_set_right(samples, self._set_backs)
        for each in self._set_backs:
            at = (int(times[each.at]) - int(times[0])) / NANOSECONDS
            self._recording.note_set_back(self._topic, at, each.by_ns / NANOSECONDS)
        return times

    def _times(self, samples: JointSamples) -> Integers:
        """Return times of another topic on the chosen clock, as those of the states."""
        times = samples.stamps_ns if self._clock == "header" else samples.log_times_ns
        if self._set_backs and len(times):
            times = set_right(samples, self._set_backs, self._states_set_right)
        return self._separated(samples, times)

    @cached_property
    def _states_set_right(self) -> JointSamples:
        """The states with stamps set right, in runs that are not separated."""
        states = self._samples._replace(stamps_ns=self._header_ns)
        return states._replace(stamps_ns=states_set_right(states, self._set_backs))

    def _separated(self, samples: JointSamples, times: Integers) -> Integers:
        """Return times with runs that began again separated."""
        if not self._selection.separates_runs:
            return times
        if self._begun_ns is None:
            self._begun_ns = samples.log_times_ns[1:][np.diff(times) <= -RESET_NS]
        runs = np.searchsorted(self._begun_ns, samples.log_times_ns, "right")
        later: Integers = times + _RUN_SPACING_NS * runs
        return later

    def _compare_clock(self, topic: str, samples: JointSamples) -> None:
        """Note a topic whose stamps are of another clock than the states', or late."""
        if self._clock == "header" and self._recording.compares(topic):
            states = self._samples._replace(stamps_ns=self._header_ns)
            if _overlap(samples.stamps_ns, states.stamps_ns):
                self._recording.note_ahead(topic, self._topic, ahead_ns(samples, states))

    def _commands(self) -> tuple[Ordered, str, str]:
        """Return the commands in the order of their stamps, whose clock these are, their topic."""
        choice = self._recording.choice
        self._no_effort = NO_EFFORT
        if not choice.has_commands:
            self._no_effort = "no efforts were read, as asked for"
        elif self._joint in self._recording.efforts_elsewhere:
            topic = self._recording.efforts_elsewhere[self._joint]
            self._no_effort = f"no effort is where it was read, but {topic} has some (--states)"
        elif choice.in_doubt:
            self._no_effort += f" as such ({', '.join(choice.in_doubt)} may carry them)"
        if choice.is_measured:
            return self._measured(self._recording.commands)
        without_numbers, taken = list[str](), list[tuple[str, JointSamples, int, bool]]()
        for topic, samples, is_stamped in self._efforts():
            found, not_finite = finite(samples)
            if len(found.values):
                taken.append((topic, found, not_finite, is_stamped))
            else:
                without_numbers.append(topic)
        # Of several each must be on the clock of the states, by stamps or as it was received.
        candidates = [
            self._candidate(
                *(topic, found, not_finite),
                is_stamped and not (len(taken) > 1 and self._is_on_another_clock(found)),
            )
            for topic, found, not_finite, is_stamped in taken
        ]
        if len(candidates) > 1:
            candidate, contradictions = in_turn(candidates)
            for each in contradictions:
                self._recording.contradict(self._joint, each)
        elif candidates:
            (candidate,) = candidates
        else:
            if without_numbers:
                topics = " and ".join(without_numbers)
                self._no_effort = f"the efforts on {topics} are not a number throughout"
            measured = self._measured(self._recording.measured)
            if without_numbers:
                self._recording.note_no_numbers(self._joint, without_numbers, measured[2])
            return measured
        if without_numbers:
            topics = " and ".join(candidate.topics)
            self._recording.note_no_numbers(self._joint, without_numbers, topics)
        return candidate.samples, candidate.clock, " and ".join(candidate.topics)

    def _efforts(self) -> Iterator[tuple[str, JointSamples, bool]]:
        """Yield topic and efforts of each that commands the joint, and whether it has stamps."""
        recording = self._recording
        command = recording.choice.command_topics.get(self._joint)
        if command is not None:
            samples = recording.floats[command.topic].take(self._joint)
            if samples is not None:
                yield command.topic, samples, False
                if self._joint in self._selection.command_topics:
                    return
        for topic, stream in recording.commands.items():
            samples = stream.take(self._joint)
            if samples is not None:
                samples = self._stamped(topic, samples)
                yield topic, samples, not self._is_unstamped(samples)

    def _candidate(
        self, topic: str, samples: JointSamples, not_finite: int, is_stamped: bool
    ) -> EffortCandidate:
        times, clock = samples.log_times_ns, "receive"
        if is_stamped:
            self._compare_clock(topic, samples)
            times, clock = self._times(samples), self._clock
        elif self._clock == "header":
            states = self._samples
            times = carried(times, states.log_times_ns, states.stamps_ns)
        return EffortCandidate(ordered(times, samples.values, not_finite), clock, (topic,))

    def _measured(self, streams: Mapping[str, JointStream]) -> tuple[Ordered, str, str]:
        """Return measured efforts; none where the driver fills the field without measuring."""
        for topic, stream in streams.items():
            taken = stream.take(self._joint)
            if taken is None:
                continue
            samples, not_finite = finite(self._stamped(topic, taken))
            is_asked_for = self._selection.commands is not None
            if not len(samples.values) or not (is_asked_for or samples.values.any()):
                state = "not a number" if not len(samples.values) else "zero"
                states = " and ".join(self._recording.choice.states)
                self._no_effort = f"the efforts that {states} measured are {state} throughout"
                break
            found = ordered(self._times(samples), samples.values, not_finite)
            return found, self._clock, f"{MEASURED}, of {topic}"
        return _EMPTY, self._clock, ""

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

    def _losses(
        self, states: Ordered, commands: Ordered, clock: str, topic: str
    ) -> tuple[Losses, bool]:
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
        # A trajectory controller reports at a rate of its own.
        if clock == "receive" or not answered or self._recording.reports & {*topic.split(" and ")}:
            return Losses(0, commands.repeated), False
        return Losses(count - answered, commands.repeated), True

    def _reference(self, states: Ordered, window: Window) -> ReferenceCandidate | None:
        """Return the reference at the states; None without one.

        What controllers report of a joint counts, and what they were asked where none reports.
        """
        asked = self._selection.reference
        if asked == HOLD:
            held, known = (np.full(len(states.values), each) for each in (states.values[0], True))
            return ReferenceCandidate(HOLD, 0, held, known)
        if isinstance(asked, JointTrajectory):
            given = self._given(asked, window)
            return self._followed(given, None, states) if given else None
        reports, sampled = self._reports(states)
        wanted = self._asked(states)
        if not reports:
            return wanted
        found, disagreements = together(reports, states.values, states.stamps_ns)
        for each in disagreements:
            self._recording.disagree(self._joint, each)
        if wanted is not None:
            differ = apart(found, wanted)
            if lasts(differ, states.stamps_ns, MOMENT_NS):
                self._recording.overrule(self._joint, found, wanted, differ)
            if sampled is not None:
                return finer(found, wanted, np.isin(states.stamps_ns, sampled))
        return found

    def _reports(self, states: Ordered) -> tuple[list[ReferenceCandidate], Integers | None]:
        """Return what controllers report, and the stamps of what our own one samples."""
        found: list[tuple[str, Ordered]] = []
        stamps_ns = None
        for topic, stream in self._recording.sampled.items():
            taken = stream.take(self._joint)
            if taken is None:
                continue
            samples, not_finite = finite(self._stamped(topic, taken))
            if not len(samples.values):
                continue
            if not self._is_of_position(topic, states):
                continue
            is_sampled = topic in self._recording.choice.references.sampled
            text = f"{'sampled' if is_sampled else 'controller_state'} {topic}"
            self._compare_clock(topic, samples)
            times, is_stamped = self._report_times(samples)
            if not is_stamped:
                text += ", by the times at which it was received"
            known = ordered(times, samples.values, not_finite)
            found.append((text, known))
            stamps_ns = known.stamps_ns if is_sampled and len(found) == 1 else None
        if not self._turns:
            reports = [reported(*each, states.stamps_ns) for each in found]
            leave_out = [
                self._leaves_out_turns(report, known, states)
                for report, (_, known) in zip(reports, found, strict=True)
            ]
            self._turns = any(leave_out)
            if not self._turns:
                return reports, stamps_ns
        return [self._of_turns(*each, states) for each in found], stamps_ns

    def _report_times(self, samples: JointSamples) -> tuple[Integers, bool]:
        """Return when a controller reported on the clock of the states, and if its stamps say."""
        if self._is_unstamped(samples) or self._is_on_another_clock(samples):
            mine = self._samples
            return carried(samples.log_times_ns, mine.log_times_ns, mine.stamps_ns), False
        return self._times(samples), True

    def _is_of_position(self, topic: str, states: Ordered) -> bool:
        """Return whether what a report is about is the joint's position, by its feedback."""
        taken = self._recording.take_feedback(topic, self._joint)
        if taken is None:
            return True
        samples, not_finite = finite(self._stamped(topic, taken))
        if not len(samples.values):
            return True
        feedback = ordered(self._report_times(samples)[0], samples.values, not_finite)
        away = feedback_away(feedback, states, turns=self._kind != PRISMATIC)
        if away is None:
            return True
        if self._recording.may_be_foreign(topic) and away.exceeds(*FOREIGN):
            self._recording.be_foreign(topic, self._joint)
            return False
        if samples.values.any() and away.exceeds(*UNLIKE):  # some leave the field at zero
            self._recording.differ(topic, self._joint, away.largest)
        return True

    def _asked(self, states: Ordered) -> ReferenceCandidate | None:
        """Return what trajectories and setpoints ask of the joint; None without any."""
        events = [
            (f"trajectory {topic}", event)
            for log_time_ns, place, topic, column in self._recording.trajectories_of(self._joint)
            if self._is_taken(event := self._on_clock(log_time_ns, place, column), topic)
        ]
        self._compare_trajectories(events)
        events.sort(key=lambda each: each[1][:2])
        texts = dict.fromkeys(text for text, _ in events)
        if len(texts) > 1:
            alone = [
                self._followed([each for each in events if each[0] == text], None, states)
                for text in texts
            ]
            kept, disagreements = followed(alone, states.values, states.stamps_ns)
            for each in disagreements:
                self._recording.disagree(self._joint, each)
            events = [each for each in events if each[0] in kept]
        setpoints = self._setpoints()
        if not events and setpoints is None:
            return None
        return self._followed(events, setpoints, states)

    def _of_turns(self, text: str, known: Ordered, states: Ordered) -> ReferenceCandidate:
        """Return reports at the states, with the turns that they leave out."""
        whole, _ = unwrapped(known, CONTINUOUS)
        return self._turned(reported(text, whole, states.stamps_ns), states)

    def _leaves_out_turns(
        self, plain: ReferenceCandidate, known: Ordered, states: Ordered
    ) -> bool:
        """Return whether reports jump by a turn where the joint does not, and note it."""
        whole, turns = unwrapped(known, self._kind)
        if not turns:
            return False
        return self._is_nearer(plain, reported(plain.text, whole, states.stamps_ns), turns, states)

    def _is_nearer(
        self, plain: ReferenceCandidate, whole: ReferenceCandidate, turns: int, states: Ordered
    ) -> bool:
        """Return whether the joint is nearer to a reference of all turns, and note it."""
        if not plain.known.any():
            return False
        of_turns, of_one = (
            np.abs(each.values - states.values)[plain.known]
            for each in (self._nearest(whole, states), plain)
        )
        if of_turns.sum() >= of_one.sum() or np.quantile(of_turns, _MOST) > _IN_TURN:
            return False
        self._recording.unwrap_reference(plain.topic, self._joint, turns, self._kind)
        return True

    def _nearest(self, found: ReferenceCandidate, states: Ordered) -> ReferenceCandidate:
        """Return a reference in the turn that is nearest to the joint."""
        arrays = (states.values, states.stamps_ns, found.known)
        return replace(found, values=in_nearest_turn(found.values, *arrays))

    def _compare_trajectories(self, events: Sequence[tuple[str, ReferenceEvent]]) -> None:
        """Note topics of trajectories that came after they were to begin.

        One that began before the first state may be latched.
        """
        if self._clock != "header" or self._selection.separates_runs:
            return
        first_ns = int(self._samples.stamps_ns[0])
        found: dict[str, list[tuple[int, int]]] = {}
        for text, event in events:
            topic = text.partition(" ")[2]
            if event.column.stamp_ns > first_ns and self._recording.compares(topic):
                found.setdefault(topic, []).append((event.column.stamp_ns, event.log_time_ns))
        for topic, times in found.items():
            self._recording.note_ahead(topic, "", -late_ns(times, self._samples))

    def _is_taken(self, event: ReferenceEvent, topic: str) -> bool:
        """Return whether controllers take a trajectory, by the stamps of the states.

        One that came with the first states may be latched: the controllers had it before, and
        the joint stands at its end.
        """
        window_ns = event.column.window_ns
        if window_ns is None:
            return True
        states = self._samples
        following = states.first_after(event.log_time_ns, event.place)
        before = max(following - 1, 0)
        reason = ""
        for now in (before, min(following, len(states.values) - 1)):
            try:
                require_timely("the first", window_ns, int(states.stamps_ns[now]), GRACE_NS)
            except TrajectoryError as error:
                reason = reason or str(error)
            else:
                return True
        since_ns = event.log_time_ns - int(states.log_times_ns[0])
        off = event.column.knots[-1].position - float(states.values[before])
        off = abs(math.remainder(off, math.tau) if self._turns else off)
        if since_ns <= LATCHED_WITHIN * NANOSECONDS and off <= _AT_END:
            return True
        self._recording.refuse(topic, event.place, reason)
        return False

    def _followed(
        self,
        trajectories: list[tuple[str, ReferenceEvent]],
        setpoints: tuple[str, JointSamples] | None,
        states: Ordered,
    ) -> ReferenceCandidate:
        """Return the reference that trajectories and setpoints make together."""
        logged, stamps_ns = self._samples, states.stamps_ns
        kinds = dict.fromkeys(kind for kind, _ in trajectories)
        events = [event for _, event in trajectories]
        count, values, turns = len(events), None, 0
        if setpoints is not None:
            kind, positions = setpoints
            kinds[kind] = None
            count += len(positions.values)
            turns = unwrapped(Ordered(positions.log_times_ns, positions.values), self._kind)[1]
            if not events:
                first = float(states.values[0])
                values = sample_setpoints(positions, logged, stamps_ns, first)
            events += setpoint_events(self._joint, positions)
            events.sort(key=lambda each: each[:2])
        # Where setpoints could be sampled at once, they take effect in the order of the log.
        taken = events if values is None else events[:1]
        begin = min(first_state(each, logged, stamps_ns) for each in taken)
        begin_ns = int(stamps_ns[begin]) if begin < len(stamps_ns) else None
        known = held_at_rest(states.values, begin)
        if values is None:
            first = self._position_before(begin, states) if not known[0] else states.values[0]
            values = sample_events(events, logged, stamps_ns, float(first))
            turns = turns or unwrapped(Ordered(stamps_ns, values), self._kind)[1]
        found = ReferenceCandidate(" and ".join(kinds), count, values, known, begin_ns=begin_ns)
        if turns and not self._turns:
            self._turns = self._is_nearer(found, found, turns, states)
        return self._turned(found, states)

    def _position_before(self, begin: int, states: Ordered) -> float:
        """Return where a joint that moved before its reference began was then, as its driver says.

        A driver that reports one turn alone has references of this turn, too.
        """
        if begin >= len(states.values):
            return float(states.values[0])
        at = np.flatnonzero(self._samples.stamps_ns == states.stamps_ns[begin])[-1]
        return float(self._samples.values[at])

    def _turned(self, found: ReferenceCandidate, states: Ordered) -> ReferenceCandidate:
        """Return a reference in the turn that is nearest to a joint which turns without end."""
        return self._nearest(found, states) if self._turns else found

    def _given(
        self, trajectory: JointTrajectory, window: Window
    ) -> list[tuple[str, ReferenceEvent]]:
        """Return a trajectory that was followed from the first state of any joint on."""
        if self._joint not in trajectory.joint_names:
            return []
        column = trajectory.column(self._joint)
        if window.origin_ns > 0:
            column = replace(column, stamp_ns=window.origin_ns)
        return [(GIVEN, ReferenceEvent(-_FOREVER_NS, -1, column))]

    def _setpoints(self) -> tuple[str, JointSamples] | None:
        """Return the setpoints of the joint with kind and topic; None if it has none."""
        topic = self._recording.choice.references.setpoint.get(self._joint, "")
        samples = self._recording.setpoints[topic].take(self._joint) if topic else None
        if samples is None:
            return None
        samples, _ = finite(samples)
        return (f"setpoint {topic}", samples) if len(samples.values) else None

    def _on_clock(self, log_time_ns: int, place: int, column: Column) -> ReferenceEvent:
        """Return a column with its start carried to the clock of the series."""
        header, states = self._header_ns, self._samples
        is_other = (
            self._clock != "header" or self._selection.separates_runs or bool(self._set_backs)
        )
        if is_other and column.stamp_ns:
            following = min(states.first_after(log_time_ns, place), len(header) - 1)
            start_ns = column.stamp_ns + int(states.stamps_ns[following] - header[following])
            if not header.any() or start_ns <= 0:
                start_ns = 0  # the states' headers do not say when it began
            column = replace(column, stamp_ns=start_ns)
        return ReferenceEvent(log_time_ns, place, column)


_SHOWN_JOINTS = 3
_SHOWN_OTHERS = 10
_READING = 0.5  # share of the work that is reading the files, about


def read_run(
    path: Path | str | Storage,
    label: str,
    *,
    joints: Sequence[str] | None = None,
    selection: BagSelection | None = None,
    progress: Progress | None = None,
) -> RunSeries:
    """Read one run from a bag.

    States and commands are ordered by their stamps; of several with one stamp the last stands.
    A command answers the state whose stamp it carries. Messages that carry no position (state)
    or no effort (command) for a joint do not concern it, and numbers that are not finite are left
    out. Where nothing carries efforts but the states, these measured ones are taken; a joint for
    which there are none, or no reference, has none (see :class:`JointSeries`). What could not be
    read, and what is missing, is in the result's ``quality``.

    Args:
        path: A bag folder, with ``metadata.yaml`` or without, or one ``.mcap`` or ``.db3`` file;
            or a bag that is open.
        label: Name of the run in tables and figures.
        joints: The joints to read, before those of the selection.
        selection: Topics, joints, references, clock and window; all found by name and type if
            not given.
        progress: Takes the share of the work that is done, in [0, 1].

    Raises:
        BagError: If nothing of the bag can be read, or it lacks a topic or a joint that was
            asked for, or any state, or a trajectory in it cannot be decoded.
        SettingError: The joints are no joints.
    """
    chosen = selection or BagSelection()
    told = progress or no_progress
    if joints is not None:
        chosen = replace(chosen, joints=joints)
    with opened(path) as storage:
        where = f"bag {storage.path}"
        try:
            recording = _recording(storage, where, chosen, lambda share: told(_READING * share))
        except BagError as error:
            if not storage.unreadable:
                raise
            # What is missing may be in what could not be read.
            raise BagError(f"{error} ({'; '.join(storage.unreadable)})") from error
        quality = RecordingQuality(
            source=str(storage.path if isinstance(path, Storage) else path),
            unreadable=(*storage.unreadable, *_undecodable(where, recording)),
            missed=missed_messages(storage.custom_data),
            stood_still=time_stood_still(storage.custom_data),
        )
    joints = _joints(where, recording, chosen)
    chosen = replace(chosen, clock=recording.resolve_clock(chosen.clock))
    try:
        return _run(
            *(label, recording, joints, chosen, quality),
            lambda share: told(_READING + (1.0 - _READING) * share),
        )
    except SeriesError as error:
        raise BagError(f"{where}: {error}") from error


def _recording(
    storage: Storage, where: str, selection: BagSelection, progress: Progress
) -> RecordedRun:
    """Read the messages that are asked for."""
    topics = storage.topics()
    types = {name: info.type for name, info in topics.items()}
    is_open = selection.joints is None or selection.every
    joints = None if is_open else NamePatterns(selection.joints or ())

    def collected(choice: TopicChoice) -> RecordedRun:
        recording = RecordedRun(choice, types, joints)
        try:
            for batch in storage.batches(choice.all, progress):
                recording.add(batch)
        except BagError as error:
            raise BagError(f"{where}: {error}") from error
        return recording

    choice = choose_topics(where, types, selection)
    for topic in sorted(choice.all):
        encoding = topics[topic].encoding
        if encoding != "cdr":
            raise BagError(
                f"{where}: messages on {topic} are {encoding or 'of no encoding'}, but must be cdr"
            )
    recording = collected(choice)
    commanded, numberless = recording.commanded()
    if choice.may_be_measured and (not commanded or numberless):
        before = list(recording.odd_lines())
        recording = collected(choice.measured({*numberless} if commanded else None))
        recording.notes += [line for line in before if line not in recording.odd_lines()]
        for joint, without in () if commanded else numberless.items():
            recording.note_no_numbers(joint, without, MEASURED)
    _require_messages(where, recording)
    recording.resolve_senders(selection.sender)
    if choice.other_states:
        unreadable = len(storage.unreadable)  # what cannot be read was said
        read, *others = (
            glimpse(topic, storage.batches(frozenset({topic})))
            for topic in (*choice.states, *choice.other_states)
        )
        del storage.unreadable[unreadable:]
        recording.note_other_states(read, others)
    if choice.others:
        recording.notes.append(
            f"{', '.join(choice.others)}: not read, as another robot's, whose states are beside "
            "them; --commands TOPIC takes them"
        )
    if choice.in_doubt and not (selection.commands or selection.command_topics):
        recording.notes.append(
            f"{', '.join(choice.in_doubt)}: efforts, positions or velocities, their types do not "
            "say which: not read; --commands effort takes them for efforts"
        )
    if choice.goals and not (choice.references.controller_state or choice.references.trajectories):
        recording.notes.append(
            f"{', '.join(choice.goals)}: goals of an action, or its feedback: not read; record "
            "controller_state, or give the motion (--reference FILE)"
        )
    if choice.nameless and not choice.references.controller_state:
        recording.notes.append(
            f"{', '.join(choice.nameless)}: errors and outputs of a PID, which name no joint: not "
            f"read; record what names them ({' or '.join(REPORTS)})"
        )
    return recording


def _require_messages(where: str, recording: RecordedRun) -> None:
    """Raise BagError if there are no states, or no commands though they were asked for."""
    counts = {topic: stream.message_count for topic, stream in recording.streams()}
    counts |= dict.fromkeys(recording.choice.references.trajectories, 0)
    for _, _, topic, _ in recording.trajectories:
        counts[topic] += 1
    choice = recording.choice
    missing = [topic for topic in choice.states if not counts[topic]]
    commands = (*choice.commands, *(each.topic for each in choice.command_topics.values()))
    if not choice.is_measured and commands and not any(counts[topic] for topic in commands):
        missing.append(commands[0])
    if missing:
        listed = ", ".join(f"{name} {counts[name]}" for name in sorted(counts))
        raise BagError(f"{where}: no message on {missing[0]}; messages: {listed}")


def _undecodable(where: str, recording: RecordedRun) -> list[str]:
    """Return a line for each topic with messages that are not of its type."""
    lines = []
    for topic, stream in recording.streams():
        if stream.undecodable == stream.message_count > 0:
            raise BagError(f"{where}: {stream.first_failure}")
        if stream.undecodable:
            count = stream.undecodable
            lines.append(f"{count} messages on {topic} are left out: {stream.first_failure}")
    odd = dict.fromkeys(recording.odd_lines())
    if odd and not any(stream.joints() for stream in recording.states.values()):
        raise BagError(f"{where}: no state of a joint can be read: {'; '.join(odd)}")
    return [*dict.fromkeys(lines), *odd]


def _joints(where: str, recording: RecordedRun, selection: BagSelection) -> Sequence[str]:
    """Return the joints to read, all of which the states name."""
    known, concerned = recording.known_joints(), recording.concerned_joints()
    joints = [name for name in known if name in concerned]
    if not joints and (not concerned or selection.reference == HOLD):
        joints = known
    commanded = {name for each in recording.floats.values() for name in each.joints()}
    for name in sorted(commanded - {*known}) if known else ():
        topic = recording.choice.command_topics[name].topic
        recording.notes.append(
            f"{topic}: {name!r}, after which it is called, is no joint of the states: its efforts "
            "are not read (--command-topic JOINT=TOPIC[INDEX] says whose they are)"
        )
    if selection.joints is None and (others := [name for name in known if name not in joints]):
        recording.notes.append(
            f"left out, as nothing commands them and nothing is their reference: "
            f"{listed_names(others, _SHOWN_OTHERS)} (--joint names joints to read)"
        )
    if selection.joints is not None and known:
        try:
            return NamePatterns(selection.joints).chosen("joint", known, BagError, joints)
        except BagError as error:
            raise BagError(f"{where}: {error}") from None
    if not joints:
        choice = recording.choice
        commands = sorted({*choice.commands, *(c.topic for c in choice.command_topics.values())})
        raise BagError(
            f"{where}: no joint of {', '.join(choice.states)} is commanded on "
            f"{', '.join(commands) or 'any topic'} or has a reference; joints: "
            f"{', '.join(known)} (--command-topic JOINT=TOPIC[INDEX] says whose efforts are where)"
        )
    return joints


def _run(
    label: str,
    recording: RecordedRun,
    joints: Sequence[str],
    selection: BagSelection,
    quality: RecordingQuality,
    progress: Progress,
) -> RunSeries:
    """Return the series of all joints within the window."""
    spill, runs, failures = Spill(), dict[str, JointRun](), list[NoNumberError]()
    for number, joint in enumerate(joints):
        progress(0.5 * number / len(joints))
        try:
            runs[joint] = JointRun(recording, joint, selection)
        except NoNumberError as error:
            if selection.joints is not None:
                raise
            failures.append(error)
            recording.notes.append(f"joint {joint!r} is left out: no position of it is a number")
            continue
        runs[joint].set_aside(spill)
    if not runs:
        raise failures[0]
    joints = [*runs]
    origin_ns = min(int(run.states.stamps_ns[0]) for run in runs.values())
    start, end = selection.start, selection.end
    window = Window(
        origin_ns,
        -_FOREVER_NS if start is None else origin_ns + round(start * NANOSECONDS),
        _FOREVER_NS if end is None else origin_ns + round(end * NANOSECONDS),
    )
    series, losses, qualities = KeptJoints(spill), {}, {}
    for number, joint in enumerate(joints):
        progress(0.5 + 0.5 * number / len(joints))
        found = runs.pop(joint).series(window)
        if found is not None:
            one, losses[joint], qualities[joint] = found
            series.append(one)
        elif selection.joints is None:
            recording.notes.append(f"joint {joint!r} is left out: it has no state in the window")
        else:
            raise SeriesError(f"joint {joint!r}: no state in the window")
    if not series:
        raise SeriesError(f"no joint has a state from {start} s to {end} s")
    asked = frozenset(joints)
    for joint in recording.known_joints() if selection.every else ():
        with suppress(SeriesError):  # nobody asked for it
            if joint not in asked and (
                found := JointRun(recording, joint, selection).series(window)
            ):
                one, losses[joint], qualities[joint] = found
                series.append(one)
    recording.notes.extend(recording.clock_lines())
    recording.notes.extend(
        (*recording.turn_lines(), *recording.reference_lines(), *recording.effort_lines())
    )
    recording.notes.extend(_other_speeds(recording.choice.speed_scalings, qualities))
    recording.notes.extend(_foreign_clocks(qualities))
    progress(1.0)
    is_window = start is not None or end is not None
    streams = [each for found in qualities.values() for each in (found.states, found.commands)]
    if is_window and any(x.repeated or x.out_of_order or x.not_finite for x in streams):
        recording.notes.append(
            "what is repeated, out of order or not finite is counted in the whole recording, not "
            "in the window alone"
        )
    quality = replace(quality, joints=qualities, notes=tuple(recording.notes))
    return RunSeries(label, series.at_once() or series, losses, quality=quality)


def _other_speeds(topics: Sequence[str], qualities: Mapping[str, DataQuality]) -> Iterator[str]:
    """Yield one line if trajectories are references, and may have been followed more slowly."""
    joints = [
        name
        for name, each in qualities.items()
        if each.reference == GIVEN or each.reference.startswith("trajectory ")
    ]
    if topics and joints:
        yield (
            f"the trajectory of {listed_names(joints, _SHOWN_JOINTS)} may have been followed at "
            f"another speed: {' and '.join(topics)} is not read (a controller_state says what was "
            "followed)"
        )


def _foreign_clocks(qualities: Mapping[str, DataQuality]) -> Iterator[str]:
    """Yield one line if commands have no time in common with the states."""
    joints = [name for name, each in qualities.items() if not each.has_common_time]
    if not joints:
        return
    first = qualities[joints[0]]
    shown = ", ".join(joints[:_SHOWN_JOINTS])
    more = len(joints) - _SHOWN_JOINTS
    yield (
        f"states and commands of {shown}{f' and {more} more' if more > 0 else ''} are on clocks "
        f"that do not overlap: {_span_of(first.states)} and {_span_of(first.commands)} after the "
        "first state; the energy is not computed (--clock receive gives both one clock)"
    )


def _span_of(stamps: StampQuality) -> str:
    return f"{stamps.begin:.3f} s to {stamps.end:.3f} s"

"""What one joint was to follow, at its states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control.reference import GRACE_NS, LATCHED_WITHIN, require_timely
from hpid_ros.messages.columns import Integers, JointSamples, Ordered, finite, ordered
from hpid_ros.messages.quality import GIVEN, HOLD
from hpid_ros.messages.reading.clocks import late_ns
from hpid_ros.messages.reading.decisions import FOREIGN, UNLIKE
from hpid_ros.messages.reading.feedback import feedback_away
from hpid_ros.messages.reading.recorded_run import RecordedRun
from hpid_ros.messages.reading.references import (
    MOMENT_NS,
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
from hpid_ros.messages.reading.states_clock import StatesClock
from hpid_ros.messages.reading.turns import CONTINUOUS, PRISMATIC, in_nearest_turn, unwrapped
from hpid_ros.messages.selection import BagSelection
from hpid_ros.motion.joint_trajectory import JointTrajectory

FOREVER_NS = 2**63 - 1
_MOST, _IN_TURN = 0.9, math.pi / 2.0  # [rad] for most of the time, a joint is so near its turn
_AT_END = 0.05  # [rad] a joint that is no farther from the end of a trajectory has followed it


class JointReference:
    """What a joint was to follow; taking it frees the recording's columns."""

    def __init__(
        self,
        recording: RecordedRun,
        joint: str,
        selection: BagSelection,
        clock: StatesClock,
        *,
        has_turns: bool,
    ) -> None:
        self._recording, self._joint, self._selection = recording, joint, selection
        self._clock, self._kind = clock, selection.kinds.get(joint)
        self._turns = has_turns  # whether errors are taken to the nearest turn

    def at(self, states: Ordered, origin_ns: int) -> ReferenceCandidate | None:
        """Return the reference at the states; None without one.

        What controllers report of a joint counts, and what they were asked where none reports.
        """
        asked = self._selection.reference
        if asked == HOLD:
            held, known = (np.full(len(states.values), each) for each in (states.values[0], True))
            return ReferenceCandidate(HOLD, 0, held, known)
        if isinstance(asked, JointTrajectory):
            given = self._given(asked, origin_ns)
            return self._followed(given, None, states) if given else None
        reports, sampled = self._reports(states)
        wanted = self._asked(states)
        if not reports:
            return wanted
        found, disagreements = together(reports, states.values, states.stamps_ns)
        for each in disagreements:
            self._recording.decisions.disagree(self._joint, each)
        if wanted is not None:
            differ = apart(found, wanted)
            if lasts(differ, states.stamps_ns, MOMENT_NS):
                self._recording.decisions.overrule(self._joint, found, wanted, differ)
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
            samples, not_finite = finite(self._clock.stamped(topic, taken))
            if not len(samples.values):
                continue
            if not self._is_of_position(topic, states):
                continue
            is_sampled = topic in self._recording.choice.references.sampled
            text = f"{'sampled' if is_sampled else 'controller_state'} {topic}"
            self._clock.compare(topic, samples)
            times, is_stamped = self._clock.report_times(samples)
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

    def _is_of_position(self, topic: str, states: Ordered) -> bool:
        """Return whether what a report is about is the joint's position, by its feedback."""
        taken = self._recording.take_feedback(topic, self._joint)
        if taken is None:
            return True
        samples, not_finite = finite(self._clock.stamped(topic, taken))
        if not len(samples.values):
            return True
        feedback = ordered(self._clock.report_times(samples)[0], samples.values, not_finite)
        away = feedback_away(feedback, states, turns=self._kind != PRISMATIC)
        if away is None:
            return True
        if self._recording.may_be_foreign(topic) and away.exceeds(*FOREIGN):
            self._recording.decisions.be_foreign(topic, self._joint)
            return False
        if samples.values.any() and away.exceeds(*UNLIKE):  # some leave the field at zero
            self._recording.decisions.differ(topic, self._joint, away.largest)
        return True

    def _asked(self, states: Ordered) -> ReferenceCandidate | None:
        """Return what trajectories and setpoints ask of the joint; None without any."""
        events = [
            (f"trajectory {topic}", event)
            for log_time_ns, place, topic, column in self._recording.trajectories_of(self._joint)
            if self._is_taken(event := self._clock.event(log_time_ns, place, column), topic)
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
                self._recording.decisions.disagree(self._joint, each)
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
        self._recording.decisions.unwrap_reference(plain.topic, self._joint, turns, self._kind)
        return True

    def _nearest(self, found: ReferenceCandidate, states: Ordered) -> ReferenceCandidate:
        """Return a reference in the turn that is nearest to the joint."""
        arrays = (states.values, states.stamps_ns, found.known)
        return replace(found, values=in_nearest_turn(found.values, *arrays))

    def _compare_trajectories(self, events: Sequence[tuple[str, ReferenceEvent]]) -> None:
        """Note topics of trajectories that came after they were to begin.

        One that began before the first state may be latched.
        """
        if self._clock.name != "header" or self._selection.separates_runs:
            return
        first_ns = int(self._clock.states.stamps_ns[0])
        found: dict[str, list[tuple[int, int]]] = {}
        for text, event in events:
            topic = text.partition(" ")[2]
            if event.column.stamp_ns > first_ns and self._recording.decisions.compares(topic):
                found.setdefault(topic, []).append((event.column.stamp_ns, event.log_time_ns))
        for topic, times in found.items():
            self._recording.decisions.note_ahead(topic, "", -late_ns(times, self._clock.states))

    def _is_taken(self, event: ReferenceEvent, topic: str) -> bool:
        """Return whether controllers take a trajectory, by the stamps of the states.

        One that came with the first states may be latched: the controllers had it before, and
        the joint stands at its end.
        """
        window_ns = event.column.window_ns
        if window_ns is None:
            return True
        states = self._clock.states
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
        self._recording.decisions.refuse(topic, event.place, reason)
        return False

    def _followed(
        self,
        trajectories: list[tuple[str, ReferenceEvent]],
        setpoints: tuple[str, JointSamples] | None,
        states: Ordered,
    ) -> ReferenceCandidate:
        """Return the reference that trajectories and setpoints make together."""
        logged, stamps_ns = self._clock.states, states.stamps_ns
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
        at = np.flatnonzero(self._clock.states.stamps_ns == states.stamps_ns[begin])[-1]
        return float(self._clock.states.values[at])

    def _turned(self, found: ReferenceCandidate, states: Ordered) -> ReferenceCandidate:
        """Return a reference in the turn that is nearest to a joint which turns without end."""
        return self._nearest(found, states) if self._turns else found

    def _given(
        self, trajectory: JointTrajectory, origin_ns: int
    ) -> list[tuple[str, ReferenceEvent]]:
        """Return a trajectory that was followed from the first state of any joint on."""
        if self._joint not in trajectory.joint_names:
            return []
        column = trajectory.column(self._joint)
        if origin_ns > 0:
            column = replace(column, stamp_ns=origin_ns)
        return [(GIVEN, ReferenceEvent(-FOREVER_NS, -1, column))]

    def _setpoints(self) -> tuple[str, JointSamples] | None:
        """Return the setpoints of the joint with kind and topic; None if it has none."""
        topic = self._recording.choice.references.setpoint.get(self._joint, "")
        samples = self._recording.setpoints[topic].take(self._joint) if topic else None
        if samples is None:
            return None
        samples, _ = finite(samples)
        return (f"setpoint {topic}", samples) if len(samples.values) else None

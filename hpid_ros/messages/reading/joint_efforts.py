"""The efforts of one joint: commanded on one or several topics, or measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from hpid_ros.messages.columns import JointSamples, JointStream, Ordered, carried, finite, ordered
from hpid_ros.messages.quality import MEASURED, NO_EFFORT
from hpid_ros.messages.reading.efforts import EffortCandidate, in_turn
from hpid_ros.messages.reading.recorded_run import RecordedRun
from hpid_ros.messages.reading.states_clock import StatesClock
from hpid_ros.messages.selection import BagSelection

NO_EFFORTS = Ordered(np.empty(0, dtype=np.int64), np.empty(0))


class JointEfforts:
    """The efforts of one joint; taking them frees the recording's columns."""

    def __init__(
        self, recording: RecordedRun, joint: str, selection: BagSelection, clock: StatesClock
    ) -> None:
        self._recording, self._joint, self._selection = recording, joint, selection
        self._clock = clock
        self.reason = NO_EFFORT
        """Why there are none, where there are none."""

    def take(self) -> tuple[Ordered, str, str]:
        """Return the commands in the order of their stamps, whose clock these are, their topic."""
        choice = self._recording.choice
        if not choice.has_commands:
            self.reason = "no efforts were read, as asked for"
        elif self._joint in self._recording.efforts_elsewhere:
            topic = self._recording.efforts_elsewhere[self._joint]
            self.reason = f"no effort is where it was read, but {topic} has some (--states)"
        elif choice.in_doubt:
            self.reason += f" as such ({', '.join(choice.in_doubt)} may carry them)"
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
                topic,
                found,
                not_finite,
                is_stamped and not (len(taken) > 1 and self._clock.is_another(found)),
            )
            for topic, found, not_finite, is_stamped in taken
        ]
        if len(candidates) > 1:
            candidate, contradictions = in_turn(candidates)
            for each in contradictions:
                self._recording.decisions.contradict(self._joint, each)
        elif candidates:
            (candidate,) = candidates
        else:
            if without_numbers:
                topics = " and ".join(without_numbers)
                self.reason = f"the efforts on {topics} are not a number throughout"
            measured = self._measured(self._recording.measured)
            if without_numbers:
                self._recording.decisions.note_no_numbers(
                    self._joint, without_numbers, measured[2]
                )
            return measured
        if without_numbers:
            topics = " and ".join(candidate.topics)
            self._recording.decisions.note_no_numbers(self._joint, without_numbers, topics)
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
                samples = self._clock.stamped(topic, samples)
                yield topic, samples, not self._clock.is_unstamped(samples)

    def _candidate(
        self, topic: str, samples: JointSamples, not_finite: int, is_stamped: bool
    ) -> EffortCandidate:
        times, clock = samples.log_times_ns, "receive"
        if is_stamped:
            self._clock.compare(topic, samples)
            times, clock = self._clock.times(samples), self._clock.name
        elif self._clock.name == "header":
            states = self._clock.states
            times = carried(times, states.log_times_ns, states.stamps_ns)
        return EffortCandidate(ordered(times, samples.values, not_finite), clock, (topic,))

    def _measured(self, streams: Mapping[str, JointStream]) -> tuple[Ordered, str, str]:
        """Return measured efforts; none where the driver fills the field without measuring."""
        for topic, stream in streams.items():
            taken = stream.take(self._joint)
            if taken is None:
                continue
            samples, not_finite = finite(self._clock.stamped(topic, taken))
            is_asked_for = self._selection.commands is not None
            if not len(samples.values) or not (is_asked_for or samples.values.any()):
                state = "not a number" if not len(samples.values) else "zero"
                states = " and ".join(self._recording.choice.states)
                self.reason = f"the efforts that {states} measured are {state} throughout"
                break
            found = ordered(self._clock.times(samples), samples.values, not_finite)
            return found, self._clock.name, f"{MEASURED}, of {topic}"
        return NO_EFFORTS, self._clock.name, ""

"""The clock of a joint's states, and the times of other topics on it."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.columns import Integers, JointSamples, carried
from hpid_ros.messages.reading.clocks import (
    RESET_NS,
    STRAYS,
    SetBack,
    ahead_ns,
    set_backs,
    set_right,
    states_set_right,
    unstamped,
)
from hpid_ros.messages.reading.recorded_run import RecordedRun
from hpid_ros.messages.reading.references import ReferenceEvent
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import SeriesError
from hpid_ros.motion.joint_trajectory import Column


def overlap(one: Integers, other: Integers) -> bool:
    """Return whether two ranges of times have something in common."""
    return bool(one.min() <= other.max() and other.min() <= one.max())


_RUN_SPACING_NS = 1_000_000_000_000_000
"""Added to the stamps of each run after another one: longer than any run."""


def without_unstamped(
    recording: RecordedRun, clock: str, topic: str, samples: JointSamples
) -> JointSamples:
    """Return the samples without those that alone have no stamp."""
    without = unstamped(samples.stamps_ns) if clock == "header" else None
    if without is None:
        return samples
    recording.decisions.note_unstamped(topic, int(np.count_nonzero(without)))
    return samples.picked(~without)


class StatesClock:
    """The clock of a joint's states, to which the times of its other topics are carried."""

    def __init__(
        self, recording: RecordedRun, selection: BagSelection, topic: str, samples: JointSamples
    ) -> None:
        self.name = selection.clock
        self._recording, self._selection, self._topic = recording, selection, topic
        self._header_ns = samples.stamps_ns
        self._begun_ns: Integers | None = None  # when runs but the first began, by their states
        self._set_backs: list[SetBack] = set_backs(samples) if self.name == "header" else []
        times = self._separated(samples, self._state_times(samples))
        self.states = samples._replace(stamps_ns=times)
        """The states as they were recorded, their times on this clock."""

    def _state_times(self, samples: JointSamples) -> Integers:
        """Return the states' times on the chosen clock, as if it had never been set back."""
        if self.name != "header":
            return samples.log_times_ns
        if not self._set_backs:
            return samples.stamps_ns
        times = states_set_right(samples, self._set_backs)
        for each in self._set_backs:
            at = (int(times[each.at]) - int(times[0])) / NANOSECONDS
            self._recording.decisions.note_set_back(self._topic, at, each.by_ns / NANOSECONDS)
        return times

    def require_one_run(self, joint: str) -> None:
        """Refuse runs on a clock that began again: they would be laid over each other."""
        stamps_ns = self.states.stamps_ns
        behind = np.maximum.accumulate(stamps_ns) - stamps_ns
        if np.count_nonzero(behind >= RESET_NS) > STRAYS:
            raise SeriesError(
                f"joint {joint!r}: the clock of its states went back by "
                f"{behind.max() / NANOSECONDS:.3g} s, or two senders have clocks of their own; "
                f"read them with clock 'receive' (--clock receive)"
            )

    def stamped(self, topic: str, samples: JointSamples) -> JointSamples:
        """Return samples of a topic without those that alone have no stamp."""
        return without_unstamped(self._recording, self.name, topic, samples)

    def times(self, samples: JointSamples) -> Integers:
        """Return times of another topic on the chosen clock, as those of the states."""
        times = samples.stamps_ns if self.name == "header" else samples.log_times_ns
        if self._set_backs and len(times):
            times = set_right(samples, self._set_backs, self._states_set_right)
        return self._separated(samples, times)

    def report_times(self, samples: JointSamples) -> tuple[Integers, bool]:
        """Return when a controller reported on the clock of the states, and if its stamps say."""
        if self.is_unstamped(samples) or self.is_another(samples):
            mine = self.states
            return carried(samples.log_times_ns, mine.log_times_ns, mine.stamps_ns), False
        return self.times(samples), True

    def is_unstamped(self, samples: JointSamples) -> bool:
        """Tell whether messages that should have stamps have none."""
        is_stamped = self.name == "header" and len(samples.values) > 1
        return is_stamped and not samples.stamps_ns.any()

    def is_another(self, samples: JointSamples) -> bool:
        """Tell whether messages were received beside the states, and stamped at another time."""
        mine = self.states
        return (
            self.name == "header"
            and not overlap(samples.stamps_ns, mine.stamps_ns)
            and overlap(samples.log_times_ns, mine.log_times_ns)
        )

    def compare(self, topic: str, samples: JointSamples) -> None:
        """Note a topic whose stamps are of another clock than the states', or late."""
        if self.name == "header" and self._recording.decisions.compares(topic):
            states = self.states._replace(stamps_ns=self._header_ns)
            if overlap(samples.stamps_ns, states.stamps_ns):
                self._recording.decisions.note_ahead(topic, self._topic, ahead_ns(samples, states))

    def event(self, log_time_ns: int, place: int, column: Column) -> ReferenceEvent:
        """Return a column with its start carried to the clock of the series."""
        header, states = self._header_ns, self.states
        is_other = self.name != "header" or self._selection.separates_runs or bool(self._set_backs)
        if is_other and column.stamp_ns:
            following = min(states.first_after(log_time_ns, place), len(header) - 1)
            start_ns = column.stamp_ns + int(states.stamps_ns[following] - header[following])
            if not header.any() or start_ns <= 0:
                start_ns = 0  # the states' headers do not say when it began
            column = replace(column, stamp_ns=start_ns)
        return ReferenceEvent(log_time_ns, place, column)

    @cached_property
    def _states_set_right(self) -> JointSamples:
        """The states with stamps set right, in runs that are not separated."""
        states = self.states._replace(stamps_ns=self._header_ns)
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

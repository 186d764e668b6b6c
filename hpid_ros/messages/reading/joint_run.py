"""One joint of a recording, from its messages to its series."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.columns import LARGEST_NUMBER, Integers, Ordered, finite, ordered
from hpid_ros.messages.quality import NONE, DataQuality
from hpid_ros.messages.reading.joint_efforts import NO_EFFORTS, JointEfforts
from hpid_ros.messages.reading.joint_reference import JointReference
from hpid_ros.messages.reading.recorded_run import RecordedRun
from hpid_ros.messages.reading.references import Flags, ReferenceCandidate
from hpid_ros.messages.reading.states_clock import StatesClock, without_unstamped
from hpid_ros.messages.reading.turns import CONTINUOUS, unwrapped
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import JointSeries, Losses, SeriesError, stretches
from hpid_ros.messages.spill import Kept, Spill

_NO_EFFORT_WITHIN = "no effort lies within the time that is read, or efforts are on another clock"


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
        self._topic = recording.topic_of_states(joint)
        taken = recording.take_states(joint)
        if taken is None:
            raise SeriesError(f"joint {joint!r}: no state carries its position")
        stamped = without_unstamped(recording, selection.clock, self._topic, taken)
        samples, not_finite = finite(stamped)
        if not len(samples.values):
            raise NoNumberError(
                f"joint {joint!r}: position must be finite and below {LARGEST_NUMBER:g}, but no "
                "state's is"
            )
        self._aside: tuple[Spill, Kept, Kept] | None = None
        self._clock = clock = StatesClock(recording, selection, self._topic, samples)
        if not selection.separates_runs:
            clock.require_one_run(joint)
        states = ordered(clock.states.stamps_ns, samples.values, not_finite)
        kind = selection.kinds.get(joint)
        self.states, turns = unwrapped(states, kind)
        self._has_turns = turns > 0 or kind == CONTINUOUS
        if turns and kind != CONTINUOUS:
            recording.decisions.unwrap(joint, turns, kind)
        if clock.name == "header" and len(samples.values) > 1 and not self.states.stamps_ns.any():
            raise SeriesError(
                f"joint {joint!r}: its states carry no stamps; read them with clock 'receive' "
                "(--clock receive)"
            )

    def set_aside(self, spill: Spill) -> None:
        """Keep the numbers where they need no memory until the series is asked for."""
        samples, states = self._clock.states.values, self.states.values
        kept = spill.keep(samples)
        self._aside = spill, kept, kept if states is samples else spill.keep(states)
        self._clock.states = self._clock.states._replace(values=NO_EFFORTS.values)
        self.states = self.states._replace(values=NO_EFFORTS.values)

    def _take_up(self) -> None:
        if self._aside is not None:
            spill, kept, of_states = self._aside
            samples = spill.array(kept)
            states = samples if of_states is kept else spill.array(of_states)
            self._clock.states = self._clock.states._replace(values=samples)
            self.states = self.states._replace(values=states)
            self._aside = None

    def series(self, window: Window) -> tuple[JointSeries, Losses, DataQuality] | None:
        """Return the series, losses and quality within a window; None without a state in it."""
        self._take_up()
        whole = self.states
        states = whole.within(window.first_ns, window.last_ns)
        if not len(states.stamps_ns):
            return None
        parts = (self._recording, self._joint, self._selection, self._clock)
        reference_of = JointReference(*parts, has_turns=self._has_turns)
        found = reference_of.at(whole, window.origin_ns)
        efforts = JointEfforts(*parts)
        commands, command_clock, effort = efforts.take()
        no_effort = _NO_EFFORT_WITHIN if len(commands.stamps_ns) else efforts.reason
        commands = commands.within(window.first_ns, window.last_ns)
        if np.array_equal(commands.stamps_ns, states.stamps_ns):
            commands = commands._replace(stamps_ns=states.stamps_ns)
        losses, answers = self._losses(states, commands, command_clock, effort)
        reference, known = _of_window(found, whole.stamps_ns, states.stamps_ns)
        velocity = self._velocity(window)
        for array in (*states[:2], *commands[:2], reference):
            array.setflags(write=False)
        is_known = None if not len(reference) or known.all() else known
        series = JointSeries(
            self._joint, *states[:2], reference, *commands[:2], known=is_known, velocity=velocity
        )
        begin = None if found is None else found.begin_ns
        quality = DataQuality(
            states=self._recording.quality(states, window.origin_ns),
            commands=self._recording.quality(commands, window.origin_ns),
            state_clock=self._clock.name,
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

    def _velocity(self, window: Window) -> Numbers | None:
        """Return the velocity that each state reports, NaN for none; None where none are read."""
        stream = self._recording.velocities.get(self._topic)
        if stream is None:
            return None
        of_states = self._clock.states
        values = np.full(len(of_states.places), np.nan)
        taken = stream.take(self._joint)
        if taken is not None:
            order = np.argsort(taken.places)
            places = taken.places[order]
            at = np.minimum(np.searchsorted(places, of_states.places), len(places) - 1)
            is_known = places[at] == of_states.places
            values[is_known] = taken.values[order[at[is_known]]]
        velocity = ordered(of_states.stamps_ns, values, 0)
        found = velocity.within(window.first_ns, window.last_ns).values
        found.setflags(write=False)
        return found

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

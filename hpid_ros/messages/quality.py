"""How complete a recording is, and what its series were made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

HOLD = "hold"
"""As a reference: the joint's first position, because it was asked for."""
GIVEN = "given"
"""As a reference: a trajectory that is not in the recording."""
MEASURED = "measured"
"""First word of the source of efforts that nobody commanded."""
NONE = "none"
"""There is no reference, or there are no efforts."""
HELD = "the first position, held as asked for"
NO_REFERENCE = "no reference was recorded"
NO_EFFORT = "no effort was recorded"


@dataclass(frozen=True)
class StampQuality:
    """One stream of samples of one joint, its states or its commands.

    The period is the median time between two stamps. An interval longer than 1.5 periods is a
    gap. Repeats and samples that are out of order are counted in the order of the recording.
    """

    count: int = 0  # samples that are used
    period: float = 0.0  # [s] median time between two of them; zero for fewer than two
    begin: float = 0.0  # [s] first stamp, in seconds since the first state of any joint
    end: float = 0.0  # [s] last stamp, likewise
    gaps: int = 0  # intervals longer than 1.5 periods
    lost: int = 0  # samples that would fill the gaps, no more than the whole time has room for
    longest_gap: float = 0.0  # [s] the longest; zero if there is none
    # [s] when it begins, in seconds since the first state of any joint
    longest_gap_at: float = 0.0
    repeated: int = 0  # samples whose stamp was there already; of several the last stands
    out_of_order: int = 0  # samples with an earlier stamp than the sample recorded before
    # samples that were left out, their number being NaN, infinite or beyond 1e50
    not_finite: int = 0


@dataclass(frozen=True)
class DataQuality:
    """What one joint's series was made of."""

    states: StampQuality = field(default_factory=StampQuality)
    commands: StampQuality = field(default_factory=StampQuality)
    state_clock: str = "header"  # "header" or "receive": whose time the states have
    command_clock: str = "header"  # likewise of the commands
    answers_states: bool = True
    # kind and topic of the reference, for instance "trajectory /joint_trajectory"
    reference: str = NONE
    references: int = 0  # number of reference messages that concern the joint
    # [s] when the joint came under its reference, in seconds since the first state of any joint
    reference_from: float | None = None
    # [s] first and last state of each stretch with a reference, since the first state of any joint
    reference_spans: tuple[tuple[float, ...], ...] = ()
    effort: str = NONE  # topic of the efforts, "measured" and the topic of the states, or "none"
    no_effort: str = ""  # why there is none; empty if there is

    @property
    def has_common_time(self) -> bool:
        """Whether states and commands, if there are both, share some time."""
        states, commands = self.states, self.commands
        if not (states.count and commands.count):
            return True
        return states.begin <= commands.end and commands.begin <= states.end

    @property
    def without_reference(self) -> float:
        """Share of the states' time for which there is no reference, of a joint that has one."""
        time = self.states.end - self.states.begin
        if not self.reference_spans or time <= 0.0:
            return 0.0
        return 1.0 - sum(end - begin for begin, end in self.reference_spans) / time

    @property
    def held_before(self) -> float:
        """Time before the first trajectory or setpoint in which the first position counts."""
        if self.reference_from is None or not self.reference_spans:
            return 0.0
        return max(self.reference_from - self.reference_spans[0][0], 0.0)

    @property
    def uncovered(self) -> float:
        """Share of the states' time before the first and after the last command."""
        states, commands = self.states, self.commands
        if not (states.end > states.begin and commands.count and self.has_common_time):
            return 0.0
        late = max(commands.begin - states.begin, 0.0) + max(states.end - commands.end, 0.0)
        return late / (states.end - states.begin)


@dataclass(frozen=True)
class RecordingQuality:
    """What a whole recording was made of."""

    source: str = ""  # path of the bag
    joints: Mapping[str, DataQuality] = field(default_factory=dict)
    unreadable: tuple[str, ...] = ()  # one line for each part of the files that could not be read
    notes: tuple[str, ...] = ()  # one line for each thing that was assumed or left out on purpose
    missed: Mapping[str, int] = field(default_factory=dict)
    stood_still: float = 0.0  # [s] how long the recorder itself stood still

    @property
    def missing_lines(self) -> tuple[str, ...]:
        """One line for each thing that is known to be missing."""
        missed = [
            f"the recorder missed {count} messages on {topic}"
            for topic, count in self.missed.items()
        ]
        if self.stood_still:
            missed.append(
                f"the recorder stood still for {self.stood_still:.1f} s: more messages of that "
                "time may be missing than were counted"
            )
        return (*self.unreadable, *missed)

    @property
    def lines(self) -> tuple[str, ...]:
        """One line for each thing that concerns more than one joint."""
        return (*self.missing_lines, *self.notes)

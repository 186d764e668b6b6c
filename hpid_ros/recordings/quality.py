"""Completeness of a recording: what its stamps say about samples that are not there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

HOLD = "hold"
"""As a reference: the joint's first position, because it was asked for."""
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
    end: float = 0.0  # last stamp, likewise
    gaps: int = 0  # intervals longer than 1.5 periods
    lost: int = 0  # samples that would fill the gaps, no more than the whole time has room for
    gap_time: float = 0.0  # [s] sum of the gaps
    longest_gap: float = 0.0  # [s] the longest; zero if there is none
    # [s] when it begins, in seconds since the first state of any joint
    longest_gap_at: float = 0.0
    repeated: int = 0  # samples whose stamp was there already; of several the last stands
    out_of_order: int = 0  # samples with an earlier stamp than the sample recorded before
    # samples that were left out, their number being NaN, infinite or beyond 1e50
    not_finite: int = 0

    @property
    def is_complete(self) -> bool:
        """Whether nothing is missing, repeated, out of order or unusable."""
        return not (self.lost or self.repeated or self.out_of_order or self.not_finite)


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
    def is_complete(self) -> bool:
        """Whether neither states nor commands miss anything."""
        return self.states.is_complete and self.commands.is_complete


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
    def is_complete(self) -> bool:
        """Whether all was recorded, every file was read whole and no joint misses anything."""
        is_whole = not (self.unreadable or self.missed or self.stood_still)
        return is_whole and all(each.is_complete for each in self.joints.values())

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

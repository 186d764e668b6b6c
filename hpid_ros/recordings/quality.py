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

    Attributes:
        count: Samples that are used.
        period: Median time between two of them, in [s]; zero for fewer than two.
        begin: First stamp, in seconds since the first state of any joint, in [s].
        end: Last stamp, likewise.
        gaps: Intervals longer than 1.5 periods.
        lost: Samples that would fill the gaps, no more than the whole time has room for.
        gap_time: Sum of the gaps, in [s].
        longest_gap: The longest, in [s]; zero if there is none.
        longest_gap_at: When it begins, in seconds since the first state of any joint, in [s].
        repeated: Samples whose stamp was there already; of several the last stands.
        out_of_order: Samples with an earlier stamp than the sample recorded before.
        not_finite: Samples that were left out, their number being NaN, infinite or beyond 1e50.
    """

    count: int = 0
    period: float = 0.0
    begin: float = 0.0
    end: float = 0.0
    gaps: int = 0
    lost: int = 0
    gap_time: float = 0.0
    longest_gap: float = 0.0
    longest_gap_at: float = 0.0
    repeated: int = 0
    out_of_order: int = 0
    not_finite: int = 0

    @property
    def is_complete(self) -> bool:
        """Whether nothing is missing, repeated, out of order or unusable."""
        return not (self.lost or self.repeated or self.out_of_order or self.not_finite)


@dataclass(frozen=True)
class DataQuality:
    """What one joint's series was made of.

    Attributes:
        states: Its states.
        commands: Its commands; a count of 0 if it has none.
        state_clock: ``"header"`` or ``"receive"``: whose time the states have.
        command_clock: Likewise of the commands; ``"receive"`` if their messages carry no stamp.
        answers_states: Whether commands carry the stamps of the states that they answer, so that
            unanswered states can be counted.
        reference: Kind and topic of the reference, for instance
            ``"trajectory /joint_trajectory"``; ``"hold"`` is the first position, as asked for,
            ``"none"`` that nothing says it.
        references: Number of reference messages that concern the joint.
        reference_from: When the joint came under its reference, in seconds since the first state
            of any joint, in [s]; None without a reference.
        effort: Topic of the efforts, ``"measured"`` and the topic of the states, or ``"none"``.
        no_effort: Why there is none; empty if there is.
    """

    states: StampQuality = field(default_factory=StampQuality)
    commands: StampQuality = field(default_factory=StampQuality)
    state_clock: str = "header"
    command_clock: str = "header"
    answers_states: bool = True
    reference: str = NONE
    references: int = 0
    reference_from: float | None = None
    effort: str = NONE
    no_effort: str = ""

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
    """What a whole recording was made of.

    Attributes:
        source: Path of the bag.
        joints: Quality by joint.
        unreadable: One line for each part of the files that could not be read; empty if all
            could.
        notes: One line for each thing that was assumed or left out on purpose.
        missed: Messages that the recorder knows it never got, by topic.
        stood_still: How long the recorder itself stood still, in [s].
    """

    source: str = ""
    joints: Mapping[str, DataQuality] = field(default_factory=dict)
    unreadable: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    missed: Mapping[str, int] = field(default_factory=dict)
    stood_still: float = 0.0

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

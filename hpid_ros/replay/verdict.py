"""What came of a replay: how many commands are the law's, and which are not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Difference(NamedTuple):
    """Answered states one after the other whose commands are not the law's.

    Attributes:
        stamp_ns: Stamp of the first, in [ns].
        last_ns: Stamp of the last, in [ns].
        time: Of the first, since the first state of the recording, in [s].
        commands: How many there are.
        recorded: The first command in [N m].
        computed: What the law answers, in [N m].
        reason: What is known of why.
    """

    stamp_ns: int
    last_ns: int
    time: float
    commands: int
    recorded: float
    computed: float
    reason: str


@dataclass(frozen=True)
class JointVerdict:
    """One joint's commands against the law.

    Attributes:
        joint: The joint.
        equal: Commands that are the law's, to the last bit.
        different: Commands that answer a state with another effort.
        differences: The same, one after the other taken together; the first ones of many.
        unanswered: States without a command since the controller began.
        without_state: Commands that answer a state which is not in the recording.
        outside: Commands that answer states before the first or after the last one recorded.
        zeros: Commands of zero with which the joint was left.
        fallbacks: Commands that answer no state: a fallback effort, or zero while stopped.
        foreign: Commands by somebody else than who sent the first.
        senders: Who sent commands, as far as they say.
        notes: What had to be assumed, in words.
        is_slide: Whether the joint slides: its efforts are in [N].
        is_begun_before: Whether the controller ran before the recording began.
    """

    joint: str
    equal: int = 0
    different: int = 0
    differences: tuple[Difference, ...] = ()
    unanswered: int = 0
    without_state: int = 0
    outside: int = 0
    zeros: int = 0
    fallbacks: int = 0
    foreign: int = 0
    senders: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    is_slide: bool = False
    is_begun_before: bool = False

    @property
    def is_the_law(self) -> bool:
        """Whether every command that could be computed anew is the law's, and there is one."""
        return self.equal > 0 and not (self.different or self.without_state or self.foreign)

    @property
    def is_untold(self) -> bool:
        """Whether nothing can be said: what its controller remembered from before is missing."""
        return self.is_begun_before and not self.equal

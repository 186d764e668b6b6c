"""What came of a replay: how many commands are the law's, and which are not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Difference(NamedTuple):
    """Answered states one after the other whose commands are not the law's."""

    stamp_ns: int  # [ns] stamp of the first
    last_ns: int  # [ns] stamp of the last
    time: float  # [s] of the first, since the first state of the recording
    commands: int  # how many there are
    recorded: float  # [N m] the first command
    computed: float  # [N m] what the law answers
    reason: str  # what is known of why


@dataclass(frozen=True)
class JointVerdict:
    """One joint's commands against the law."""

    joint: str
    equal: int = 0  # commands that are the law's, to the last bit
    different: int = 0  # commands that answer a state with another effort
    differences: tuple[Difference, ...] = ()  # the same, one after the other taken together
    unanswered: int = 0  # states without a command since the controller began
    without_state: int = 0  # commands that answer a state which is not in the recording
    outside: int = 0  # commands that answer states before the first or after the last one recorded
    zeros: int = 0  # commands of zero with which the joint was left
    fallbacks: int = 0  # commands that answer no state: a fallback effort, or zero while stopped
    foreign: int = 0  # commands by somebody else than who sent the first
    senders: tuple[str, ...] = ()  # who sent commands, as far as they say
    notes: tuple[str, ...] = ()  # what had to be assumed, in words
    is_slide: bool = False  # [N] whether the joint slides: its efforts are
    is_begun_before: bool = False  # whether the controller ran before the recording began

    @property
    def is_the_law(self) -> bool:
        """Whether every command that could be computed anew is the law's, and there is one."""
        return self.equal > 0 and not (self.different or self.without_state or self.foreign)

    @property
    def is_untold(self) -> bool:
        """Whether nothing can be said: what its controller remembered from before is missing."""
        return self.is_begun_before and not self.equal

"""What a joint loop is doing, and what it has seen."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class LoopState(Enum):
    """What a loop is doing."""

    WAITING = "waiting for the first state"
    HOLDING = "holding its position"
    FOLLOWING = "following a reference"
    FAULT = "the last state could not be used"
    SILENT = "no new state within state_timeout"


@dataclass
class LoopCounts:
    """What a loop has seen since it was made.

    Attributes:
        samples: States that were answered with a new effort.
        repeats: States with the stamp of the one before.
        resets: States older than the one before: the clock went back.
        gaps: States later than ``state_timeout`` after the one before.
        silences: Times in which the fallback effort was given for want of states.
        takeovers: Times in which the loop took the joint over anew, after a gap, a silence,
            states that could not be used, or a jump.
        jumps: Rejected states whose position no joint can have come to since the last one.
        missed: States that must have been lost, by the stamps and ``control_period``.
        saturated: Samples whose effort was limited.
        rejected: States that were not finite or no joint's, or made the law's effort so, or whose
            position jumped.
    """

    samples: int = 0
    repeats: int = 0
    resets: int = 0
    gaps: int = 0
    silences: int = 0
    takeovers: int = 0
    jumps: int = 0
    missed: int = 0
    saturated: int = 0
    rejected: int = 0

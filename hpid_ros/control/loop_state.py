"""The state of a joint loop: its mode, its counts, and its clock of stamps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from hpid_ros.control.settings.groups import Timing


class LoopState(Enum):
    """What a loop is doing."""

    WAITING = "waiting for the first state"
    HOLDING = "holding its position"
    FOLLOWING = "following a reference"
    FAULT = "the last state could not be used"
    SILENT = "no new state within state_timeout"


@dataclass
class LoopCounts:
    """What a loop has seen since it was made."""

    samples: int = 0  # states that were answered with a new effort
    repeats: int = 0  # states with the stamp of the one before
    resets: int = 0  # states older than the one before: the clock went back
    gaps: int = 0  # states later than state_timeout after the one before
    silences: int = 0  # times in which the fallback effort was given for want of states
    takeovers: int = 0
    jumps: int = 0  # rejected states whose position no joint can have come to since the last one
    missed: int = 0  # states that must have been lost, by the stamps and control_period
    saturated: int = 0  # samples whose effort was limited
    rejected: int = 0


_LATE = 1.5  # control periods between two states: there was none in between


class LoopClock:
    """Keeps the stamps of the states that a loop was given."""

    __slots__ = ("_counts", "_unusable", "has_lapsed", "stamp_ns", "unusable_ns")

    def __init__(self, counts: LoopCounts) -> None:
        self._counts = counts
        self.restart()

    def restart(self) -> None:
        """Forget the time: the next state is the first one."""
        self.stamp_ns: int | None = None
        self.unusable_ns: int | None = None
        self.has_lapsed = False
        self._unusable = 0

    def lapse(self) -> None:
        """Note that no state has come for too long."""
        self.has_lapsed = True

    def take(self, stamp_ns: int, dt: float, timing: Timing) -> None:
        """Take the stamp of a usable state."""
        self.stamp_ns = stamp_ns
        self.has_lapsed = False
        period = timing.control_period
        if dt > _LATE * period:
            self._counts.missed += max(round(dt / period) - 1 - self._unusable, 0)
            self._counts.gaps += dt > timing.state_timeout
        if self.unusable_ns is not None:
            self.unusable_ns = None
            self._unusable = 0

    def skip(self, stamp_ns: int) -> None:
        """Take the stamp of a state that cannot be used."""
        self.unusable_ns = stamp_ns
        self._unusable += 1

"""The control clock as one loop sees it: stamps of states, gaps, silences."""

from __future__ import annotations

from hpid_ros.control.loop_state import LoopCounts
from hpid_ros.control.settings import LoopSettings

_LATE = 1.5  # control periods between two states: there was none in between


class LoopClock:
    """Keeps the stamps of the states that a loop was given.

    Attributes:
        stamp_ns: Stamp of the last usable state in [ns]; None before the first one.
        unusable_ns: Stamp of the last state since then that could not be used, in [ns]; None
            if there was none.
        has_lapsed: Whether no state came for too long, and none has come since.

    Args:
        counts: Where irregularities are counted.
    """

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

    def take(self, stamp_ns: int, dt: float, settings: LoopSettings) -> None:
        """Take the stamp of a usable state.

        Args:
            stamp_ns: In [ns].
            dt: Time since the last usable one in [s].
            settings: Those in force, for ``control_period`` and ``state_timeout``.
        """
        self.stamp_ns = stamp_ns
        self.has_lapsed = False
        period = settings.control_period
        if dt > _LATE * period:
            self._counts.missed += max(round(dt / period) - 1 - self._unusable, 0)
            self._counts.gaps += dt > settings.state_timeout
        if self.unusable_ns is not None:
            self.unusable_ns = None
            self._unusable = 0

    def skip(self, stamp_ns: int) -> None:
        """Take the stamp of a state that cannot be used.

        Args:
            stamp_ns: In [ns].
        """
        self.unusable_ns = stamp_ns
        self._unusable += 1

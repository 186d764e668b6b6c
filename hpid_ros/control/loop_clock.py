"""The control clock as one loop sees it: stamps of states, gaps, silences."""

from __future__ import annotations

from hpid_ros.control.loop_state import LoopCounts
from hpid_ros.control.settings import LoopSettings

_SECONDS_PER_NANOSECOND = 1e-9
_LATE = 1.5  # control periods between two states: there was none in between


class LoopClock:
    """Tells how much time passed between two states, by their stamps alone.

    Attributes:
        stamp_ns: Stamp of the last state in [ns]; None before the first one.
        has_lapsed: Whether no state came for too long, and none has come since.
        is_takeover_due: Whether the joint had no command of the loop for longer than
            ``state_timeout``.
        unusable_since_ns: Stamp of the last state that was answered, in [ns], while those after
            it could not be used; else None.

    Args:
        counts: Where irregularities are counted.
    """

    __slots__ = (
        "_before_jump",
        "_counts",
        "has_lapsed",
        "is_takeover_due",
        "stamp_ns",
        "unusable_since_ns",
    )

    def __init__(self, counts: LoopCounts) -> None:
        self._counts = counts
        self.restart()

    def restart(self) -> None:
        """Forget the time: the next state is the first one."""
        self.stamp_ns: int | None = None
        self.unusable_since_ns: int | None = None
        self.has_lapsed = self.is_takeover_due = False
        self._before_jump: tuple[int, bool, int | None] | None = None

    def elapse(self, stamp_ns: int, settings: LoopSettings) -> float:
        """Take the stamp of a state.

        Args:
            stamp_ns: In [ns].
            settings: Those in force, for ``control_period`` and ``state_timeout``.

        Returns:
            The time since the last state in [s]: 0 for the first one, negative when the clock
            went back. A single stamp from the future is passed over.
        """
        before, self.stamp_ns = self.stamp_ns, stamp_ns
        if before is None:
            return 0.0
        dt = (stamp_ns - before) * _SECONDS_PER_NANOSECOND
        counts = self._counts
        if dt < 0.0:
            dt = self._since_jump(stamp_ns, dt, settings.state_timeout)
            if dt < 0.0:
                counts.resets += 1
                return dt
        self._before_jump = None
        period = settings.control_period
        if dt > _LATE * period:
            counts.missed += round(dt / period) - 1
        is_gap = dt > settings.state_timeout
        if is_gap:
            counts.gaps += 1
            self._before_jump = before, self.is_takeover_due, self.unusable_since_ns
        if self.has_lapsed:
            self.is_takeover_due |= is_gap
            self.has_lapsed = False
        return dt

    def skip(self, stamp_ns: int, settings: LoopSettings) -> None:
        """Take the stamp of a state that cannot be used.

        Args:
            stamp_ns: In [ns]; one that is not later than the last changes nothing.
            settings: Those in force, for ``state_timeout``.
        """
        before = self.stamp_ns
        if before is None or stamp_ns <= before:
            return
        is_jump = (stamp_ns - before) * _SECONDS_PER_NANOSECOND > settings.state_timeout
        self._before_jump = (
            (before, self.is_takeover_due, self.unusable_since_ns) if is_jump else None
        )
        self.stamp_ns = stamp_ns
        if self.unusable_since_ns is None:
            self.unusable_since_ns = before
        elapsed = (stamp_ns - self.unusable_since_ns) * _SECONDS_PER_NANOSECOND
        self.is_takeover_due |= elapsed > settings.state_timeout

    def _since_jump(self, stamp_ns: int, dt: float, timeout: float) -> float:
        """Return the time since the state before the last one, if the last had a wrong stamp."""
        if self._before_jump is None:
            return dt
        before, is_takeover_due, unusable_since_ns = self._before_jump
        since = (stamp_ns - before) * _SECONDS_PER_NANOSECOND
        if not 0.0 <= since <= timeout:
            return dt
        self.is_takeover_due, self.unusable_since_ns = is_takeover_due, unusable_since_ns
        return since

"""A joint loop with its interruptions: missing states, a stop, another effort, a freeze.

Without ROS, threads and clocks of its own: the caller says what time it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.overrides import DampingStop

LOOKS = 4.0
"""Checks in one timeout."""
_SHORTEST_PERIOD = 1e-3  # [s] between two looks


class StateTimeout(NamedTuple):
    """States have stopped coming."""

    duration: float  # [s] since the last new one
    is_new: bool  # whether it has not been noticed before


class Watchdog:
    """Knows whether the last new state came longer than a timeout ago.

    A driver that repeats its last state for ever is as silent as one that has ended. Two threads
    may ask: one that gives the effort, which nothing may delay (:meth:`is_silent`,
    :meth:`time_left`), and the one of the loop, to which it is told (:meth:`look`). All times are
    of one steady clock, in [ns].
    """

    def __init__(self) -> None:
        self.timeout: float | None = None
        """Longest time without a new state in [s]; None while nobody looks."""
        self.forget()

    def forget(self) -> None:
        """Look no more, and forget what came."""
        self.timeout = None
        self._last_ns: int | None = None
        self._noticed_ns: int | None = None
        self._given_ns: int | None = None
        self._stamp_ns: int | None = None

    @property
    def period(self) -> float:
        """Time between two looks in [s]."""
        timeout = self.timeout
        return math.inf if timeout is None else max(timeout / LOOKS, _SHORTEST_PERIOD)

    def time_left(self, now_ns: int) -> float:
        """Return the time in [s] until the next check is due."""
        timeout = self.timeout  # another thread may change it
        if timeout is None:
            return math.inf
        silence = self._silence(now_ns)
        return self.period if silence > timeout else timeout - silence

    def is_silent(self, now_ns: int) -> bool:
        """Return whether states are missing; whoever asks gives an effort then."""
        timeout, last_ns = self.timeout, self._last_ns  # another thread may change them
        if timeout is None or last_ns is None or now_ns - last_ns <= timeout * NANOSECONDS:
            return False
        self._given_ns = last_ns
        return True

    def look(self, now_ns: int) -> StateTimeout | None:
        """Return the silence that there is."""
        silence = self._silence(now_ns)
        if self.timeout is None or silence <= self.timeout:
            return None
        is_new, self._noticed_ns = self._noticed_ns != self._last_ns, self._last_ns
        return StateTimeout(silence, is_new)

    def note_past_timeout(self, now_ns: int) -> StateTimeout | None:
        """Return a silence in which an effort was given, and which has not been looked at."""
        if self._given_ns is None or not self._given_ns == self._last_ns != self._noticed_ns:
            return None
        return self.look(now_ns)

    def observe(self, stamp_ns: int, now_ns: int) -> tuple[StateTimeout | None, bool]:
        """Take note of a state; one that repeats the last stamp is not new."""
        if stamp_ns == self._stamp_ns:
            return None, False
        before_ns, self._stamp_ns, self._last_ns = self._last_ns, stamp_ns, now_ns
        if self.timeout is None or before_ns is None or before_ns == self._noticed_ns:
            return None, False
        silence = (now_ns - before_ns) / NANOSECONDS
        if before_ns == self._given_ns:
            return StateTimeout(silence, True), False
        return None, silence > self.timeout

    def _silence(self, now_ns: int) -> float:
        """Return the time since the last new state in [s]; 0 before the first."""
        return 0.0 if self._last_ns is None else (now_ns - self._last_ns) / NANOSECONDS


class SupervisedLoop:
    """A joint loop and what answers in its place."""

    def __init__(
        self,
        loop: JointLoop,
        timed_out: Callable[[float, float], None],
        cut: Callable[[], None],
    ) -> None:
        self.loop = loop
        self.watchdog = Watchdog()
        self._timed_out, self._cut = timed_out, cut
        self._stop: DampingStop | None = None
        self._was_held = False

    def begin(self) -> None:
        """Let the loop answer again after a stop."""
        self._stop = None

    def damp(self, duration: float) -> bool:
        """Let a damping stop answer from now on."""
        has_begun = self.loop.stamp_ns is not None and duration > 0.0
        self._stop = self.loop.damping_stop(duration) if has_begun else None
        return has_begun

    @property
    def timeout_effort(self) -> float:
        """Effort to give while no state comes, in [N m]."""
        return self.loop.settings.effort.fallback if self._stop is None else 0.0

    def note_release(self) -> None:
        """Note that the joint was held without effort, and is not any more."""
        self._was_held = True

    def look(self, now_ns: int) -> None:
        """Take note of a silence."""
        self._note(self.watchdog.look(now_ns))

    def note_past_timeout(self, now_ns: int) -> None:
        """Take note of a silence in which an effort was given already."""
        self._note(self.watchdog.note_past_timeout(now_ns))

    def answer(
        self,
        stamp_ns: int,
        position: float,
        velocity: float | None,
        now_ns: int,
        answer: Callable[[], float] | None = None,
    ) -> float:
        """Take one state and return the effort that answers it in [N m]."""
        silence, is_unnoticed = self.watchdog.observe(stamp_ns, now_ns)
        self._note(silence)
        if is_unnoticed:
            self.loop.note_unanswered()
        if self._was_held:
            self._was_held = False
            self.loop.supersede(0.0)
        if self._stop is not None:
            return self._stop.step(stamp_ns, position, velocity)
        if answer is not None:
            return answer()
        return self.loop.step(stamp_ns, position, velocity)

    def _note(self, silence: StateTimeout | None) -> None:
        if silence is None:
            return
        if self._stop is not None:
            self._cut()
        elif silence.is_new and self.loop.stamp_ns is not None:
            self._timed_out(silence.duration, self.loop.note_timeout())

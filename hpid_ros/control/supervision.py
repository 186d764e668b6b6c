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

_CHECKS_PER_TIMEOUT = 4.0
_SHORTEST_PERIOD = 1e-3  # [s] between two looks
_STOOD_NS = 20_000_000  # [ns] without a look beyond the period: the process stood still
_CATCH_UP_NS = 100_000_000  # [ns] for the states that wait to come to the loop's thread then
_STUCK_NS = 250_000_000  # [ns] beyond that, for the loop's thread to take them
_FREEZES = 3  # in one wait; after more of them it is over as it would be without
LATE_NS = 10_000_000
"""By no more than this a state may be later than those before a silence, in [ns]."""
_PACE, _SEEN_NS = 1.5, 50_000_000  # states that were waiting come faster, seen for so long
_MANY_REPEATS = 3  # of one state; one may be asked for again
_WAITED_NS = 1_000_000_000  # after so long no state is one that waited


def standing_stamps(stamp_ns: int, repeats: int) -> str:
    """Say of states that come again and again with one stamp what is wrong with them."""
    if repeats < _MANY_REPEATS:
        return ""
    if stamp_ns == 0:
        return "the stamps of joint_states are 0: their driver has to stamp them"
    return f"the stamps of joint_states stand still at {stamp_ns / NANOSECONDS:.3f} s"


class StateTimeout(NamedTuple):
    """States have stopped coming."""

    duration: float  # [s] since the last new one
    is_new: bool  # whether it has not been noticed before


class _Wait:
    """The time since a new state; either thread marks what it has done about it."""

    __slots__ = (
        "begin_ns",
        "freezes",
        "is_answered",
        "is_caught_up",
        "is_noticed",
        "not_before_ns",
    )

    def __init__(self, begin_ns: int) -> None:
        self.begin_ns = self.not_before_ns = begin_ns  # before that it is no timeout
        self.is_caught_up = True  # the loop's thread has taken what waited
        self.freezes = 0
        self.is_answered = False  # an effort was given for want of a state
        self.is_noticed = False  # the loop was told

    def duration(self, now_ns: int) -> float:
        """Return how long it lasts in [s]."""
        return (now_ns - self.begin_ns) / NANOSECONDS


class Watchdog:
    """Knows whether the last new state came longer than a timeout ago.

    A driver that repeats its last state for ever is as silent as one that has ended. Two threads
    may ask: one that gives the effort, which nothing may delay (:meth:`is_silent`,
    :meth:`time_left`), and the one of the loop, to which it is told (:meth:`look`). All times are
    of one steady clock, in [ns].

    Each thread looks once in a :attr:`period`. Where neither has for longer, the process stood
    still: states wait, and whichever thread is first, they are taken before a timeout is believed.
    It is one when a tenth of a second has passed and the loop's thread has looked since then
    (:meth:`catch_up`), behind all that waited.
    """

    def __init__(self) -> None:
        self.timeout: float | None = None
        """Longest time without a new state in [s]; None while nobody looks."""
        self.forget()

    def forget(self) -> None:
        """Look no more, and forget what came."""
        self.timeout = None
        self._wait: _Wait | None = None  # None before the first state
        self._stamp_ns: int | None = None
        self._repeats = 0  # of the last stamp
        self._seen_ns = 0  # when a thread looked last

    @property
    def period(self) -> float:
        """Time between two looks in [s]."""
        timeout = self.timeout
        return (
            math.inf if timeout is None else max(timeout / _CHECKS_PER_TIMEOUT, _SHORTEST_PERIOD)
        )

    def time_left(self, now_ns: int) -> float:
        """Return the time in [s] until the next check is due."""
        timeout, wait = self.timeout, self._wait  # another thread may change them
        if timeout is None:
            return math.inf
        if wait is None:
            return self.period
        not_yet = (wait.not_before_ns - now_ns) / NANOSECONDS
        left = max(timeout - wait.duration(now_ns), not_yet)
        return self.period if left < 0.0 else min(left, self.period)

    def is_silent(self, now_ns: int) -> bool:
        """Return whether states are missing; whoever asks gives an effort then."""
        timeout, wait = self.timeout, self._seen(now_ns)
        if timeout is None or wait is None or not _is_over(wait, timeout, now_ns):
            return False
        wait.is_answered = True
        return True

    def _seen(self, now_ns: int) -> _Wait | None:
        """Note that a thread looks, and return the wait; after a standstill it is not over yet."""
        wait, seen_ns = self._wait, self._seen_ns
        has_stood = now_ns - seen_ns > self.period * NANOSECONDS + _STOOD_NS
        if has_stood and wait is not None and wait.freezes < _FREEZES:
            wait.freezes += 1
            wait.not_before_ns = now_ns + _CATCH_UP_NS
            wait.is_caught_up = False
        # Last: until here the other thread finds out the same by itself.
        self._seen_ns = max(seen_ns, now_ns)
        return wait

    def catch_up(self, now_ns: int) -> None:
        """Note, on the loop's thread, that it takes what waits: this look waited behind it."""
        wait = self._wait  # another thread may change it
        if wait is not None and now_ns >= wait.not_before_ns:
            wait.is_caught_up = True

    def wake(self, now_ns: int) -> bool:
        """Note that the process was stopped; tell whether the states had been silent before."""
        wait = self._wait  # another thread may change it
        if wait is None:
            return False
        if not wait.is_answered:
            self._wait, self._seen_ns = _Wait(now_ns), now_ns
        return wait.is_answered

    def look(self, now_ns: int) -> StateTimeout | None:
        """Return the silence that there is."""
        timeout, wait = self.timeout, self._seen(now_ns)
        if timeout is None or wait is None or not _is_over(wait, timeout, now_ns):
            return None
        is_new, wait.is_noticed = not wait.is_noticed, True
        return StateTimeout(wait.duration(now_ns), is_new)

    def note_past_timeout(self, now_ns: int) -> StateTimeout | None:
        """Return a silence in which an effort was given, and which has not been looked at."""
        wait = self._wait
        is_due = wait is not None and wait.is_answered and not wait.is_noticed
        return self.look(now_ns) if is_due else None

    def standstill(self, now_ns: int, least: float) -> str:
        """Say that states have come for so long in [s] whose stamps stand still; else nothing."""
        wait, stamp_ns = self._wait, self._stamp_ns
        if wait is None or stamp_ns is None or wait.duration(now_ns) <= least:
            return ""
        return standing_stamps(stamp_ns, self._repeats)

    def observe(self, stamp_ns: int, now_ns: int) -> tuple[StateTimeout | None, bool]:
        """Take note of a state; one that repeats the last stamp is not new.

        Return the silence that nobody has reported yet, if any, and whether there was one in
        which nobody gave another effort.
        """
        before = self._seen(now_ns)
        if stamp_ns == self._stamp_ns:
            self._repeats += 1
            return None, False
        self._wait, self._stamp_ns = _Wait(now_ns), stamp_ns
        self._repeats = 0
        if self.timeout is None or before is None or before.is_noticed:
            return None, False
        if before.is_answered:
            return StateTimeout(before.duration(now_ns), True), False
        return None, before.duration(now_ns) > self.timeout


def _is_over(wait: _Wait, timeout: float, now_ns: int) -> bool:
    """Return whether a wait is a timeout."""
    if wait.duration(now_ns) <= timeout:
        return False
    over_ns = now_ns - wait.not_before_ns
    return wait.is_answered or (over_ns >= 0 and wait.is_caught_up) or over_ns > _STUCK_NS


class SupervisedLoop:
    """A joint loop and what answers in its place."""

    def __init__(
        self,
        loop: JointLoop,
        timed_out: Callable[
            [float, float], None
        ],  # by its duration [s] and the effort given [N m]
        cut: Callable[[], None],
    ) -> None:
        self.loop = loop
        self.watchdog = Watchdog()
        self._timed_out, self._cut = timed_out, cut
        self._stop: DampingStop | None = None
        self._was_held = self._is_resuming = False
        self._latency_ns: int | None = None  # from the stamp of the last state to its answer
        self._stamp_ns = 0
        self._resumed: tuple[int, int] | None = None  # stamp of the first that waited, and when

    def begin(self) -> None:
        """Let the loop answer again, after a stop or from the beginning."""
        self._stop = None
        self._is_resuming = self._was_held = False
        self._latency_ns = self._resumed = None

    def damp(self, duration: float) -> bool:
        """Let a damping stop answer from now on."""
        has_begun = self.loop.state.stamp_ns is not None and duration > 0.0
        self._stop = self.loop.damping_stop(duration) if has_begun else None
        return has_begun

    @property
    def timeout_effort(self) -> float:
        """Effort to give while no state comes, in [N m]."""
        return self.loop.settings.effort.fallback if self._stop is None else 0.0

    def note_release(self, now_ns: int) -> None:
        """Note that the joint was held without effort, and is not any more."""
        self._was_held = not self.watchdog.wake(now_ns)  # else it gets the fallback again

    def look(self, now_ns: int) -> None:
        """Take note of a silence."""
        self.watchdog.catch_up(now_ns)
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
        step: Callable[[], float] | None = None,
    ) -> float:
        """Take one state and return the effort that answers it in [N m].

        After a silence or a stop of the process, states that were waiting get the active effort:
        they say where the joint was, and come faster than time passes.
        """
        silence, is_unnoticed = self.watchdog.observe(stamp_ns, now_ns)
        self._note(silence)
        if is_unnoticed:
            self._resume()
            self.loop.note_unanswered()
        if self._was_held:
            self._resume()
            self.loop.supersede(0.0)
            if self._stop is not None:
                self._stop.effort = 0.0
        if self._is_resuming and self._has_waited(stamp_ns, now_ns):
            return self.loop.law.effort if self._stop is None else self._stop.effort
        if stamp_ns != self._stamp_ns:
            self._latency_ns, self._stamp_ns = now_ns - stamp_ns, stamp_ns
        if self._stop is not None:
            return self._stop.step(stamp_ns, position, velocity)
        return self.loop.step(stamp_ns, position, velocity) if step is None else step()

    def _note(self, silence: StateTimeout | None) -> None:
        if silence is None:
            return
        if self._stop is not None:
            self._cut()
        elif silence.is_new and self.loop.state.stamp_ns is not None:
            self._resume()
            self._timed_out(silence.duration, self.loop.note_timeout())

    def _resume(self) -> None:
        if not self._is_resuming:
            self._resumed = None
        self._is_resuming, self._was_held = True, False

    def _has_waited(self, stamp_ns: int, now_ns: int) -> bool:
        """Tell whether a state was waiting to be answered; the first that was not ends it."""
        first_ns, since_ns = self._resumed or (stamp_ns, now_ns)
        self._resumed = first_ns, since_ns
        passed_ns = now_ns - since_ns
        is_live = (
            self.loop.settings.timing.is_simulated  # its clock need not keep pace
            or self._latency_ns is None
            or now_ns - stamp_ns <= self._latency_ns + LATE_NS
            or (
                passed_ns >= _SEEN_NS and stamp_ns - first_ns <= _PACE * passed_ns
            )  # another clock
            or passed_ns > _WAITED_NS
        )
        if is_live:
            self._is_resuming, self._resumed = False, None
        return not is_live

"""Notices on the wall clock that states have stopped to come."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rclpy.timer import Timer

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.ros.executor import ClosingNode
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.nodes.ros.steady_timer import steady_timer

_LOOKS = 4.0  # in one timeout
_SHORTEST_PERIOD = 1e-3  # [s] between two looks


class StateWatchdog:
    """Looks whether the last new state came longer than ``state_timeout`` ago.

    A driver that repeats its last state for ever is as silent as one that has ended. A loop has no
    clock of its own; without states it is never called. So this stands beside it,
    and costs the loop nothing. Two threads look: that of the supervisor gives the effort, which no
    callback may delay (:meth:`is_silent`, :meth:`within`); that of the executor tells the loop.

    Args:
        node: The controller; it gets ``state_watchdog``.
        note: Called on the executor's thread at each look while states are missing, with the
            silence in [s] and whether it has just begun.
    """

    def __init__(
        self,
        node: ClosingNode,
        note: Callable[[float, bool], None],
    ) -> None:
        self._is_on = bool(
            read_only(
                node,
                "state_watchdog",
                True,
                "Give fallback_effort when no new state has come for state_timeout of wall time",
            )
        )
        self._node, self._note = node, note
        self._timer: Timer | None = None
        self._timeout = 0.0
        self._last_ns: int | None = None
        self._noticed_ns: int | None = None
        self._given_ns: int | None = None
        self._stamp_ns: int | None = None

    def watch(self, timeout: float) -> None:
        """Look from now on, or with another timeout.

        Args:
            timeout: Longest time without a state in [s].
        """
        if not self._is_on or (self._timer is not None and timeout == self._timeout):
            return
        self._destroy_timer()
        self._timeout = timeout
        self._timer = steady_timer(self._node, self._period, self._look)
        if self._node.supervisor is not None:
            self._node.supervisor.look_anew()

    def within(self) -> float:
        """Return the time in [s] until there may be a silence; for the supervisor's thread."""
        if self._timer is None:
            return math.inf
        silence = self._silence()
        return self._period if silence > self._timeout else self._timeout - silence

    def is_silent(self) -> bool:
        """Tell whether states are missing, and an effort is given; for the supervisor's thread."""
        last_ns = self._last_ns
        if self._timer is None or last_ns is None or self._silence() <= self._timeout:
            return False
        self._given_ns = last_ns
        return True

    def catch_up(self) -> None:
        """Note a silence now that the supervisor has noticed, and this thread has not yet."""
        if self._given_ns is not None and self._given_ns == self._last_ns != self._noticed_ns:
            self._look()

    def observe(self, stamp_ns: int, now_ns: int) -> bool:
        """Take note of a state; one that repeats the last stamp is not new.

        Args:
            stamp_ns: Its stamp in [ns].
            now_ns: When it came, on ``time.perf_counter_ns``.

        Returns:
            Whether it ends a silence that neither thread has noticed, so that no effort was
            given in it: the process was stopped, or busy.
        """
        if stamp_ns == self._stamp_ns:
            return False
        before_ns, self._stamp_ns, self._last_ns = self._last_ns, stamp_ns, now_ns
        if self._timer is None or before_ns is None or before_ns == self._noticed_ns:
            return False
        silence = (now_ns - before_ns) / NANOSECONDS
        if before_ns == self._given_ns:
            self._note(silence, True)
            return False
        return silence > self._timeout

    def stop(self) -> None:
        """Look no more, and forget what came."""
        self._stamp_ns = self._last_ns = self._noticed_ns = self._given_ns = None
        self._destroy_timer()

    def _destroy_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    @property
    def _period(self) -> float:
        return max(self._timeout / _LOOKS, _SHORTEST_PERIOD)

    def _silence(self) -> float:
        """Return the time since the last new state in [s]; 0 before the first."""
        last_ns = self._last_ns
        return 0.0 if last_ns is None else (time.perf_counter_ns() - last_ns) / NANOSECONDS

    def _look(self) -> None:
        last_ns, silence = self._last_ns, self._silence()
        if silence > self._timeout:
            is_new, self._noticed_ns = self._noticed_ns != last_ns, last_ns
            self._note(silence, is_new)

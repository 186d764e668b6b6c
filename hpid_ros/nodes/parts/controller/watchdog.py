"""The wall clock of a supervised loop."""

from __future__ import annotations

import time

from rclpy.timer import Timer

from hpid_ros.control.interludes.supervision import SupervisedLoop
from hpid_ros.nodes.ros.executor import ClosingNode
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.nodes.ros.steady_timer import steady_timer


class StateWatchdog:
    """Lets a loop look at the silence, beside the states: without them it is never called.

    Two threads look: that of the supervisor gives the effort, which no callback may delay; that of
    the executor tells the loop.
    """

    def __init__(self, node: ClosingNode, joint: SupervisedLoop) -> None:
        self._is_on = bool(
            read_only(
                node,
                "state_watchdog",
                True,
                "Give fallback_effort when no new state has come for state_timeout of wall time",
            )
        )
        self._node, self._joint, self._watchdog = node, joint, joint.watchdog
        self._timer: Timer | None = None

    def watch(self, timeout: float) -> None:
        """Look from now on, or with another timeout."""
        if not self._is_on or timeout == self._watchdog.timeout:
            return
        self._destroy_timer()
        self._watchdog.timeout = timeout
        self._timer = steady_timer(self._node, self._watchdog.period, self._look)
        if self._node.supervisor is not None:
            self._node.supervisor.look_anew()

    def stop(self) -> None:
        """Look no more, and forget what came."""
        self._watchdog.forget()
        self._destroy_timer()

    def is_silent(self) -> bool:
        """Tell whether states are missing, and an effort is given; for the supervisor's thread."""
        return self._watchdog.is_silent(time.perf_counter_ns())

    def within(self) -> float:
        """Return the time in [s] until there may be a silence; for the supervisor's thread."""
        return self._watchdog.within(time.perf_counter_ns())

    def _look(self) -> None:
        self._joint.look(time.perf_counter_ns())

    def _destroy_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

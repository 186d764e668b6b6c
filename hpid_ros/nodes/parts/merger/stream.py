"""Commands in, merged commands out, from the thread of the executor and from its supervisor's."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator

from rclpy.duration import Duration

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.merging import CommandMerger, Merged, MergerSettings
from hpid_ros.nodes.parts.merger.output import GroupOutput
from hpid_ros.nodes.ros.executor import ClosingNode
from hpid_ros.nodes.ros.steady_timer import steady_timer

_LOCK_WITHIN = 0.2  # [s]; whoever holds it longer is stuck in the middleware, as we would be
_BURST = 10  # zeros at once, where nobody may come back to repeat them
_SHORTEST_WAIT_NS = 20_000  # of the timer
_CLOSE_ENOUGH = 0.05  # of two waits, for which the timer stays as it is


class MergedStream:
    """A merger with its clock, its timer and its output.

    What is sent is whole and in the order in which it was merged, whichever thread sends it.
    """

    def __init__(
        self,
        node: ClosingNode,
        output: GroupOutput,
        note_delay: Callable[[int], None],
        changed: Callable[[CommandMerger], None],
    ) -> None:
        self.merger: CommandMerger | None = None
        self.output = output
        self._node, self._note_delay, self._changed = node, note_delay, changed
        self._lock = threading.Lock()  # of the merger, and of the order of what is sent
        self._is_held = self._is_shut = False
        self._timer = steady_timer(node, 1.0, self._on_deadline)
        self._timer.cancel()
        self._timer_ns = NANOSECONDS
        self._is_armed = False

    def begin(self, settings: MergerSettings) -> CommandMerger:
        """Merge from now on."""
        merger = CommandMerger(settings)
        with self._lock:
            self.output.agree(settings.names)
            self.merger = merger
        if self._node.supervisor is not None:
            self._node.supervisor.look_anew()
        return merger

    def end(self) -> None:
        """Merge no more."""
        with self._lock:
            self.merger = None
        self._disarm()

    def take(self, joint: str, stamp_ns: int, effort: float, *, is_signed: bool = True) -> None:
        """Take a command, on the executor's thread."""
        merger = self.merger
        if merger is None:
            return
        now_ns = time.perf_counter_ns()
        with self._lock:
            returns = merger.returns
            merged = merger.take(joint, stamp_ns, effort, now_ns, is_signed=is_signed)
            self._send(merged, merger, now_ns)
            has_returned = merger.returns > returns
        self._arm(merger, now_ns)
        if has_returned:
            self._changed(merger)

    def take_at_once(self, joint: str, stamp_ns: int, effort: float) -> None:
        """Take a command that nothing may delay, on any thread."""
        merger = self.merger
        if merger is None:
            return
        now_ns = time.perf_counter_ns()
        with self._sending():
            merged = merger.take(joint, stamp_ns, effort, now_ns) or merger.flush(now_ns)
            self._send(merged, merger, now_ns)

    def zero(self) -> None:
        """Send a zero for every joint, if anything has been sent before."""
        with self._sending():
            self.output.zero()

    def _send(self, merged: Merged | None, merger: CommandMerger, now_ns: int) -> None:
        """Publish what is to be sent; only to be called by who has the lock."""
        if merged is None or merger is not self.merger or self._is_held or self._is_shut:
            return
        self.output.send(merged)
        self._note_delay(now_ns - merger.rounds.began_ns)

    def _arm(self, merger: CommandMerger, now_ns: int) -> None:
        """Have the timer look when what has come is due, if anything is."""
        deadline_ns = merger.rounds.deadline_ns if merger.has_begun else None
        if deadline_ns is None:
            self._disarm()
            return
        if self._is_armed:
            return
        wait_ns = max(deadline_ns - now_ns, _SHORTEST_WAIT_NS)
        if abs(wait_ns - self._timer_ns) > _CLOSE_ENOUGH * wait_ns:
            self._timer.timer_period_ns = self._timer_ns = wait_ns
        self._timer.reset()
        self._is_armed = True

    def _disarm(self) -> None:
        if self._is_armed:
            self._timer.cancel()
            self._is_armed = False

    def _on_deadline(self) -> None:
        self._disarm()
        merger = self.merger
        if merger is None:
            return
        now_ns = time.perf_counter_ns()
        with self._lock:
            self._send(merger.look(now_ns), merger, now_ns)
        self._arm(merger, now_ns)

    @contextlib.contextmanager
    def _sending(self) -> Iterator[None]:
        """Hold the lock, or do without where whoever has it is stuck."""
        is_locked = self._lock.acquire(timeout=_LOCK_WITHIN)
        try:
            yield
        finally:
            if is_locked:
                self._lock.release()

    # What follows is called on the supervisor's thread, also while a callback does not return.

    def look(self) -> float:
        """Send the fallbacks of joints that have fallen silent, and what else is due."""
        merger = self.merger
        if merger is None:
            return math.inf
        now_ns = time.perf_counter_ns()
        with self._sending():
            silences = merger.silences
            self._send(merger.look(now_ns), merger, now_ns)
            has_changed = merger.silences > silences
            within = merger.within(now_ns)
        if has_changed:
            self._node.hand_over(self._changed, merger)
        return min(within, merger.shortest_timeout)  # a joint may come back at any time

    def hold(self) -> None:
        """Leave all joints without effort while the process is stopped."""
        self._is_held = True
        self._burst()

    def go_on(self) -> None:
        """Merge again; the joints come back from zero."""
        merger = self.merger
        if merger is not None:
            with self._sending():
                merger.supersede(0.0, time.perf_counter_ns())
        self._is_held = False

    def abandon(self) -> None:
        """Leave all joints without effort, for ever."""
        if not self._is_shut:
            self._is_shut = True
            self._burst()

    def _burst(self) -> None:
        for _ in range(_BURST):
            self.zero()


class MergedCommands:
    """One joint's commands, handed to a merger of the same process; a ``CommandSink``."""

    def __init__(self, stream: MergedStream, joint: str) -> None:
        self.publisher = MergedTopic(stream)
        self._joint, self._stream = joint, stream

    def send(self, stamp_ns: int, effort: float) -> None:
        """Give an effort in [N m] or [N]."""
        if threading.current_thread() is threading.main_thread():  # the executor's
            self._stream.take(self._joint, stamp_ns, effort)
        else:  # the supervisor's: the executor may be stuck
            self._stream.take_at_once(self._joint, stamp_ns, effort)


class MergedTopic:
    """The topic of merged commands, as a controller of the same process sees it.

    Nobody hears it before the merger has a receiver.
    """

    def __init__(self, stream: MergedStream) -> None:
        self._stream = stream

    @property
    def topic_name(self) -> str:
        """Full name of the topic."""
        return str(self._stream.output.publisher.topic_name)

    def get_subscription_count(self) -> int:
        """Return how many hear what is sent."""
        if self._stream.merger is None:
            return 0
        return int(self._stream.output.publisher.get_subscription_count())

    def wait_for_all_acked(self, timeout: Duration) -> bool:
        """Wait until all who acknowledge anything have done so, and tell whether they have."""
        return bool(self._stream.output.publisher.wait_for_all_acked(timeout))

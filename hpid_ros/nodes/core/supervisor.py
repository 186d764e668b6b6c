"""The supervisor of a process whose executor may be stuck in a callback.

A thread of its own reads the signals from a wake-up pipe, which the interpreter writes at once,
whatever the executor does, and lets nodes look at what must not wait for the executor. It needs
Python's lock: a callback that runs long or blocks in the system gives it away, one that computes
in C without giving it away does not, and nothing in the process helps against that.

========================  ===================================================================
SIGINT, SIGTERM, SIGHUP   the nodes are left and closed; exit code 0
SIGTSTP, SIGTTIN, SIGTTOU joints get zero effort, the process is stopped; it goes on at SIGCONT
any other that would end  as SIGTERM, and then the process ends by the signal
SIGCHLD, SIGURG, ...      left alone: their default does nothing
SIGSEGV, SIGABRT, ...     left alone: the process has crashed, and can promise nothing
========================  ===================================================================

What is ignored when the process begins stays ignored (``nohup``), but for SIGINT and SIGTERM;
what somebody has a handler for by then, or gets one for later, is theirs.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import FrameType, TracebackType
from typing import Protocol, TypeVar

from rclpy.task import Future

T = TypeVar("T")

ANSWERS_WITHIN = 0.25
"""Time in [s] for the executor to heed a request to stop; then joints are left without it."""

LEFT_WITHIN = 4.75
"""Time in [s] for all joints to be left; then the process is ended without its executor."""

_HEARD_WITHIN = 0.5  # [s] for all subscribers together, before the process is stopped

_ENDS_WELL = frozenset((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
_ALWAYS = frozenset((signal.SIGINT, signal.SIGTERM))  # also where a shell had them ignored
_STOPS = frozenset((signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU))
_LEFT_ALONE = frozenset(
    (
        *(signal.SIGKILL, signal.SIGSTOP),  # nobody can catch them
        *(signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH),  # they end nothing
        # The process has crashed, or a debugger is at it.
        *(signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL),
        *(signal.SIGTRAP, signal.SIGSYS),
    )
)
_CLOSE, _LOOK_ANEW = 0, 255  # on the pipe, beside the numbers of signals


class Supervised(Protocol):
    """A node, as the supervisor sees it: every method is called on the supervisor's thread."""

    def look(self) -> float:
        """Do what must not wait for the executor, and return when to look again, in [s]."""

    def hold(self) -> None:
        """Leave without effort until :meth:`go_on`."""

    def wait_until_held(self, within: float) -> None:
        """Wait until that has been heard, for at most so many seconds."""

    def go_on(self) -> None:
        """Go on after :meth:`hold`."""

    def abandon(self) -> bool:
        """Leave for ever, and return whether the process may then end without the executor."""


class Supervisor:
    """The end of a process, asked for once by a signal or a node, and the thread beside it."""

    def __init__(self) -> None:
        self.future: Future = Future()
        self.code = 0
        self.ends_by: int | None = None
        self.failure: Exception | None = None
        self.is_heeded = self.are_left = self.has_abandoned = False
        self._nodes: Sequence[Supervised] = ()
        self._lock = threading.Lock()
        self._asked_at = math.inf
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._taken: set[int] = set()
        self._thread = threading.Thread(target=self._supervise, name="supervisor", daemon=True)

    def __enter__(self) -> Supervisor:
        """Take the signals; to be called on the main thread."""
        for number in sorted(set(signal.valid_signals()) - _LEFT_ALONE - _taken_elsewhere()):
            signal.signal(number, _ignore)
            self._taken.add(number)
        self._before = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Take no more: the process ends, and a second signal must not spoil that."""
        signal.set_wakeup_fd(self._before)
        for number in self._taken:
            if signal.getsignal(number) is _ignore:
                signal.signal(number, signal.SIG_IGN)
        self._tell(_CLOSE)
        self._thread.join()
        os.close(self._reader)
        os.close(self._writer)

    def supervise(self, nodes: Sequence[Supervised]) -> None:
        """Look after these nodes from now on; the executor's time begins now."""
        self._nodes = nodes
        if self.future.done():
            self._asked_at = time.monotonic()
        self.check_again()

    def check_again(self) -> None:
        """Ask the nodes again when to look: something has changed."""
        self._tell(_LOOK_ANEW)

    def request(self, code: int = 0, ends_by: int | None = None) -> None:
        """Ask for the end."""
        with self._lock:
            self.code = self.code or code
            if not self.future.done():
                self.ends_by, self._asked_at = ends_by, time.monotonic()
                self.future.set_result(None)

    def fail(self, error: Exception, code: int) -> None:
        """Ask for the end because of something that was raised; nobody winds down before."""
        self.failure = error
        self.request(code)

    def _tell(self, byte: int) -> None:
        with contextlib.suppress(BlockingIOError):  # so full of signals that it looks anyway
            os.write(self._writer, bytes((byte,)))

    def _supervise(self) -> None:
        while True:
            within = min(self._look(), self._end())
            timeout = None if within == math.inf else max(within, 0.0)
            if not select.select([self._reader], [], [], timeout)[0]:
                continue
            for number in os.read(self._reader, 4096):
                if number == _CLOSE:
                    return
                self._take(number)

    def _take(self, number: int) -> None:
        if number in _STOPS:
            self._stop()
        elif number in _ENDS_WELL:
            self.request(0)
        elif number in self._taken:
            self.request(128 + number, ends_by=number)

    def _look(self) -> float:
        """Let each node look, and return when the next one wants to, in [s]."""
        return min((_attempt(node.look, math.inf) for node in self._nodes), default=math.inf)

    def _end(self) -> float:
        """Do what the executor should have done, and return until when it has time, in [s]."""
        passed = time.monotonic() - self._asked_at
        if passed < 0.0 or self.are_left:
            return math.inf
        if not self.is_heeded and not self.has_abandoned:
            if passed < ANSWERS_WITHIN:
                return ANSWERS_WITHIN - passed
            self._abandon()
        if passed < LEFT_WITHIN:
            return LEFT_WITHIN - passed
        if self._abandon():
            self._end_without_executor()
        return math.inf

    def _abandon(self) -> bool:
        """Leave all nodes, and tell whether one of them lets the process end like this."""
        self.has_abandoned = bool(self._nodes)
        may_end = [_attempt(node.abandon, False) for node in self._nodes]
        return any(may_end)

    def _end_without_executor(self) -> None:
        frame = sys._current_frames().get(threading.main_thread().ident or 0)
        where = f" at {frame.f_code.co_filename}:{frame.f_lineno}" if frame is not None else ""
        print(
            f"a callback has not returned for {LEFT_WITHIN:g} s{where}: "
            "joints were left without effort, the process ends without it",
            file=sys.stderr,
            flush=True,
        )
        os._exit(1 if self.ends_by is None else 128 + self.ends_by)

    def _stop(self) -> None:
        """Stop the process as the signal would have, with all joints left meanwhile."""
        for node in self._nodes:
            _attempt(node.hold, None)
        deadline = time.monotonic() + _HEARD_WITHIN
        for node in self._nodes:
            within = max(0.0, deadline - time.monotonic())
            _attempt(partial(node.wait_until_held, within), None)
        # To this thread: it does nothing more before the whole process stands still.
        signal.pthread_kill(threading.get_ident(), signal.SIGSTOP)
        for node in self._nodes:
            _attempt(node.go_on, None)


def _attempt(step: Callable[[], T], otherwise: T) -> T:
    """Take one node's step; whatever it raises, the other nodes have their turn."""
    try:
        return step()
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        print(
            f"{type(error).__name__}: {' '.join(str(error).split())} "
            f"({place.filename}:{place.lineno})",
            file=sys.stderr,
        )
        return otherwise


def _ignore(number: int, frame: FrameType | None) -> None:
    """Python must have a handler for the wake-up pipe to be written."""


def _taken_elsewhere() -> set[int]:
    """Return the signals that are ignored, or that something else than Python's default has."""
    masks = 0
    for line in Path("/proc/self/status").read_text().splitlines():
        name, _, value = line.partition(":")
        if name in ("SigIgn", "SigCgt"):
            masks |= int(value, 16)
    return {number for number in range(1, 65) if masks >> (number - 1) & 1} - _ALWAYS

"""How child processes begin, and how all of them are ended."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


def beginning(parting: signal.Signals, *, is_batch: bool = False) -> Callable[[], None]:
    """Return what a child runs before its program, for ``preexec_fn``.

    Args:
        parting: What the kernel sends the child when its parent is gone, however that came about.
        is_batch: Schedule it as a batch job: it yields the processor to nobody by waking
            somebody.
    """

    def begin() -> None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, parting)
        if is_batch:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))

    return begin


def end_all(processes: Iterable[subprocess.Popen[bytes]], patience: float) -> None:
    """Ask all to end with SIGTERM, then kill those that have not gone.

    Args:
        processes: The children; those that have ended are passed over.
        patience: Time for all of them to go, in [s].
    """
    running = [process for process in processes if process.poll() is None]
    for process in running:
        process.terminate()
    deadline = time.monotonic() + patience
    for process in running:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

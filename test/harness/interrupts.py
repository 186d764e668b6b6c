"""Interrupts of the process that runs the tests."""

import signal
from contextlib import contextmanager

from hpid_ros.base.processes import heed_interrupts


@contextmanager
def heeded_interrupts():
    """Heed interrupts as a command does, and leave none to whoever asks later."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    heed_interrupts()
    try:
        yield
    finally:
        heed_interrupts()
        for number, handler in before.items():
            signal.signal(number, handler)

"""Work for processes of their own, which they can import, and interrupts of the tests' own one."""

import os
import signal
import threading
from contextlib import contextmanager

from hpid_ros.base.processes import heed_interrupts

LOCK = threading.Lock()


def behind_a_lock(number):
    """Return the square of a number, and who computed it, once the lock is free."""
    with LOCK:
        return number**2, os.getpid()


def deadly(name):
    """Return a name in capitals, and die of a certain one."""
    if name == "poison":
        os.kill(os.getpid(), signal.SIGKILL)
    return name.upper()


def faulty(number):
    """Refuse a number."""
    raise ValueError(f"not {number}")


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

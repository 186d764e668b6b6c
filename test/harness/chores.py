"""Work for processes of their own: functions that such a process can import."""

import os
import signal
import threading

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

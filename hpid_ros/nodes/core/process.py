"""A node's process: scheduling, launch, end, DDS security.

``ros2 launch`` ends its processes on SIGINT; SIGTERM and SIGKILL end it alone, and what it started
would go on driving the robot. This package's launch files name themselves to what they start, and
the kernel tells it when they are gone.

With ``ROS_SECURITY_ENABLE=true`` a middleware that was built without DDS security starts all the
same, unprotected and without a word. The wheels of ROS on PyPI are built so.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import mmap
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NoReturn

from rclpy.node import Node

from hpid_ros.base.errors import SettingError
from hpid_ros.base.records import Record, quantity
from hpid_ros.nodes.core.middleware import steady_timer
from hpid_ros.nodes.core.parameters import read


@dataclass(frozen=True)
class Scheduling(Record):
    """How the threads of a node's process are scheduled."""

    realtime_priority: int = quantity(
        "SCHED_FIFO priority, 1 to 99; 0 for none", default=0, least=0, most=99
    )
    cpu_affinity: tuple[int, ...] | None = quantity(
        "CPUs to run on; all if left out", default=None
    )


ORDINARY = "ordinary"
_AGAIN_AFTER = 0.05  # [s]


def schedule(node: Node) -> str:
    """Declare the parameters ``realtime_priority`` and ``cpu_affinity``, and do what they say.

    Both hold for every thread that the process has, so this is called when the middleware's are
    there: at the end of a node's construction, and once more by a timer, as the thread that fires
    them is the last. Children that a node starts do not inherit the
    priority. A priority that the system refuses is one line in the log, no end of the process.
    """
    asked = read(node, Scheduling)
    if asked.cpu_affinity:
        _pin(asked.cpu_affinity)
    if not asked.realtime_priority:
        return ORDINARY
    scheduling = _prioritise(node, asked.realtime_priority)
    if not scheduling.startswith(ORDINARY):

        def again() -> None:
            _prioritise(node, asked.realtime_priority)
            timer.cancel()

        timer = steady_timer(node, _AGAIN_AFTER, again)
    return scheduling


def _threads() -> list[int]:
    return [int(entry.name) for entry in Path("/proc/self/task").iterdir()]


def _pin(cpus: Sequence[int]) -> None:
    allowed = sorted(os.sched_getaffinity(0))
    if not set(cpus) <= set(allowed):
        raise SettingError(f"cpu_affinity must be among the CPUs {allowed}, not {list(cpus)}")
    for thread in _threads():
        os.sched_setaffinity(thread, cpus)


def _prioritise(node: Node, priority: int) -> str:
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        for thread in _threads():
            os.sched_setscheduler(thread, policy, os.sched_param(priority))
    except PermissionError:
        node.get_logger().warning(
            f"realtime_priority {priority} is refused by the system and ordinary scheduling "
            f"stays: it needs CAP_SYS_NICE, or an rtprio limit of this user (ulimit -r) of at "
            f"least {priority}"
        )
        return f"{ORDINARY}, SCHED_FIFO {priority} was refused"
    return f"SCHED_FIFO {priority}"


LAUNCH = "HPID_ROS_LAUNCH"
"""Environment variable: the process id of the launch."""

_PR_SET_PDEATHSIG = 1


def end_with_the_launch() -> None:
    """Get SIGTERM when the launch has ended, however that came about; on Linux."""
    launch = os.environ.get(LAUNCH)
    if launch is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if not Path("/proc", launch).exists():  # it was gone before
        os.kill(os.getpid(), signal.SIGTERM)


_TORN_DOWN_WITHIN = 15.0  # [s]
_SIGEV_THREAD = 2


class _TimerEvent(ctypes.Structure):
    """A ``sigevent`` of Linux that has a function called in a thread of its own."""

    _fields_: ClassVar = [
        ("value", ctypes.c_void_p),  # what it is called with
        ("signal", ctypes.c_int),
        ("kind", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("rest", ctypes.c_char * 40),
    ]


def end_in_time(code: int) -> None:
    """Have this process end with a code, and print where it stands, if it takes long from here on.

    To be called when every node has been closed: what is left is the middleware's. Fast DDS can
    wait there for a callback that it keeps from the lock (docs/faults.md), while rclpy holds
    Python's: nothing in Python could end the process.
    """
    libc, timer = ctypes.CDLL(None), ctypes.c_void_p()
    function = ctypes.cast(libc["_exit"], ctypes.c_void_p).value
    event = _TimerEvent(code, 0, _SIGEV_THREAD, function)
    seconds, part = divmod(_TORN_DOWN_WITHIN + 0.5, 1.0)
    once = (ctypes.c_long * 4)(0, 0, int(seconds), int(part * 1e9))
    is_refused = libc.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer))
    faulthandler.dump_traceback_later(_TORN_DOWN_WITHIN, exit=bool(is_refused))
    if not is_refused:
        libc.timer_settime(timer, 0, ctypes.byref(once), None)
    _flush()  # which may wait for somebody to read


def end(code: int) -> NoReturn:
    """End this process at once, without what the interpreter and the libraries do at their ends.

    There Python's objects, the statics of Fast DDS and threads that are still running go in no
    order: about once in a thousand ends on a busy machine a process crashed or stood still for
    ever, with all of its work done.
    """
    _flush()
    os._exit(code)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # nobody reads it any more
            stream.flush()
    ctypes.CDLL(None).fflush(None)


_MIDDLEWARES = ("libfastrtps.so", "libfastdds.so")
_MARK = b"dds.sec.auth.plugin"  # the property that names the authentication plugin


def warn_if_unprotected(node: Node) -> None:
    """Log one warning when security was asked for and the loaded Fast DDS has none."""
    if os.environ.get("ROS_SECURITY_ENABLE", "").lower() != "true":
        return
    library = _loaded_middleware()
    if library is None:
        return
    with library.open("rb") as stream, mmap.mmap(stream.fileno(), 0, prot=mmap.PROT_READ) as data:
        has_security = data.find(_MARK) >= 0
    if not has_security:
        node.get_logger().warning(
            "ROS_SECURITY_ENABLE is set, but this Fast DDS was built without security: nothing is "
            "authenticated or encrypted, and anybody on the network can command this node"
        )


def _loaded_middleware(maps: Path = Path("/proc/self/maps")) -> Path | None:
    """Return the Fast DDS library of this process; None when another middleware is loaded."""
    for line in maps.read_text().splitlines():
        path = Path(line.rpartition(" ")[2])
        if path.name.startswith(_MIDDLEWARES):
            return path
    return None

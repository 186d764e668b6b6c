"""Lines for a parent process, and lines on ``/diagnostics``.

A parent that runs nodes as children needs to know when they are ready and when they are done,
before and after there is a graph to ask. Each event is one JSON object on one line.
"""

from __future__ import annotations

import json
import os
import select
import stat
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from hpid_ros.base.records import Record, quantity
from hpid_ros.base.text import LineBudget, bounded
from hpid_ros.nodes.core.middleware import RARE
from hpid_ros.nodes.core.parameters import read


def _fifos() -> frozenset[int]:
    found = set()
    for descriptor in range(_HIGHEST):
        try:
            if stat.S_ISFIFO(os.fstat(descriptor).st_mode):
                found.add(descriptor)
        except OSError:  # not open
            continue
    return frozenset(found)


_HIGHEST = 1024  # the usual limit
_INHERITED = _fifos()  # before this process has opened any of its own
_WAITING = 1000  # lines, for a parent that does not read


class _EventPipe:
    """Lines for a parent, from all nodes of a process, none of which it makes wait.

    What a full pipe does not take waits for the next line, the last thousand lines of it.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._room = select.poll()
        self._room.register(fd, select.POLLOUT)
        self._begun = b""
        self._lines: deque[bytes] = deque(maxlen=_WAITING)
        self._lock = threading.Lock()

    def put(self, line: bytes) -> None:
        with self._lock:
            self._lines.append(line)
            self._write(0.0)

    def flush(self, within: float) -> None:
        with self._lock:
            self._write(within)

    def _write(self, within: float) -> None:
        deadline = time.monotonic() + within
        while self._fd >= 0 and (self._begun or self._lines):
            self._begun = self._begun or self._lines.popleft()
            if not self._room.poll(max(0.0, deadline - time.monotonic()) * 1e3):
                return
            try:  # a pipe with room has it for so many bytes
                written = os.write(self._fd, self._begun[: select.PIPE_BUF])
            except OSError:  # the parent is gone; the node's own stop is not this pipe's business
                self._fd = -1
                return
            self._begun = self._begun[written:]


_PIPES: dict[int, _EventPipe] = {}


def flush_events(within: float) -> None:
    """Give a parent that is slow to read this long to take what waits for it."""
    for pipe in _PIPES.values():
        pipe.flush(within)


@dataclass(frozen=True)
class StatusParameters(Record):
    """Where a parent process reads."""

    status_fd: int = quantity(
        "File descriptor for one JSON line per event; -1 for none", default=-1, least=-1
    )


class StatusPipe:
    """Writes events for a parent process, if there is one, and never waits for a reader."""

    def __init__(self, node: Node) -> None:
        fd = read(node, StatusParameters).status_fd
        # The parameters of a node that had a parent may have been dumped and given to this one.
        self._pipe = None
        if fd in _INHERITED:
            self._pipe = _PIPES[fd] = _PIPES.get(fd) or _EventPipe(fd)

    def send(self, event: str, **values: object) -> None:
        if self._pipe is not None:
            self._pipe.put((json.dumps({"event": event, **values}) + "\n").encode())


LONGEST_FAULT = 1000
"""Characters of a line about a message: it may come again and again."""

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR


_DIAGNOSTICS: WeakKeyDictionary[Node, Diagnostics] = WeakKeyDictionary()


def note_failure(node: Node, line: str) -> None:
    """Note that a message has met an error, in a node's log and in its status if it has one."""
    diagnostics = _DIAGNOSTICS.get(node)
    if diagnostics is None:
        node.get_logger().warning(bounded(line, LONGEST_FAULT), throttle_duration_sec=1.0)
        return
    diagnostics.failed_messages += 1
    diagnostics.fault(line)


_BUDGETS: WeakKeyDictionary[Node, LineBudget] = WeakKeyDictionary()


def log_change(node: Node, line: str, *, is_warning: bool = False) -> None:
    """Log that something has changed; what changes all the time is not logged each time."""
    budget = _BUDGETS.setdefault(node, LineBudget())
    line = budget.admitted(bounded(line, LONGEST_FAULT), time.monotonic())
    if not line:
        return
    if is_warning:  # rclpy wants a line of its own for each severity
        node.get_logger().warning(line)
    else:
        node.get_logger().info(line)


class Diagnostics:
    """Publishes a node's status, and notes what has gone wrong."""

    def __init__(self, node: Node, hardware_id: str) -> None:
        self._node = node
        self._hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", RARE)
        self.last_fault = "none"
        self.refused_requests = self.failed_messages = 0
        _DIAGNOSTICS[node] = self

    def refuse(self, line: str) -> None:
        self.refused_requests += 1
        self.fault(line)

    def fault(self, line: str) -> None:
        """Note one line for what could not be used, and log it if none was just logged."""
        self.last_fault = line = bounded(line, LONGEST_FAULT)
        self._node.get_logger().warning(line, throttle_duration_sec=1.0)

    def warn(self, line: str) -> None:
        """Note and log one line for what has changed for the worse, whatever was logged before."""
        self.last_fault = bounded(line, LONGEST_FAULT)
        log_change(self._node, line, is_warning=True)

    def error(self, line: str) -> None:
        """Note and log one line for what is wrong now, whatever was logged before it."""
        self.last_fault = line = bounded(line, LONGEST_FAULT)
        if line := _BUDGETS.setdefault(self._node, LineBudget()).admitted(line, time.monotonic()):
            self._node.get_logger().error(line)

    def publish(self, level: bytes, message: str, values: Mapping[str, object]) -> None:
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name(),
            message=bounded(message),
            hardware_id=self._hardware_id,
            values=[
                KeyValue(key=key, value=_text(value))
                for key, value in {**values, "failed messages": self.failed_messages}.items()
            ],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else bounded(str(value))

"""How a process of nodes starts, spins and stops.

``EventsExecutor`` is several times faster than the wait-set executors. Two of its traits need
care: ``spin()`` without a deadline starves callbacks, so it is always given one; and with
rclpy's own signal handlers the context is dead before a last command could be sent. Signals
are therefore taken through a wake-up pipe, which works while the executor is idle, and end the
spinning; the nodes close while the context still lives, and the context is shut down last.
"""

from __future__ import annotations

import gc
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

import rclpy
from rclpy.exceptions import (
    InvalidParameterTypeException,
    NameValidationException,
    ParameterException,
)
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from hpid_ros.errors import HpidError, SettingError, unknown_name
from hpid_ros.foreign_text import shown
from hpid_ros.nodes.middleware import load_profile
from hpid_ros.nodes.security import warn_if_unprotected

BAD_INPUT = 2
"""Exit code of a process whose parameters or arguments cannot be used."""

FAILED = 1
"""Exit code of a process that a callback ended."""

_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_WIND_DOWN_WITHIN = 4.5  # [s] from the request to the close of the nodes
_DEADLINE = 86400.0  # [s]; any finite one: spinning goes on when it passes


class Stop:
    """The end of a process: asked for by a signal or by a node, once."""

    def __init__(self) -> None:
        self.future: Future = Future()
        self.code = 0

    def request(self, code: int = 0) -> None:
        """Ask for the end.

        Args:
            code: Exit code of the process; the first that is not zero decides, also when it
                comes after the end was asked for: what fails while closing has failed.
        """
        self.code = self.code or code
        if not self.future.done():
            self.future.set_result(None)


class ClosingNode(Node):
    """A node that has something to do before its context is gone."""

    stop: Stop | None = None

    def wind_down(self) -> Future | None:
        """Begin what takes time before the end; called once, while spinning goes on.

        Returns:
            What is done when the node may be closed; None if it may be now.
        """
        return None

    def leave_at_once(self) -> None:
        """Send what must not be late; called once, on all nodes before any of them is closed."""

    def close(self) -> None:
        """Send or write what must not be lost; called once, while the context is alive."""

    def request_stop(self, code: int = 0) -> None:
        """End this node's process.

        Args:
            code: Exit code of the process.
        """
        if self.stop is not None:
            self.stop.request(code)


def run(make_nodes: Callable[[], Sequence[ClosingNode]], args: Sequence[str] | None = None) -> int:
    """Run nodes until a signal or one of them ends the process.

    Args:
        make_nodes: Makes the nodes once the context is there.
        args: Command line with ROS arguments; None for that of the process.

    Returns:
        The exit code: 0 after a signal, 1 when a callback raised, 2 when arguments or parameters
        cannot be used. Whatever it is, every node has been closed while the graph was there.
    """
    command_line = list(sys.argv if args is None else args)
    load_profile()
    try:
        surplus = remove_ros_args(command_line)[1:]
        if surplus:
            what = " ".join(surplus)
            return _refuse(f"unknown arguments {what}; parameters follow --ros-args -p")
        rclpy.init(args=command_line, signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:
        return _refuse(_ros_error(error))
    try:
        with _signals_to(Stop()) as stop:
            return _run_in_context(make_nodes, stop)
    finally:
        rclpy.try_shutdown()


def _run_in_context(make_nodes: Callable[[], Sequence[ClosingNode]], stop: Stop) -> int:
    try:
        nodes = make_nodes()
        _require_known_parameters(nodes)
        warn_if_unprotected(nodes[0])  # one of them speaks for the process
    except (HpidError, ParameterException, NameValidationException) as error:
        return _refuse(_input_error(error))
    executor = _make_executor()
    for node in nodes:
        node.stop = stop
        executor.add_node(node)
    # What is there now stays: no collection looks at it again while the loop runs.
    gc.collect()
    gc.freeze()
    try:
        while not stop.future.done():
            executor.spin_until_future_complete(stop.future, _DEADLINE)
        _wind_down(executor, nodes)
    except HpidError as error:  # what only the graph shows, for instance a topic's type
        stop.request(_refuse(str(error)))
    except Exception as error:  # whatever it was, the nodes are closed and their joints left
        stop.request(_fail(error))
    finally:
        # No node waits in its close for what another one still has to send.
        is_closed = [_done(node.leave_at_once) for node in nodes]
        is_closed += [_done(node.close) for node in nodes]
    return stop.code or int(not all(is_closed))


def _wind_down(executor: Executor, nodes: Sequence[ClosingNode]) -> None:
    """Go on spinning until all nodes may be closed, or have had long enough."""
    deadline = time.monotonic() + _WIND_DOWN_WITHIN
    for waited in [node.wind_down() for node in nodes]:
        if waited is not None:
            executor.spin_until_future_complete(waited, max(0.0, deadline - time.monotonic()))


def _done(step: Callable[[], None]) -> bool:
    """Take one step of a node's end; whatever that raises, the other nodes end, too."""
    try:
        step()
    except Exception as error:
        _fail(error)
        return False
    return True


def _fail(error: Exception) -> int:
    """Print one line for an error that nobody expected: what, and where."""
    place = traceback.extract_tb(error.__traceback__)[-1:]
    where = f" ({place[0].filename}:{place[0].lineno})" if place else ""
    print(shown(f"{type(error).__name__}: {' '.join(str(error).split())}{where}"), file=sys.stderr)
    return FAILED


def _make_executor() -> Executor:
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        get_logger("hpid_ros").warning(
            "this rclpy has no EventsExecutor; SingleThreadedExecutor is several times slower"
        )
        return SingleThreadedExecutor()
    return EventsExecutor()


def _require_known_parameters(nodes: Sequence[Node]) -> None:
    """Refuse parameters that were given and that no node of the process has.

    rclpy ignores them silently, and a mistyped gain would be a gain of zero. What is given on
    the command line goes to every node of a process, so it is enough that one of them has it.
    """
    everywhere = {name for node in nodes for name in node._parameters}
    for node in nodes:
        for name in node._parameter_overrides:  # rclpy has no public way to ask what was given
            if name not in everywhere and not name.startswith("qos_overrides."):
                known = [p for p in everywhere if not p.startswith("qos_overrides.")]
                raise SettingError(f"{node.get_name()}: {unknown_name('parameter', name, known)}")


def _input_error(error: Exception) -> str:
    """Return one line for an error of parameters or names."""
    line = " ".join(str(error).split())
    if isinstance(error, InvalidParameterTypeException) and "'INTEGER', expecting" in line:
        return f"{line} (numbers with a fraction are written 1.0, not 1)"
    return line.rstrip(" ^")


def _ros_error(error: Exception) -> str:
    """Return one line for an error of rcl, without the places in its source."""
    line = " ".join(re.sub(r"\s*, at /\S+:\d+", "", str(error)).split())
    return f"unknown ROS arguments {line}" if line.startswith("[") else line


def _refuse(line: str) -> int:
    print(shown(line), file=sys.stderr)
    return BAD_INPUT


@contextmanager
def _signals_to(stop: Stop) -> Iterator[Stop]:
    """Turn what asks for the end of the process into it, from a thread that reads a pipe."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def wait() -> None:
        while os.read(reader, 1) not in (b"", b"\0"):
            stop.request(0)

    def ignore(number: int, frame: FrameType | None) -> None:
        """Python must have a handler for the wake-up pipe to be written."""

    for number in _ENDS:
        if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # nohup
            signal.signal(number, ignore)
    before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    thread = threading.Thread(target=wait, name="signals", daemon=True)
    thread.start()
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(before)
        # The process is ending: a second signal, as launch sends it, must not spoil that.
        for number in _ENDS:
            signal.signal(number, signal.SIG_IGN)
        os.write(writer, b"\0")
        thread.join()
        os.close(reader)
        os.close(writer)

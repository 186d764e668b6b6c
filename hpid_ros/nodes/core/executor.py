"""The life of a process of nodes: usage, start, spinning, supervision, end.

``EventsExecutor`` is several times faster than the wait-set executors. Two of its traits need
care: ``spin()`` without a deadline starves callbacks, so it is always given one; and with
rclpy's own signal handlers the context is dead before a last command could be sent. Signals
are therefore taken by a :class:`.Supervisor`, and end the spinning; the
nodes close while the context still lives, and the context is shut down last.

The supervisor's thread reads the signals from a wake-up pipe, which the interpreter writes at
once, whatever the executor does, and has nodes check what must not wait for the executor. It needs
Python's lock: a callback that runs long or blocks in the system gives it away, one that computes
in C without giving it away does not, and nothing in the process helps against that.

What each signal does: docs/safety.md, section 7. One that has a handler when the process begins,
or gets one later, keeps it.
"""

from __future__ import annotations

import contextlib
import gc
import inspect
import math
import os
import re
import select
import signal
import sys
import textwrap
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeVar

import rclpy
from rcl_interfaces.msg import ParameterValue
from rclpy.exceptions import (
    InvalidHandle,
    InvalidParameterValueException,
    NameValidationException,
    ParameterException,
)
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from hpid_ros.base.errors import ClaimError, HpidError, RunError, SettingError, reason_of
from hpid_ros.base.libraries import optional_libraries
from hpid_ros.base.text import shown
from hpid_ros.nodes.core.middleware import load_profile
from hpid_ros.nodes.core.parameters import (
    ParameterSources,
    as_declared,
    declared_names,
    require_known_parameters,
)
from hpid_ros.nodes.core.process import end, end_in_time, end_with_the_launch, warn_if_unprotected
from hpid_ros.nodes.core.rclpy_internals import LineLogger, given_parameters
from hpid_ros.nodes.core.services import Answers, guard_services
from hpid_ros.nodes.core.status import flush_events, note_failure

T = TypeVar("T")
U = TypeVar("U")

_HELP = ("-h", "--help")


@dataclass(frozen=True)
class Usage:
    """An executable in a few lines."""

    name: str  # of the executable
    about: str  # what it does, in one sentence
    needs: str = ""  # parameters that must be given, as an example, for instance -p joint:=elbow
    parameters: Sequence[str] = ()  # names of all parameters; motor.* is a group of them
    subscribes: Sequence[str] = ()  # topics
    publishes: Sequence[str] = ()  # topics
    services: Sequence[str] = ()  # but those of every node

    def print(self) -> None:
        """Print all of it; a reader of the first lines alone (``head``) is no error."""
        try:
            print(self.text(), flush=True)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    def text(self) -> str:
        needs = f" {self.needs}" if self.needs else ""
        lists = {
            "parameters": self.parameters,
            "subscribes to": self.subscribes,
            "publishes": self.publishes,
            "services": self.services,
        }
        paragraphs = [f"{what}: {', '.join(names)}" for what, names in lists.items() if names]
        usage = (
            f"usage: {self.name} --ros-args{needs} [-p NAME:=VALUE]... [--params-file FILE]... "
            "[-r __ns:=/NAMESPACE]"
        )
        where = (
            "ros2 param describe tells of a running node what each parameter is; "
            "docs/interfaces.md has all of them."
        )
        hanging = [_HANGING.fill(text) for text in paragraphs]
        about = [_FILL(self.about), "", *hanging, "", _FILL(where)]
        return "\n".join([_HANGING.fill(usage), "", *about])


_WIDTH = 80  # columns of the help of a node
_FILL = partial(textwrap.fill, width=_WIDTH)
_HANGING = textwrap.TextWrapper(
    _WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
)

BAD_INPUT = 2
"""Exit code of a process whose parameters or arguments cannot be used."""

FAILED = 1
"""Exit code of a process that a callback ended, or whose joint another controller holds."""

_ENDING = (ClaimError, RunError)  # they end a process wherever they are raised
_STOPS_WITHIN = 4.5  # [s] from the request to the close of the nodes
_EVENTS_WITHIN = 0.5  # [s] for a parent that is slow to read
_SWITCH_INTERVAL = 5e-4  # [s]; how late another thread (a decoder) makes a sample
_DEADLINE = 86400.0  # [s]; any finite one: spinning goes on when it passes


_made: list[Node] = []  # of this process, in part or in whole


def note_made(node: Node) -> None:
    """Note a node before it is built: also one that is refused half-way is destroyed."""
    _made.append(node)


def names_of_nodes() -> set[str]:
    """Return the full names of this process's nodes."""
    return {str(each.get_fully_qualified_name()) for each in _made}


class ClosingNode(Node):
    """A node that has something to do before its context is gone.

    Its parameters are taken in the types that it declares, and no request brings it down.
    """

    supervisor: Supervisor | None = None
    sources = ParameterSources()  # where the parameters of this process come from, see run

    def __init__(self, name: str, **options: Any) -> None:
        note_made(self)
        super().__init__(name, **options)
        self.guard(lambda line: self.get_logger().warning(line, throttle_duration_sec=1.0))

    @cached_property
    def _lines(self) -> LineLogger:
        return LineLogger(super().get_logger().name)

    def get_logger(self) -> LineLogger:
        """Return the node's logger, each message of which is one line."""
        return self._lines

    def guard(self, fault: Callable[[str], None]) -> None:
        """Guard the services that are there; for nodes that rclpy builds in a way of its own."""
        guard_services(self, fault)
        self.sources.require_namespace(self)

    def require_given(self, *names: str) -> None:
        """Refuse a default where parameter files were given, and one has nothing for this node."""
        lines = self.sources.without([self])
        if lines and not given_parameters(self).keys() & set(names):
            raise SettingError(f"{' or '.join(names)} must be given: {lines[0]}")

    def declare_parameters(
        self, namespace: str, parameters: list[Any], ignore_override: bool = False
    ) -> list[Parameter]:
        """Declare parameters, as rclpy does; what was given for them is read in their types."""
        given = given_parameters(self)
        for name, default, *_ in parameters:
            full = f"{namespace}.{name}" if namespace else name
            if full not in given:
                continue
            try:
                read = as_declared(given[full], _type_of(default))
            except SettingError as error:
                raise SettingError(f"{self.get_name()}: {error}") from None
            given[full] = read
            if read.type_ == Parameter.Type.NOT_SET:  # as if it had not been given
                del given[full]
        try:
            return list(super().declare_parameters(namespace, parameters, ignore_override))
        except InvalidParameterValueException as error:
            raise SettingError(f"{self.get_name()}: {_reason(error)}") from None

    def create_publisher(self, kind: Any, topic: str, qos: Any, **options: Any) -> Publisher:
        """Create a publisher, as rclpy does; overrides change no profile but its own."""
        return super().create_publisher(kind, topic, copy(qos), **options)

    def create_subscription(
        self, kind: Any, topic: str, callback: Any, qos: Any, **options: Any
    ) -> Subscription:
        """Create a subscription, as rclpy does; overrides change no profile but its own.

        No message on it ends the process (:meth:`guarded`).
        """
        guarded = self.guarded(topic, callback)
        return super().create_subscription(kind, topic, guarded, copy(qos), **options)

    def guarded(self, topic: str, callback: Callable[[Any], T]) -> Callable[[Any], T | None]:
        """Return what calls back with a message; one that meets an error of any kind is refused.

        What is no matter of the message is raised: a joint that is another's, a run that failed.
        """

        def take(message: Any) -> T | None:
            try:
                return callback(message)
            except _ENDING:
                raise
            except Exception as error:
                self.refuse_message(topic, reason_of(error))
                return None

        return take

    def refuse_message(self, topic: str, reason: str) -> None:
        """Note that a message on a topic has met an error; on any thread."""
        note_failure(self, f"a message on {topic} is refused: {reason}")

    def begin_stop(self) -> Future | None:
        """Begin what takes time before the end; called once, while spinning goes on."""
        return None

    def stop_now(self) -> None:
        """Send what must not be late; called once, on all nodes before any of them is closed."""

    def close(self) -> None:
        """Send or write what must not be lost; called once, while the context is alive."""

    def request_stop(self, code: int = 0) -> None:
        if self.supervisor is not None:
            self.supervisor.request(code)

    def hand_over(self, callback: Callable[..., None], *arguments: object) -> None:
        """Have the executor's thread call something soon that follows from a message.

        From any thread; an error in it refuses the message (:meth:`guarded`).
        """
        executor = self.executor
        if executor is not None:  # else the node has ended
            executor.create_task(self._call, callback, arguments)

    def _call(self, callback: Callable[..., None], arguments: Sequence[object]) -> None:
        try:
            callback(*arguments)
        except _ENDING as error:  # in a task it would crash the EventsExecutor of Jazzy
            if self.supervisor is None:
                raise
            self.supervisor.fail(error, _exit_code(error))
        except Exception as error:
            note_failure(self, f"refused: {reason_of(error)}")

    # What follows is called on the supervisor's thread, also while a callback does not return.

    def check(self) -> float:
        """Do what must not wait for the executor, and return when to check again, in [s]."""
        return math.inf

    def cut_effort(self) -> bool:
        """Leave joints without effort until :meth:`restore_effort`, if that is ever called.

        Returns whether the process may now end without the executor.
        """
        return False

    def wait_until_cut(self, within: float) -> None:
        """Wait until that has been acknowledged, for at most so many seconds."""

    def restore_effort(self) -> None:
        """Go on after :meth:`cut_effort`."""


def _type_of(default: object) -> Parameter.Type:
    """Return the type that a parameter is declared with."""
    if isinstance(default, Parameter.Type):
        return default
    if isinstance(default, ParameterValue):
        return Parameter.Type(default.type)
    return Parameter.Type.from_parameter_value(default)


_HEEDED_WITHIN = 0.25  # [s] for the executor to begin a stop; then joints are left without it
_LEFT_WITHIN = 4.75  # [s] for all joints to be left; then the process ends without the executor
_CLOSED_WITHIN = 60.0  # [s] for each other thing, as a recorder's close; then it ends as well
_CHECKED_AGAIN = 0.1  # [s] after a check that raised something
_STOOD_STILL = 1.0  # [s] by which this thread is late, if the process was stopped
_CUT_WITHIN = 0.5  # [s] for all subscribers to acknowledge, before the process is suspended
_SAID_WITHIN = 0.5  # [s] for a last line to be written

_ENDS_WELL = frozenset((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
_ALWAYS = frozenset((signal.SIGINT, signal.SIGTERM))  # also where a shell had them ignored
_STOPS = frozenset((signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU))
_LEFT_ALONE = frozenset(
    (
        signal.SIGKILL,
        signal.SIGSTOP,  # nobody can catch them
        signal.SIGCHLD,
        signal.SIGCONT,
        signal.SIGURG,
        signal.SIGWINCH,  # they end nothing
        # The process has crashed, or a debugger is at it.
        signal.SIGSEGV,
        signal.SIGABRT,
        signal.SIGBUS,
        signal.SIGFPE,
        signal.SIGILL,
        signal.SIGTRAP,
        signal.SIGSYS,
    )
)
_CLOSE, _CHECK_AGAIN = 0, 255  # on the pipe, which else has the numbers of signals


class Supervisor:
    """The end of a process, asked for once by a signal or a node, and the thread behind it."""

    def __init__(self) -> None:
        self.future: Future = Future()
        self.code = 0
        self.ends_by: int | None = None
        self.failure: Exception | None = None
        self.is_heeded = self.are_left = self.has_cut_effort = False
        self._nodes: Sequence[ClosingNode] = ()
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

    def __exit__(self, *_: object) -> None:
        """Take no more: the process ends, and a second signal must not spoil that."""
        signal.set_wakeup_fd(self._before)
        for number in self._taken:
            if signal.getsignal(number) is _ignore:
                signal.signal(number, signal.SIG_IGN)
        self._wake(_CLOSE)
        self._thread.join()
        os.close(self._reader)
        os.close(self._writer)

    def supervise(self, nodes: Sequence[ClosingNode]) -> None:
        """Look after these nodes from now on; the executor's time begins now."""
        self._nodes = nodes
        if self.future.done():
            self._asked_at = time.monotonic()
        self.check_again()

    def check_again(self) -> None:
        """Ask the nodes again when to check: something has changed."""
        self._wake(_CHECK_AGAIN)

    def request(self, code: int = 0, ends_by: int | None = None) -> None:
        with self._lock:
            self.code = self.code or code
            if not self.future.done():
                self.ends_by, self._asked_at = ends_by, time.monotonic()
                self.future.set_result(None)

    def go_on(self) -> None:
        """Note that something has ended: the next has its own time."""
        with self._lock:
            self._asked_at = time.monotonic()

    def fail(self, error: Exception, code: int) -> None:
        """Ask for the end because of an error; the nodes do not begin a stop before."""
        self.failure = error
        self.request(code)

    def _wake(self, byte: int) -> None:
        with contextlib.suppress(BlockingIOError):  # so full of signals that it wakes anyway
            os.write(self._writer, bytes((byte,)))

    def _supervise(self) -> None:
        while True:
            checks = [_attempt(node.check, _CHECKED_AGAIN) for node in self._nodes]
            within = min(*checks, self._end(), math.inf)
            timeout = None if within == math.inf else max(within, 0.0)
            begun = time.monotonic()
            has_more = select.select([self._reader], [], [], timeout)[0]
            if timeout is not None:
                self._excuse(time.monotonic() - begun - timeout)
            if not has_more:
                continue
            for number in os.read(self._reader, 4096):
                if number == _CLOSE:
                    return
                if number in _STOPS:
                    self._suspend()
                elif number in _ENDS_WELL:
                    self.request(0)
                elif number in self._taken:
                    self.request(128 + number, ends_by=number)

    def _excuse(self, stood: float) -> None:
        """Give a stop the time back in which the process seems to have been stopped, in [s]."""
        if self.is_heeded and stood > _STOOD_STILL:
            with self._lock:
                self._asked_at += stood

    def _end(self) -> float:
        """Do what the executor should have done, and return until when it has time, in [s]."""
        passed = time.monotonic() - self._asked_at
        if passed < 0.0:
            return math.inf
        if not self.are_left:
            if not self.is_heeded and not self.has_cut_effort:
                if passed < _HEEDED_WITHIN:
                    return _HEEDED_WITHIN - passed
                self._cut_effort()
            if passed < _LEFT_WITHIN:
                return _LEFT_WITHIN - passed
            if self._cut_effort():
                self._end_without_executor("joints were left without effort, ", _LEFT_WITHIN)
        if passed < _CLOSED_WITHIN:
            return _CLOSED_WITHIN - passed
        self._end_without_executor("", _CLOSED_WITHIN)

    def _cut_effort(self) -> bool:
        """Leave all joints for ever, and return whether a node lets the process end like this."""
        self.has_cut_effort = True  # before: the executor must not begin a stop meanwhile
        may_end = [_attempt(node.cut_effort, False) for node in self._nodes]  # all of them
        self.has_cut_effort = any(may_end)
        return self.has_cut_effort

    def _end_without_executor(self, done: str, within: float) -> NoReturn:
        frame = sys._current_frames().get(threading.main_thread().ident or 0)
        where = f" at {frame.f_code.co_filename}:{frame.f_lineno}" if frame is not None else ""
        line = (
            f"a callback has not returned for {within:g} s{where}: "
            f"{done}the process ends without it"
        )
        saying = threading.Thread(target=_say, args=(line,), daemon=True)
        saying.start()
        saying.join(_SAID_WITHIN)  # whoever should read it may stand still
        os._exit(1 if self.ends_by is None else 128 + self.ends_by)

    def _suspend(self) -> None:
        """Stop the process as the signal would have, with all joints left meanwhile."""
        for node in self._nodes:
            _attempt(node.cut_effort, False)
        deadline = time.monotonic() + _CUT_WITHIN
        for node in self._nodes:
            within = max(0.0, deadline - time.monotonic())
            _attempt(partial(node.wait_until_cut, within), None)
        # To this thread: it does nothing more before the whole process stands still.
        begun = time.monotonic()
        signal.pthread_kill(threading.get_ident(), signal.SIGSTOP)
        self._excuse(time.monotonic() - begun)
        if not self.has_cut_effort:
            for node in self._nodes:
                _attempt(node.restore_effort, None)


def _attempt(step: Callable[[], T], otherwise: U) -> T | U:
    """Take one node's step; whatever it raises, the other nodes have their turn."""
    try:
        return step()
    except Exception as error:
        _fail(error)
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


def run(
    make_nodes: Callable[[], Sequence[ClosingNode]],
    args: Sequence[str] | None = None,
    usage: Usage | None = None,
    niceness: int = 0,
) -> int:
    """Run nodes until a signal or one of them ends the process.

    It returns, with the exit code, where it does not come to that: after the help, or because of
    arguments that cannot be used.
    """
    command_line = list(sys.argv if args is None else args)
    try:
        surplus = remove_ros_args(command_line)[1:]
        if usage is not None and any(argument in _HELP for argument in surplus):
            usage.print()
            return 0
        end_with_the_launch()
        load_profile()
        if surplus:
            what = " ".join(surplus)
            return _refuse(f"unknown arguments {what}; parameters follow --ros-args -p")
        os.nice(niceness)
        rclpy.init(args=command_line, signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:
        return _refuse(_ros_error(error))
    _run_to_the_end(make_nodes, command_line)


def _run_to_the_end(
    make_nodes: Callable[[], Sequence[ClosingNode]], command_line: Sequence[str]
) -> NoReturn:
    code = FAILED
    try:
        with Supervisor() as supervisor:
            code = _run_in_context(make_nodes, command_line, supervisor)
        flush_events(_EVENTS_WITHIN)
        end_in_time(code)
        for node in _made:
            _destroy(node)
        rclpy.try_shutdown()
        if supervisor.ends_by is not None:
            _end_by(supervisor.ends_by)
    except Exception as error:
        code = _fail(error)
    finally:
        end(code)


def _end_by(number: int) -> None:
    """End by a signal, so that a parent sees it as if it had not been caught."""
    sys.stdout.flush()
    sys.stderr.flush()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def _run_in_context(
    make_nodes: Callable[[], Sequence[ClosingNode]],
    command_line: Sequence[str],
    supervisor: Supervisor,
) -> int:
    try:
        ClosingNode.sources = ParameterSources(command_line)
        with optional_libraries():
            nodes = make_nodes()
        require_known_parameters(
            [
                (each.get_name(), set(given_parameters(each)), declared_names(each))
                for each in nodes
            ]
        )
        for line in ClosingNode.sources.without(nodes):
            nodes[0].get_logger().warning(line)
        warn_if_unprotected(nodes[0])  # one of them speaks for the process
    except (HpidError, ParameterException, NameValidationException) as error:
        return _refuse(_input_error(error), _exit_code(error))
    executor = _make_executor()
    for node in nodes:
        node.supervisor = supervisor
        Answers(node).cover()
        executor.add_node(node)
    # rclpy asks inspect who logs, which reads all modules the first time: 40 ms of a loop's time.
    inspect.stack()
    # What is there now stays: no collection looks at it again while the loop runs.
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    supervisor.supervise(nodes)
    try:
        while not supervisor.future.done():
            executor.spin_until_future_complete(supervisor.future, _DEADLINE)
        if supervisor.failure is not None:
            raise supervisor.failure
        if not supervisor.has_cut_effort:
            _stop(executor, nodes, supervisor)
            if supervisor.failure is not None:  # meanwhile
                raise supervisor.failure
    except HpidError as error:  # what only the graph shows, for instance a topic's type
        supervisor.request(_refuse(str(error), _exit_code(error)))
    except Exception as error:  # whatever it was, the nodes are closed and their joints left
        supervisor.request(_fail(error))
    finally:
        supervisor.is_heeded = True
        # No node waits in its close for what another one still has to send.
        failed = [_attempt(node.stop_now, FAILED) for node in nodes]
        supervisor.are_left = True
        for node in nodes:
            supervisor.go_on()
            failed.append(_attempt(node.close, FAILED))
        code = supervisor.code or int(any(failed))
        end_in_time(code)  # what is left is the middleware's
        _attempt(executor.shutdown, None)
    return code


def _stop(executor: Executor, nodes: Sequence[ClosingNode], supervisor: Supervisor) -> None:
    """Go on spinning until all nodes may be closed, or have had long enough."""
    deadline = time.monotonic() + _STOPS_WITHIN
    waits = [node.begin_stop() for node in nodes]
    supervisor.is_heeded = True
    for waited in waits:
        if waited is not None:
            executor.spin_until_future_complete(waited, max(0.0, deadline - time.monotonic()))


def _destroy(node: Node) -> None:
    """Destroy a node: a process that ends with its participant alive stalls all others' discovery.

    Fast DDS takes a participant in shared memory that has gone without a word for a listener that
    is stuck, and opens again all that it listened to (docs/faults.md).
    """
    with contextlib.suppress(AttributeError, InvalidHandle):  # half made, or destroyed already
        node.destroy_node()


def _fail(error: Exception) -> int:
    """Print one line for an unexpected error: what, and where."""
    place = traceback.extract_tb(error.__traceback__)[-1:]
    where = f" ({place[0].filename}:{place[0].lineno})" if place else ""
    _say(f"{type(error).__name__}: {' '.join(str(error).split())}{where}")
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


def _input_error(error: Exception) -> str:
    """Return one line for an error of parameters or names."""
    return " ".join(str(error).split()).rstrip(" ^")


def _reason(error: InvalidParameterValueException) -> str:
    """Return what is wrong with a value, without what rclpy writes around it."""
    line = _input_error(error)
    reason, _, name = line.partition("Reason: ")[2].rpartition(": ")
    return reason if name and name in reason else line


def _ros_error(error: Exception) -> str:
    """Return one line for an error of rcl, without the places in its source."""
    line = " ".join(re.sub(r"\s*, at /\S+:\d+", "", str(error)).split())
    if "Sequence should be of same type" in line:
        line += "; without quotes y, n, yes, no, on and off are booleans to ROS"
    return f"unknown ROS arguments {line}" if line.startswith("[") else line


def _refuse(line: str, code: int = BAD_INPUT) -> int:
    _say(line)
    return code


def _say(line: str) -> None:
    """Print a line for whoever still reads it: the end of the process does not wait for that."""
    with contextlib.suppress(OSError):
        print(shown(line), file=sys.stderr, flush=True)


def _exit_code(error: Exception) -> int:
    """Return the code for an error that one line says all about.

    That a joint is another's is no fault of the input: the same start may succeed later.
    """
    return FAILED if isinstance(error, ClaimError) else BAD_INPUT

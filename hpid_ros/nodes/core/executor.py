"""The life of a process of nodes: usage, start, spinning, end.

``EventsExecutor`` is several times faster than the wait-set executors. Two of its traits need
care: ``spin()`` without a deadline starves callbacks, so it is always given one; and with
rclpy's own signal handlers the context is dead before a last command could be sent. Signals
are therefore taken by a :class:`.Supervisor`, and end the spinning; the
nodes close while the context still lives, and the context is shut down last.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import re
import signal
import sys
import textwrap
import time
import traceback
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, ClassVar

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

from hpid_ros.base.errors import ClaimError, HpidError, SettingError
from hpid_ros.base.processes import optional_libraries
from hpid_ros.base.text import shown
from hpid_ros.nodes.core.middleware import load_profile
from hpid_ros.nodes.core.process import end, end_in_time, end_with_the_launch, warn_if_unprotected
from hpid_ros.nodes.core.rclpy_internals import given_parameters
from hpid_ros.nodes.core.services import (
    Answers,
    ParameterSources,
    as_declared,
    declared_names,
    guard_services,
    require_known,
)
from hpid_ros.nodes.core.status import flush_events
from hpid_ros.nodes.core.supervisor import Supervisor

_WIDTH = 96
_HELP = ("-h", "--help")


@dataclass(frozen=True)
class Usage:
    """An executable in a few lines."""

    name: str  # of the executable
    about: str  # what it does, in one sentence
    needs: str = ""  # parameters that must be given, as an example, for instance -p joint:=elbow
    parameters: Sequence[str] = ()  # names of all parameters; motor.* is a group of them
    listens: Sequence[str] = ()  # topics that it subscribes to
    tells: Sequence[str] = ()  # topics that it publishes
    serves: Sequence[str] = ()  # services beside those of every node

    def tell(self) -> None:
        """Print all of it; whoever reads it may have read enough after some lines, as head has."""
        try:
            print(self.text(), flush=True)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    def text(self) -> str:
        """Return all of it."""
        needs = f" {self.needs}" if self.needs else ""
        lists = {
            "parameters": self.parameters,
            "subscribes to": self.listens,
            "publishes": self.tells,
            "services": self.serves,
        }
        return "\n".join(
            [
                f"usage: {self.name} --ros-args{needs} [-p NAME:=VALUE]... "
                "[--params-file FILE]... [-r __ns:=/NAMESPACE]",
                "",
                self.about,
                "",
                *(_wrapped(what, names) for what, names in lists.items() if names),
                "",
                "ros2 param describe tells of a running node what each parameter is; "
                "docs/interfaces.md has all of them.",
            ]
        )


def is_asked_for(arguments: Sequence[str]) -> bool:
    """Return whether arguments ask for help."""
    return any(argument in _HELP for argument in arguments)


def _wrapped(what: str, names: Sequence[str]) -> str:
    return textwrap.fill(
        f"{what}: {', '.join(names)}",
        _WIDTH,
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    )


BAD_INPUT = 2
"""Exit code of a process whose parameters or arguments cannot be used."""

FAILED = 1
"""Exit code of a process that a callback ended, or whose joint another controller holds."""

_WIND_DOWN_WITHIN = 4.5  # [s] from the request to the close of the nodes
_EVENTS_WITHIN = 0.5  # [s] for a parent that is slow to read
_SWITCH_INTERVAL = 5e-4  # [s]; how late a thread beside the loop (a decoder) makes a sample
_DEADLINE = 86400.0  # [s]; any finite one: spinning goes on when it passes


class ClosingNode(Node):
    """A node that has something to do before its context is gone.

    Its parameters are taken in the types that it declares, and no request brings it down.
    """

    supervisor: Supervisor | None = None
    sources = ParameterSources()
    made: ClassVar[list[Node]] = []  # all nodes of the process, in part or in whole

    def __new__(cls, *_: Any, **__: Any) -> ClosingNode:
        """Remember what is made in this process: also a node that is refused is destroyed."""
        node = super().__new__(cls)
        cls.made.append(node)
        return node

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.guard(lambda line: self.get_logger().warning(line, throttle_duration_sec=1.0))

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
        """Create a subscription, as rclpy does; overrides change no profile but its own."""
        return super().create_subscription(kind, topic, callback, copy(qos), **options)

    def wind_down(self) -> Future | None:
        """Begin what takes time before the end; called once, while spinning goes on."""
        return None

    def leave_at_once(self) -> None:
        """Send what must not be late; called once, on all nodes before any of them is closed."""

    def close(self) -> None:
        """Send or write what must not be lost; called once, while the context is alive."""

    def request_stop(self, code: int = 0) -> None:
        """End this node's process."""
        if self.supervisor is not None:
            self.supervisor.request(code)

    def hand_over(self, callback: Callable[..., None], *arguments: object) -> None:
        """Have the executor's thread call something soon; from any thread."""
        executor = self.executor
        if executor is not None:  # else the node has ended
            executor.create_task(self._call, callback, arguments)

    def _call(self, callback: Callable[..., None], arguments: Sequence[object]) -> None:
        try:
            callback(*arguments)
        except Exception as error:  # in a task it would crash the EventsExecutor of Jazzy
            if self.supervisor is None:
                raise
            code = BAD_INPUT if isinstance(error, HpidError) else FAILED
            self.supervisor.fail(error, code)

    # What follows is called on the supervisor's thread, also while a callback does not return.

    def look(self) -> float:
        """Do what must not wait for the executor, and return when to look again, in [s]."""
        return math.inf

    def hold(self) -> None:
        """Leave without effort until :meth:`go_on`: the process is about to be stopped."""

    def wait_until_held(self, within: float) -> None:
        """Wait until that has been heard, for at most so many seconds."""

    def go_on(self) -> None:
        """Go on after :meth:`hold`."""

    def abandon(self) -> bool:
        """Leave for ever: the executor has not heeded the request to stop."""
        return False


def _type_of(default: object) -> Parameter.Type:
    """Return the type that a parameter is declared with."""
    if isinstance(default, Parameter.Type):
        return default
    if isinstance(default, ParameterValue):
        return Parameter.Type(default.type)
    return Parameter.Type.from_parameter_value(default)


def run(
    make_nodes: Callable[[], Sequence[ClosingNode]],
    args: Sequence[str] | None = None,
    usage: Usage | None = None,
    niceness: int = 0,
) -> int:
    """Run nodes until a signal or one of them ends the process."""
    command_line = list(sys.argv if args is None else args)
    try:
        surplus = remove_ros_args(command_line)[1:]
        if usage is not None and is_asked_for(surplus):
            usage.tell()
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
    code = FAILED
    try:
        with Supervisor() as supervisor:
            code = _run_in_context(make_nodes, command_line, supervisor)
        flush_events(_EVENTS_WITHIN)
        end_in_time()
        for node in ClosingNode.made:
            _destroy(node)
        rclpy.try_shutdown()
        if supervisor.ends_by is not None:
            _end_by(supervisor.ends_by)
    except Exception as error:
        code = _fail(error)
    finally:
        end(code)


def _end_by(number: int) -> None:
    """End by a signal, so that a parent sees it as if nobody had caught it."""
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
        require_known(
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
        if not supervisor.has_abandoned:
            _wind_down(executor, nodes, supervisor)
    except HpidError as error:  # what only the graph shows, for instance a topic's type
        supervisor.request(_refuse(str(error), _exit_code(error)))
    except Exception as error:  # whatever it was, the nodes are closed and their joints left
        supervisor.request(_fail(error))
    finally:
        supervisor.is_heeded = True
        # No node waits in its close for what another one still has to send.
        is_closed = [_done(node.leave_at_once) for node in nodes]
        supervisor.are_left = True
        is_closed += [_done(node.close) for node in nodes]
        end_in_time()  # what is left is the middleware's
        _done(executor.shutdown)
    return supervisor.code or int(not all(is_closed))


def _wind_down(executor: Executor, nodes: Sequence[ClosingNode], supervisor: Supervisor) -> None:
    """Go on spinning until all nodes may be closed, or have had long enough."""
    deadline = time.monotonic() + _WIND_DOWN_WITHIN
    waits = [node.wind_down() for node in nodes]
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
    return f"unknown ROS arguments {line}" if line.startswith("[") else line


def _refuse(line: str, code: int = BAD_INPUT) -> int:
    print(shown(line), file=sys.stderr)
    return code


def _exit_code(error: Exception) -> int:
    """Return the code for an error that one line says all about.

    That a joint is another's is no fault of the input: the same start may succeed later.
    """
    return FAILED if isinstance(error, ClaimError) else BAD_INPUT

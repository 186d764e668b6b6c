"""Services that no request can bring a node down with, and parameters given at the start.

rclpy lets what a service's callback raises end the executor: a lifecycle transition that the
present state does not have does so, and so does a parameter of an unknown type.

``60`` for a double is an integer to ROS; ``ros2 param dump`` writes ``null`` where an array was
left out, and a file gives that back as a text; ``ros2 param load`` sends every value as the text
that Python makes of it, so that ``5.0e-05`` comes as the text ``5e-05``. None of these can be
mistaken for another value, so they are taken for what they say. Everything else keeps its type.

ROS passes over a section that names another node, or the same one in another namespace, without a
word: the node would run with its defaults, and a bridge would simulate another robot.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import ListParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.names import ANYWHERE, is_for, node_sections
from hpid_ros.nodes.core.middleware import steady_timer
from hpid_ros.nodes.core.rclpy_internals import (
    ServiceCallback,
    answer_with,
    send_with,
    service_callback,
)

_Type = Parameter.Type
_OVERRIDES = "qos_overrides."
_UNSET = ("null", "~", "None")
_WORDS = {
    _Type.BOOL: "true or false",
    _Type.INTEGER: "an integer",
    _Type.DOUBLE: "a double",
    _Type.STRING: "a text",
    _Type.BYTE_ARRAY: "an array of bytes",
    _Type.BOOL_ARRAY: "an array of true and false",
    _Type.INTEGER_ARRAY: "an array of integers",
    _Type.DOUBLE_ARRAY: "an array of doubles",
    _Type.STRING_ARRAY: "an array of texts",
}


def as_declared(given: Parameter, kind: Parameter.Type) -> Parameter:
    """Return a parameter that was given in the type that was declared."""
    if given.type_ == kind or kind == _Type.NOT_SET:
        return given
    if kind in (_Type.DOUBLE, _Type.DOUBLE_ARRAY):
        given = _numbers(given, kind)
    # An empty array has no type in YAML: ROS makes booleans of it.
    is_empty = given.type_ == _Type.BOOL_ARRAY and not len(given.value)
    if kind.name.endswith("_ARRAY") and is_empty:
        return Parameter(given.name, kind, [])
    if given.type_ == kind:
        return given
    if given.type_ == _Type.NOT_SET or (given.type_ == _Type.STRING and given.value in _UNSET):
        return Parameter(given.name)
    quotes = f", written '{given.value}'" if kind == _Type.STRING else ""
    raise SettingError(
        f"{given.name} must be {_WORDS[kind]}{quotes}, "
        f"not {_WORDS[given.type_]} ({_shown(given.value)})"
    )


def require_known(nodes: Sequence[tuple[str, Collection[str], Collection[str]]]) -> None:
    """Refuse parameters that were given to nodes of which none has them.

    rclpy ignores them silently, and a mistyped gain would be a gain of zero. What is given on
    the command line goes to every node of a process, so it is enough that one of them has it;
    what is in a node's own section of a file that node must have.
    """
    for first, given, _ in nodes:
        for name in given:
            if name.startswith(_OVERRIDES):
                continue
            own = {each for _, got, has in nodes if name in got for each in has}
            if name in own:
                continue
            elsewhere = [node for node, _, has in nodes if name in has]
            line = f"it has no parameter {name!r}, {elsewhere[0]} has" if elsewhere else ""
            raise SettingError(f"{first}: {line or _unknown_parameter(name, own)}")


def _unknown_parameter(name: str, known: Iterable[str]) -> str:
    """Return the line for a parameter that does not exist: what is nearest is enough."""
    names = [each for each in known if not each.startswith(_OVERRIDES)]
    line, _, _ = unknown_name("parameter", name, names).partition(" known: ")
    return line if "did you mean" in line else f"{line} --help lists those that there are"


def _numbers(given: Parameter, kind: Parameter.Type) -> Parameter:
    """Return numbers as doubles, whatever they were written as; what is none unchanged."""
    value = given.value
    try:
        if kind == _Type.DOUBLE and given.type_ in (_Type.INTEGER, _Type.STRING):
            return Parameter(given.name, kind, float(value))
        if kind == _Type.DOUBLE_ARRAY and given.type_ == _Type.INTEGER_ARRAY:
            return Parameter(given.name, kind, [float(each) for each in value])
        if kind == _Type.DOUBLE_ARRAY and given.type_ == _Type.STRING and value[:1] == "[":
            return Parameter(given.name, kind, [float(each) for each in value[1:-1].split(",")])
    except ValueError:
        pass
    return given


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


class _Names(yaml.SafeLoader):
    """Reads files of launch, which tags its arrays as tuples of Python."""


_Names.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)


class ParameterSources:
    """The parameter files of a process."""

    def __init__(self, command_line: Sequence[str] = ()) -> None:
        self._files: dict[str, list[str]] = {}
        for file in _files(command_line):
            text = Path(file).read_text(encoding="utf-8", errors="replace")
            self._files[file] = list(node_sections(yaml.load(text, _Names)))

    def require_namespace(self, node: Node) -> None:
        """Refuse a file that has this node in another namespace only."""
        full, name = node.get_fully_qualified_name(), node.get_name()
        for file, sections in self._files.items():
            elsewhere = [each for each in sections if each.rpartition("/")[2] == name]
            if elsewhere and not any(is_for(each, full) for each in sections):
                raise SettingError(
                    f"{full}: {file} has parameters for {', '.join(elsewhere)} and none for this "
                    f"node; {ANYWHERE}{name} in it stands for the node in any namespace"
                )

    def without(self, nodes: Iterable[Node]) -> list[str]:
        """Return a line for each file that has nothing for any of these nodes."""
        names = [node.get_fully_qualified_name() for node in nodes]
        return [
            f"{file} has nothing for {', '.join(names)}: {', '.join(sections) or 'it is empty'}"
            for file, sections in self._files.items()
            if not any(is_for(section, name) for section in sections for name in names)
        ]


def _files(command_line: Sequence[str]) -> list[str]:
    files: list[str] = []
    is_ros = False
    for index, argument in enumerate(command_line):
        if argument in ("--ros-args", "--"):
            is_ros = argument == "--ros-args"
        elif is_ros and argument == "--params-file":
            files += command_line[index + 1 : index + 2]
    return files


_AGAIN_EVERY = 0.05  # [s]
_AGAIN_WITHIN = 10.0  # [s]; discovery on a busy machine took up to 2.6
_AGAIN_AT_MOST = 100  # answers that wait; of a flood from a client that never matches, the newest
_BLOCKED = 0.05  # [s]; a middleware that waits has done so, and stopped the process meanwhile


class Answers:
    """Sends answers of services again whose client is not matched yet.

    A request can come before its client's reader of answers has been discovered. Fast DDS then
    stops the whole process for ``max_blocking_time`` (0 in this package's profiles) and drops the
    answer, of which rclpy only warns: the client would wait for ever.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._waiting: deque[tuple[float, Callable[[], None]]] = deque(maxlen=_AGAIN_AT_MOST)
        self._timer = steady_timer(node, _AGAIN_EVERY, self._send_again)
        self._timer.cancel()

    def cover(self) -> None:
        """Send what the node's services answer in this way from now on."""
        for service in self._node.services:
            send_with(service, partial(self._send, service.send_response))

    @contextmanager
    def sent(self, again: Callable[[], None], deadline: float = math.inf) -> Iterator[None]:
        """Send an answer in this block; if it is lost, it is sent again."""
        begun = time.monotonic()
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            yield
        has_blocked = time.monotonic() - begun > _BLOCKED
        if not has_blocked and any("failed to send response" in str(each) for each in said):
            self._waiting.append((min(deadline, begun + _AGAIN_WITHIN), again))
            self._timer.reset()

    def _send(self, send: Callable[[Any, Any], None], response: object, header: object) -> None:
        with self.sent(lambda: send(response, header)):
            send(response, header)

    def _send_again(self) -> None:
        self._timer.cancel()
        waiting = [*self._waiting]
        self._waiting.clear()
        for deadline, send in waiting:
            # What has become of client and service since then is no fault of this node.
            with suppress(Exception), self.sent(send, deadline):
                if time.monotonic() < deadline:
                    send()


def guard_services(node: Node, fault: Callable[[str], None]) -> None:
    """Answer requests that raise with a refusal, and take sets of parameters as a whole.

    rclpy sets each parameter of a request alone, in the order of the alphabet: on the way from one
    valid set to another there would be sets that are refused, and of a set with one bad gain the
    others would be active. What comes in one request is therefore set or refused as a whole. And
    where one parameter has no value, rclpy answers a request for many with nothing at all; here
    it is answered as not set, as the service's definition says.

    What is set to the value that it has is taken, also where it is fixed: so what was dumped can
    be loaded. Whatever is refused is refused with a reason.
    """
    own = {
        "set_parameters": _whole_sets(node, fault),
        "set_parameters_atomically": _atomic_sets(node, fault),
        "get_parameters": _all_values(node),
    }
    for service in node.services:
        name = service.srv_name.rpartition("/")[2]
        answer = own.get(name) or service_callback(service)
        answer_with(service, _guarded(answer, name, fault))


def declared_names(node: Node) -> list[str]:
    """Return the names of a node's parameters, also of those without a value."""
    return list(node.list_parameters([], ListParameters.Request.DEPTH_RECURSIVE).names)


def _guarded(
    callback: ServiceCallback, name: str, fault: Callable[[str], None]
) -> ServiceCallback:
    def call(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:  # whatever a request from outside can bring about
            fault(f"{name} refused: {type(error).__name__}: {' '.join(str(error).split())}")
            return response  # as it was made: not successful

    return call


def _whole_sets(node: Node, fault: Callable[[str], None]) -> ServiceCallback:
    def call(request: Any, response: Any) -> Any:
        results = [SetParametersResult(successful=True) for _ in request.parameters]
        changes: list[tuple[int, Parameter]] = []
        for index, message in enumerate(request.parameters):
            try:
                changes += [(index, change) for change in _changes(node, [message])]
            except (ValueError, TypeError) as error:
                results[index] = _refused(str(error))
        # What is fixed is refused alone, and does not spoil the rest.
        free = [
            change for _, change in changes if not node.describe_parameter(change.name).read_only
        ]
        whole = _set(node, free)
        for index, change in changes:
            results[index] = whole if change in free else _set(node, [change])
        response.results = results
        _report_refusal(results, fault)
        return response

    return call


def _atomic_sets(node: Node, fault: Callable[[str], None]) -> ServiceCallback:
    def call(request: Any, response: Any) -> Any:
        try:
            response.result = _set(node, _changes(node, request.parameters))
        except (ValueError, TypeError) as error:
            response.result = _refused(str(error))
        _report_refusal([response.result], fault)
        return response

    return call


def _changes(node: Node, messages: Sequence[ParameterMessage]) -> list[Parameter]:
    """Return what messages would change, in the declared types."""
    changes = []
    for message in messages:
        if not node.has_parameter(message.name):
            raise SettingError(unknown_name("parameter", message.name, declared_names(node)))
        kind = Parameter.Type(node.describe_parameter(message.name).type)
        change = as_declared(Parameter.from_parameter_msg(message), kind)
        present = node.get_parameter_or(message.name)
        if present.get_parameter_value() != change.get_parameter_value():
            changes.append(change)
    return changes


def _all_values(node: Node) -> ServiceCallback:
    def call(request: Any, response: Any) -> Any:
        found = [node.get_parameter_or(name) for name in request.names]  # not set: without value
        response.values = [parameter.get_parameter_value() for parameter in found]
        return response

    return call


def _report_refusal(results: Sequence[SetParametersResult], fault: Callable[[str], None]) -> None:
    """Report once a request of which something was refused."""
    reasons = dict.fromkeys(each.reason for each in results if not each.successful)
    if reasons:
        fault(f"set of parameters refused: {'; '.join(reasons)}")


def _set(node: Node, changes: list[Parameter]) -> SetParametersResult:
    """Set parameters as a whole; whatever that meets is the reason of a refusal."""
    if not changes:
        return SetParametersResult(successful=True)
    try:
        result = node.set_parameters_atomically(changes)
    except Exception as error:  # whatever a value from outside can bring about
        return _refused(f"{type(error).__name__}: {' '.join(str(error).split())}")
    return result if result.successful or result.reason else _refused("")


def _refused(reason: str) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=reason or "it was refused without a word")

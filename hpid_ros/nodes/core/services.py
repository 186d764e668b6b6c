"""Services that no request can bring a node down with.

rclpy lets what a service's callback raises end the executor: a lifecycle transition that the
present state does not have does so, and so does a parameter of an unknown type.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.nodes.core.middleware import steady_timer
from hpid_ros.nodes.core.parameters import as_declared, declared_names
from hpid_ros.nodes.core.rclpy_internals import (
    ServiceCallback,
    answer_with,
    send_with,
    service_callback,
)

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
            if self._timer.is_canceled():
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
        "set_parameters": partial(_set_whole, node, fault),
        "set_parameters_atomically": partial(_set_atomically, node, fault),
        "get_parameters": partial(_get_all, node),
    }
    for service in node.services:
        name = service.srv_name.rpartition("/")[2]
        answer = own.get(name) or service_callback(service)
        answer_with(service, partial(_guarded, answer, name, fault))


def _guarded(
    answer: ServiceCallback, name: str, fault: Callable[[str], None], request: Any, response: Any
) -> Any:
    try:
        return answer(request, response)
    except Exception as error:  # whatever a request from outside can bring about
        fault(f"{name} refused: {type(error).__name__}: {' '.join(str(error).split())}")
        return response  # as it was made: not successful


def _set_whole(node: Node, fault: Callable[[str], None], request: Any, response: Any) -> Any:
    results = [SetParametersResult(successful=True) for _ in request.parameters]
    changes: list[tuple[int, Parameter]] = []
    for index, message in enumerate(request.parameters):
        try:
            changes += [(index, change) for change in _changes(node, [message])]
        except (ValueError, TypeError) as error:
            results[index] = _refused(str(error))
    # What is fixed is refused alone, and does not spoil the rest.
    free = [change for _, change in changes if not node.describe_parameter(change.name).read_only]
    reason = next((each.reason for each in results if not each.successful), "")
    whole = _refused(reason) if reason else _set(node, free)
    for index, change in changes:
        results[index] = whole if change in free else _set(node, [change])
    response.results = results
    _report_refusal(results, fault)
    return response


def _set_atomically(node: Node, fault: Callable[[str], None], request: Any, response: Any) -> Any:
    try:
        response.result = _set(node, _changes(node, request.parameters))
    except (ValueError, TypeError) as error:
        response.result = _refused(str(error))
    _report_refusal([response.result], fault)
    return response


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


def _get_all(node: Node, request: Any, response: Any) -> Any:
    found = [node.get_parameter_or(name) for name in request.names]  # not set: without value
    response.values = [parameter.get_parameter_value() for parameter in found]
    return response


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

"""Requests of the page to controllers: parameter sets and transitions, and their answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future as RosFuture

from hpid_ros.control.settings import PARAMETERS, Value
from hpid_ros.live.graph import Answer, ControllerSummary

_SETTLED_AFTER = 0.5
"""Age of a client in [s] before it asks.

A server that has not found the client yet waits for that when it answers, for 0.1 s and within its
executor: a controller would miss a hundred states.
"""

Take = Callable[[Any], None]
"""Takes the answer; None where there was none in time."""


@dataclass(eq=False)
class _Request:
    """A request that has not been answered."""

    service: str
    client: Client
    content: Any
    take: Take
    deadline: float
    future: RosFuture | None = None
    is_over: bool = False


class Requests:
    """Calls services; of the executor's thread alone."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clients: dict[str, Client] = {}
        self._born: dict[str, float] = {}
        self._open: list[_Request] = []

    def prepare(self, kind: Any, service: str) -> Client:
        """Return the client of a service: a server takes a moment to find a new one."""
        if service not in self._clients:
            self._clients[service] = self._node.create_client(kind, service)
            self._born[service] = time.monotonic()
        return self._clients[service]

    def call(self, kind: Any, service: str, content: Any, within: float, take: Take) -> None:
        """Call a service, as soon as it is there."""
        deadline = time.monotonic() + within
        request = _Request(service, self.prepare(kind, service), content, take, deadline)
        self._open.append(request)
        self._send(request)

    def look(self) -> None:
        """Send what could not be sent yet, and end what has waited for long enough."""
        for request in tuple(self._open):
            if time.monotonic() > request.deadline:
                if request.future is not None:
                    request.client.remove_pending_request(request.future)
                self._end(request, None)
            elif request.future is None:
                self._send(request)

    def forget(self, node: str) -> None:
        """Give up everything that was asked of a node."""
        for request in tuple(self._open):
            if _is_of(request.service, node):
                self._end(request, None)
        for service in [name for name in self._clients if _is_of(name, node)]:
            self._node.destroy_client(self._clients.pop(service))

    def close(self) -> None:
        """End everything that is open, without an answer."""
        for request in tuple(self._open):
            self._end(request, None)

    def _send(self, request: _Request) -> None:
        is_settled = time.monotonic() - self._born[request.service] > _SETTLED_AFTER
        if is_settled and request.client.service_is_ready():
            request.future = request.client.call_async(request.content)
            request.future.add_done_callback(lambda future: self._end(request, future.result()))

    def _end(self, request: _Request, answer: Any) -> None:
        if not request.is_over:
            request.is_over = True
            self._open.remove(request)
            request.take(answer)


def _is_of(service: str, node: str) -> bool:
    return service.rpartition("/")[0] == node


_SET_WITHIN = 2.0  # [s]
_SEEN_WITHIN = 0.5  # [s] from the answer to a set until what was set is told
_CHANGES_WITHIN, _STOPS_WITHIN = 5.0, 2.0  # [s]
_REASON_WITHIN = 1.5  # [s]; controllers report once a second
_STATE_WITHIN = 2.0  # [s]
_LAST_FAULT = "last fault"
_SET, _CHANGE, _STATE = "set_parameters_atomically", "change_state", "get_state"

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
}
"""What may be asked for, by label."""

_SETTLED = {
    "configure": ("inactive", "active"),
    "activate": ("active",),
    "deactivate": ("inactive", "unconfigured", "finalized"),
}  # labels of the states in which nothing is left to be done


@dataclass
class ControllerRecord:
    """A controller that has been found, as far as orders want it."""

    seen: ControllerSummary  # as the page knows it
    parameters: dict[str, Any]  # all that are read of it


@dataclass(frozen=True, eq=False)
class _AcceptedSet:
    """A set that was taken, and is not seen active yet."""

    node: str
    values: Mapping[str, Value]
    told: Answer
    deadline: float
    answer: Future[Answer]


@dataclass(frozen=True, eq=False)
class _UnexplainedFailure:
    """A transition that failed, and why is not known yet."""

    node: str
    last_fault: str
    line: str
    deadline: float
    answer: Future[Answer]


class ControllerRequests:
    """Asks controllers; of the executor's thread alone."""

    def __init__(
        self,
        requests: Requests,
        known: Callable[[str], ControllerRecord],
        doubt: Callable[[str], None],
    ) -> None:
        self._requests, self._known, self._doubt = requests, known, doubt
        self._taken: list[_AcceptedSet] = []
        self._unexplained: list[_UnexplainedFailure] = []

    def prepare(self, controller: str) -> None:
        """Be ready to ask a controller at once."""
        self._requests.prepare(SetParametersAtomically, f"{controller}/{_SET}")
        self._requests.prepare(ChangeState, f"{controller}/{_CHANGE}")
        self._requests.prepare(GetState, f"{controller}/{_STATE}")

    def ask_state(self, controller: str, take: Callable[[str], None]) -> None:
        """Ask for the label of a controller's state; ``take`` is not called without an answer."""

        def answered(answer: Any) -> None:
            if answer is not None:
                take(answer.current_state.label)

        service = f"{controller}/{_STATE}"
        self._requests.call(GetState, service, GetState.Request(), _STATE_WITHIN, answered)

    def set(self, controller: str, values: Mapping[str, Value], answer: Future[Answer]) -> None:
        """Have parameters set, all or none."""
        try:
            messages = [parameter(*each).to_parameter_msg() for each in values.items()]
        except (TypeError, ValueError) as error:  # what no parameter can be
            answer.set_result(Answer(False, " ".join(str(error).split())))
            return

        def answered(told: Any) -> None:
            self._take(controller, values, None if told is None else told.result, answer)

        request = SetParametersAtomically.Request(parameters=messages)
        service = f"{controller}/{_SET}"
        self._requests.call(SetParametersAtomically, service, request, _SET_WITHIN, answered)

    def _take(
        self, controller: str, values: Mapping[str, Value], result: Any, answer: Future[Answer]
    ) -> None:
        """Take the result of a set; None where there was none in time."""
        if result is None:
            self._doubt(controller)
            line = f"no answer within {_SET_WITHIN:g} s: it may have been taken"
            answer.set_result(Answer(False, line, is_certain=False))
            return
        told = Answer(result.successful, result.reason)
        if not told.is_taken:
            answer.set_result(told)
            return
        # Whoever looks after the answer shall see what is active.
        deadline = time.monotonic() + _SEEN_WITHIN
        self._taken.append(_AcceptedSet(controller, values, told, deadline, answer))
        self.see(controller)

    def see(self, controller: str) -> None:
        """Resolve the sets of a controller that are active now."""
        parameters = self._known(controller).parameters
        for taken in [each for each in self._taken if each.node == controller]:
            if all(parameters.get(name) == value for name, value in taken.values.items()):
                self._taken.remove(taken)
                taken.answer.set_result(taken.told)

    def change_state(self, controller: str, transition: str, answer: Future[Answer]) -> None:
        """Have a controller go through a transition."""
        within = _STOPS_WITHIN if transition == "deactivate" else _CHANGES_WITHIN
        last_fault = _fault(self._known(controller).seen)

        def answered(told: Any) -> None:
            state = self._known(controller).seen.lifecycle
            if told is None:
                line = f"no answer within {within:g} s: it may have been done"
                answer.set_result(Answer(False, line, is_certain=False))
            elif told.success:
                answer.set_result(Answer(True))
            elif state in _SETTLED[transition]:
                answer.set_result(Answer(True, f"{controller} is {state} already"))
            else:
                line = f"{controller} did not {transition}: it is {state or 'in an unknown state'}"
                deadline = time.monotonic() + _REASON_WITHIN
                self._unexplained.append(
                    _UnexplainedFailure(controller, last_fault, line, deadline, answer)
                )

        content = Transition(id=TRANSITIONS[transition], label=transition)
        request = ChangeState.Request(transition=content)
        self._requests.call(ChangeState, f"{controller}/{_CHANGE}", request, within, answered)

    def hear(self, controller: str) -> None:
        """Take note that a controller has told its health: perhaps why it did not do something."""
        fault = _fault(self._known(controller).seen)
        for doubt in [each for each in self._unexplained if each.node == controller]:
            if fault != doubt.last_fault:
                self._settle(doubt, f"{doubt.line}; {fault}")

    def look(self) -> None:
        """Resolve what has waited for long enough."""
        now = time.monotonic()
        for taken in [each for each in self._taken if now > each.deadline]:
            self._taken.remove(taken)
            self._doubt(taken.node)
            taken.answer.set_result(taken.told)
        for doubt in [each for each in self._unexplained if now > each.deadline]:
            self._settle(doubt, doubt.line)

    def close(self) -> None:
        """Resolve everything that is open."""
        self._requests.close()
        for taken in self._taken:
            taken.answer.set_result(taken.told)
        for doubt in tuple(self._unexplained):
            self._settle(doubt, doubt.line)
        self._taken = []

    def _settle(self, doubt: _UnexplainedFailure, reason: str) -> None:
        self._unexplained.remove(doubt)
        doubt.answer.set_result(Answer(False, reason))


def _fault(seen: ControllerSummary) -> str:
    return seen.health.values.get(_LAST_FAULT, "") if seen.health else ""


def parameter(name: str, value: object) -> Parameter:
    """Return a parameter in the type that controllers declare, where the value can be of it."""
    spec = PARAMETERS.get(name)
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    if spec is not None and isinstance(spec.default, float) and is_whole:
        value = float(value)  # type: ignore[arg-type]
    return Parameter(name, value=value)

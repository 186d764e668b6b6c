"""The client of a running graph: finds joint controllers, follows them, sets and stops them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import ParameterEvent as ParameterEventMessage
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import qos_profile_parameter_events
from rclpy.subscription import Subscription
from rclpy.task import Future as RosFuture

from hpid_bench.live.known_controllers import (
    READ_PARAMETERS,
    SILENT_AFTER,
    Answer,
    Change,
    Health,
    RunningController,
    RunningGraph,
    Samples,
)
from hpid_bench.live.streams import ControllerTopics, Topic, Watching, controller_topics
from hpid_ros.base.errors import HpidError, MessageError, unknown_name
from hpid_ros.control.settings import PARAMETERS, Value
from hpid_ros.messages.reports import decode_parameter_event
from hpid_ros.nodes.core.middleware import RARE, steady_timer

_TICK = 0.05  # [s]
_LOOK_PERIOD, _FIRST_LOOKS, _AT_FIRST = 1.0, 0.25, 5.0  # [s]
_DECLARED_WITHIN = 0.3  # [s] without a new one, after which a node has declared its parameters
_CHANGES_KEPT = 1000
_ASKS = 3  # of a node that does not answer: it may not have found the client yet
_READ_WITHIN, _STATE_WITHIN, _SET_WITHIN = 2.0, 2.0, 2.0  # [s]
_CHANGES_WITHIN, _STOPS_WITHIN = 5.0, 2.0  # [s]
_SEEN_WITHIN = 0.5  # [s] from the answer to a set until the event that tells of it
_REASON_WITHIN = 1.5  # [s]; controllers report once a second
_SETTLED_AFTER = 0.5
"""Age of a client in [s] before it asks.

A server that has not found the client yet waits for that when it answers, for 0.1 s and within its
executor: a controller would miss a hundred states.
"""

_SERVICES = {
    GetParameters: "get_parameters",
    SetParametersAtomically: "set_parameters_atomically",
    ChangeState: "change_state",
    GetState: "get_state",
}
_OWN_FIGURE = "certified degrees"  # that joint controllers alone have on /diagnostics
_LIFECYCLE, _SAMPLES, _LAST_FAULT = "lifecycle", "samples", "last fault"

# with the labels of the states in which nothing is left to be done
_TRANSITIONS = {
    "activate": (Transition.TRANSITION_ACTIVATE, ("active",)),
    "deactivate": (
        Transition.TRANSITION_DEACTIVATE,
        ("inactive", "unconfigured", "finalized"),
    ),
}

StateOf = Callable[[str], tuple[float | None, float | None]]
"""Returns position and mean effort of a node's joint, None where unknown."""


@dataclass(eq=False)
class _Pending:
    """Something that is waited for: the answer of a service, or why there was none."""

    node: str
    deadline: float
    look: Callable[[], Any]  # returns it; None while it is not there
    take: Callable[[Any], object]  # is called once, with None where it has not come in time


class GraphClient:
    """Joint controllers on the graph.

    Public methods return at once and may be called from any thread; the node's executor does the
    rest.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.RLock()
        self._own_name = node.get_fully_qualified_name()
        self._here: set[str] = set()  # nodes with parameters
        self._changed_at = self._born = time.monotonic()  # the former: when one came last
        self._asked: dict[str, int] = {}  # how often, while there is no answer
        self._parameters: dict[str, dict[str, Any]] = {}  # as read, of all controllers here
        self._controllers: Mapping[str, RunningController] = {}
        self._topics: dict[str, ControllerTopics] = {}
        self._settled: set[str] = set()  # those whose topics the graph has told, all of them
        self._stale: dict[str, float] = {}  # when to read a controller again
        self._restarted: set[str] = set()
        self._wanted: tuple[str, ...] = ()
        self._changes: deque[Change] = deque(maxlen=_CHANGES_KEPT)
        self._heard: set[Topic] = set()  # commands that others hear, too
        self._clients: dict[tuple[str, type], tuple[Client, float]] = {}  # with when it was made
        self._pending: list[_Pending] = []
        self._lifecycles: dict[str, Subscription] = {}
        self._next_look = self._next_topics = 0.0
        self._watching = Watching(node)
        events = "/parameter_events"
        profile = qos_profile_parameter_events
        node.create_subscription(ParameterEventMessage, events, self._on_event, profile, raw=True)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, RARE)
        steady_timer(node, _TICK, self._tick)

    # What is seen

    def controllers(self) -> Mapping[str, RunningController]:
        """Return the controllers that have been seen, by the full names of their nodes, sorted."""
        return self._controllers

    def parameters(self) -> dict[str, dict[str, Any]]:
        """Return what was read of all controllers that are here, whether it is of use or not."""
        with self._lock:
            return dict(sorted(self._parameters.items()))

    def watch(self, nodes: Sequence[str]) -> None:
        """Take samples of these controllers from now on, and of no others."""
        with self._lock:
            self._wanted = tuple(dict.fromkeys(nodes))
            self._rewatch()

    def take(self) -> Mapping[str, Samples]:
        """Return what came since the last call, by node; of one thread at a time."""
        return self._watching.take()

    def changes(self) -> Sequence[Change]:
        """Return the sets that controllers took since the last call."""
        with self._lock:
            found = tuple(self._changes)
            self._changes.clear()
            return found

    def running(
        self, nodes: Sequence[str], state_of: StateOf, states: str | None = None
    ) -> RunningGraph:
        """Return controllers as whatever moves joints wants them.

        Their states come from a given topic, or from the one that the first of them listens to.
        """
        with self._lock:
            known = [self._controllers[node] for node in nodes]
            has_commands = all(
                self._topics[each.node].commands
                == ControllerTopics.usual(each.node, each.joint).commands
                for each in known
            )
            states = states or self._topics[nodes[0]].states.name
        found = [(each, *state_of(each.node)) for each in known]
        return RunningGraph.of(
            [replace(each, position=at, effort=effort) for each, at, effort in found],
            states,
            has_commands=has_commands,
        )

    def is_quiet(self, within: float) -> bool:
        """Return whether no node has come for so long, in [s], and all have been asked."""
        return time.monotonic() - self._changed_at > within and not self._asked

    # What is asked for

    def set(self, node: str, values: Mapping[str, Value]) -> Future[Answer]:
        """Have a controller take parameters, all or none."""
        answer = self._answer_of(node)
        try:
            parameters = [parameter(*each) for each in values.items()]
        except (TypeError, ValueError) as error:  # what no parameter can be
            return _resolved(answer, Answer(False, " ".join(str(error).split())))

        def take(response: Any) -> None:
            if response is None:
                self._stale[node] = time.monotonic()
                line = f"no answer within {_SET_WITHIN:g} s: it may have been taken"
                _resolved(answer, Answer(False, line, is_certain=False))
                return
            now, new = self._controllers[node].parameters, {p.name: p.value for p in parameters}
            if response.result.successful and any(now.get(each) != new[each] for each in new):
                # Its event is not here yet, but whoever looks now sees what is active.
                self._set(node, new)
                self._stale[node] = time.monotonic() + _SEEN_WITHIN
            _resolved(answer, Answer(response.result.successful, response.result.reason))

        if not answer.done():
            messages = [each.to_parameter_msg() for each in parameters]
            request = SetParametersAtomically.Request(parameters=messages)
            self._call(node, SetParametersAtomically, request, _SET_WITHIN, take)
        return answer

    def change_state(self, node: str, transition: str) -> Future[Answer]:
        """Have a controller go through a transition: activate or deactivate."""
        answer = self._answer_of(node)
        if transition not in _TRANSITIONS:
            line = unknown_name("transition", transition, _TRANSITIONS)
            return _resolved(answer, Answer(False, line))
        if answer.done():
            return answer
        within = _STOPS_WITHIN if transition == "deactivate" else _CHANGES_WITHIN
        before = self._fault(node)

        def new_fault() -> str | None:
            fault = self._fault(node)
            return fault if fault != before else None

        def take(response: Any) -> None:
            state = self._controllers[node].lifecycle
            if response is None:
                line = f"no answer within {within:g} s: it may have been done"
                _resolved(answer, Answer(False, line, is_certain=False))
            elif response.success:
                _resolved(answer, Answer(True))
            elif state in _TRANSITIONS[transition][1]:
                _resolved(answer, Answer(True, f"{node} is {state} already"))
            else:  # why, its next report may tell
                line = f"{node} did not {transition}: it is {state or 'in an unknown state'}"
                self._wait(
                    node,
                    _REASON_WITHIN,
                    new_fault,
                    lambda why: _resolved(
                        answer, Answer(False, f"{line}; {why}" if why else line)
                    ),
                )

        content = Transition(id=_TRANSITIONS[transition][0], label=transition)
        self._call(node, ChangeState, ChangeState.Request(transition=content), within, take)
        return answer

    def close(self) -> None:
        """Take no more samples, and leave no request without an answer."""
        self._watching.close()
        while self._pending:
            self._end(self._pending[0], None)

    def _answer_of(self, node: str) -> Future[Answer]:
        """Return the answer that a controller is going to give: at once where there is none."""
        answer: Future[Answer] = Future()
        answer.set_running_or_notify_cancel()  # nobody takes back what has been sent
        seen = self._controllers.get(node)
        if seen is None:
            _resolved(answer, Answer(False, unknown_name("controller", node, self._controllers)))
        elif not seen.is_here:
            _resolved(answer, Answer(False, f"{node} has gone"))
        return answer

    # Requests

    def _client(self, node: str, service: type) -> tuple[Client, float]:
        key = node, service
        if key not in self._clients:
            client = self._node.create_client(service, f"{node}/{_SERVICES[service]}")
            self._clients[key] = client, time.monotonic()
        return self._clients[key]

    def _call(
        self, node: str, service: type, request: Any, within: float, take: Callable[[Any], None]
    ) -> None:
        """Call a service, as soon as it is there and has found the client."""
        sent: list[RosFuture] = []

        def look() -> Any:
            is_settled = time.monotonic() - born > _SETTLED_AFTER
            if not sent and is_settled and client.service_is_ready():
                sent.append(client.call_async(request))
                sent[0].add_done_callback(lambda _: self._look(pending))
            return sent[0].result() if sent and sent[0].done() else None

        def taken(response: Any) -> None:
            if response is None and sent:
                client.remove_pending_request(sent[0])
            take(response)

        with self._lock:
            client, born = self._client(node, service)
            pending = self._wait(node, within, look, taken)
            self._look(pending)

    def _wait(
        self, node: str, within: float, look: Callable[[], Any], take: Callable[[Any], object]
    ) -> _Pending:
        with self._lock:
            self._pending.append(_Pending(node, time.monotonic() + within, look, take))
            return self._pending[-1]

    def _look(self, pending: _Pending) -> None:
        with self._lock:
            if pending in self._pending:
                found = pending.look()
                if found is not None or time.monotonic() > pending.deadline:
                    self._end(pending, found)

    def _end(self, pending: _Pending, found: Any) -> None:
        self._pending.remove(pending)
        pending.take(found)

    # What follows is called on the executor's thread.

    def _tick(self) -> None:
        now = time.monotonic()
        if now >= self._next_look:
            is_young = now - self._born < _AT_FIRST
            self._next_look = now + (_FIRST_LOOKS if is_young else _LOOK_PERIOD)
            self._look_for_nodes()
        for pending in tuple(self._pending):
            self._look(pending)
        for name in [name for name, due in self._stale.items() if now > due]:
            if name not in self._asked:
                del self._stale[name]
                if name in self._here:
                    self._read(name)
        if now > self._next_topics:
            self._next_topics = now + _LOOK_PERIOD
            self._look_for_topics()

    def _look_for_nodes(self) -> None:
        """Ask each node that is new for its parameters.

        A node that has other parameters is no controller of this package, and is not asked again
        before it has gone.
        """
        end, kind = f"/{_SERVICES[GetParameters]}", "rcl_interfaces/srv/GetParameters"
        services = self._node.get_service_names_and_types()
        asked = [name for name, types in services if name.endswith(end) and kind in types]
        # A service that has a client is in this list, also where its node has gone; and so are
        # nodes' names, by messages that the middleware may take after their participant's end.
        here = {name.removesuffix(end) for name in asked if self._node.count_services(name)}
        here.discard(self._own_name)
        for name in sorted(self._here - here):
            self._forget(name)
        new, self._here = here - self._here, here
        for name in sorted(new):
            self._changed_at = time.monotonic()
            self._read(name)

    def _forget(self, name: str) -> None:
        with self._lock:
            self._asked.pop(name, None)
            for pending in [each for each in self._pending if each.node == name]:
                self._end(pending, None)
            for key in [each for each in self._clients if each[0] == name]:
                self._node.destroy_client(self._clients.pop(key)[0])
            self._parameters.pop(name, None)
        if name in self._lifecycles:
            self._node.destroy_subscription(self._lifecycles.pop(name))
        self._change(name, is_here=False)  # its last lifecycle stays: it may still drive a joint

    def _read(self, name: str) -> None:
        self._asked[name] = self._asked.get(name, 0) + 1
        request = GetParameters.Request(names=READ_PARAMETERS)
        self._call(name, GetParameters, request, _READ_WITHIN, partial(self._on_parameters, name))

    def _on_parameters(self, name: str, response: Any) -> None:
        if response is None and self._asked.get(name, _ASKS) < _ASKS:
            self._read(name)
            return
        self._asked.pop(name, None)
        if response is None or name not in self._here:  # it has gone meanwhile
            return
        values = [parameter_value_to_python(each) for each in response.values]
        if len(values) == len(READ_PARAMETERS) and None not in values:
            self._found(name, dict(zip(READ_PARAMETERS, values, strict=True)))

    def _found(self, name: str, parameters: dict[str, Any]) -> None:
        with self._lock:
            self._parameters[name] = parameters
        try:
            found = RunningController.of(name, parameters)
        except HpidError as error:
            self._node.get_logger().warning(f"{name} is not shown: {error}")
            return
        before = self._controllers.get(name)
        is_same = before is not None and before.is_here and name not in self._restarted
        self._restarted.discard(name)
        if before is not None and is_same:
            found = replace(found, lifecycle=before.lifecycle, health=before.health)
        with self._lock:
            if not is_same:
                self._settled.discard(name)
            if before is None:
                self._topics[name] = controller_topics(self._node, name, found.joint)[0]
            self._put(found)
        if is_same:
            return
        for service in (SetParametersAtomically, ChangeState):
            self._client(name, service)  # so that it can be asked at once
        if name not in self._lifecycles:
            self._lifecycles[name] = self._node.create_subscription(
                TransitionEvent,
                f"{name}/transition_event",
                lambda message: self._change(name, lifecycle=message.goal_state.label),
                RARE,
            )

        def take(response: Any) -> None:
            if response is not None:
                self._change(name, lifecycle=response.current_state.label)

        self._call(name, GetState, GetState.Request(), _STATE_WITHIN, take)

    def _change(self, name: str, **values: Any) -> None:
        with self._lock:
            if name in self._controllers:
                self._put(replace(self._controllers[name], **values))

    def _put(self, controller: RunningController) -> None:
        with self._lock:
            known = {**self._controllers, controller.node: controller}
            self._controllers = {name: known[name] for name in sorted(known)}
            self._rewatch()

    def _rewatch(self) -> None:
        """Watch those that are wanted, as far as that changes nothing for them.

        A controller begins when somebody hears its commands, and a simulated robot when enough of
        them hear its states: who only watches is not the one that they wait for.
        """
        watched = {}
        for name in self._wanted:
            if name in self._controllers and _has_begun(self._controllers[name]):
                topics = self._topics[name]
                if topics.commands not in self._heard:
                    topics = topics._replace(commands=None)
                watched[name] = topics
        self._watching.watch(watched)

    def _look_for_topics(self) -> None:
        """Ask the graph for the topics of those that have not been heard of for certain."""
        node = self._node
        with self._lock:
            for name, each in self._controllers.items():
                if each.is_here and name not in self._settled:
                    topics, is_settled = controller_topics(node, name, each.joint)
                    # Where somebody publishes states, it may yet listen as before.
                    if is_settled or not node.count_publishers(self._topics[name].states.name):
                        self._topics[name] = topics
                    if is_settled:
                        self._settled.add(name)
            commands = {each.commands for each in self._topics.values()}
            self._heard = {
                topic
                for topic in commands
                if topic is not None
                and node.count_subscribers(topic.name) > self._watching.listens_to(topic)
            }
            self._rewatch()

    def _set(self, name: str, values: Mapping[str, Any]) -> None:
        with self._lock:
            try:
                self._put(self._controllers[name].with_parameters(values))
            except HpidError:  # it has been set again since
                self._stale[name] = time.monotonic()

    def _on_event(self, raw: bytes) -> None:
        try:
            name, declared, changed = decode_parameter_event(raw)
        except MessageError:
            return
        if name in self._asked:  # what is read may be older than this
            self._stale[name] = time.monotonic()
        if name not in self._controllers:
            return
        if declared.keys() & PARAMETERS.keys():  # it is another process
            self._stale[name] = time.monotonic() + _DECLARED_WITHIN
            self._restarted.add(name)
        values: dict[str, Any] = {
            each: changed[each] for each in sorted(changed.keys() & {*READ_PARAMETERS})
        }
        if values:
            with self._lock:
                self._changes.append(Change(name, values, self._watching.time_of(name)))
                self._set(name, values)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            figures = {each.key: each.value for each in status.values}
            if _OWN_FIGURE not in figures:
                continue
            health = Health(ord(status.level), status.message, figures, time.monotonic())
            before = self._controllers.get(status.name)
            if before is None:
                if status.name not in self._parameters:
                    self._stale.setdefault(status.name, 0.0)
                continue
            if before.health is not None and _may_be_other(before.health, health):
                self._stale[status.name] = time.monotonic()
            self._change(status.name, health=health, lifecycle=figures.get(_LIFECYCLE, ""))

    def _fault(self, name: str) -> str:
        health = self._controllers[name].health
        return health.values.get(_LAST_FAULT, "") if health else ""


def _may_be_other(before: Health, health: Health) -> bool:
    """Return whether nobody knows what a controller was told since it spoke last.

    A process that starts again has declared its parameters before anybody could hear it, and if it
    was quick, nobody saw that it was gone. But it counts its samples from the first one.
    """
    is_restarted = _samples(health) < _samples(before)
    return is_restarted or health.heard_at - before.heard_at > SILENT_AFTER


def _samples(health: Health) -> int:
    text = health.values.get(_SAMPLES, "")
    return int(text) if text.isdecimal() else 0


def _has_begun(seen: RunningController) -> bool:
    """Return whether a controller takes states, or is not going to."""
    if seen.health is None:
        return False
    return seen.lifecycle != "active" or seen.health.values.get(_SAMPLES, "0") != "0"


def _resolved(answer: Future[Answer], content: Answer) -> Future[Answer]:
    if not answer.done():
        answer.set_result(content)
    return answer


def parameter(name: str, value: object) -> Parameter:
    """Return a parameter in the type that controllers declare, where the value can be of it."""
    spec = PARAMETERS.get(name)
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    if spec is not None and isinstance(spec.default, float) and is_whole:
        value = float(value)  # type: ignore[arg-type]
    return Parameter(name, value=value)

"""The running graph on one node: discovery, parameter events, and what the page asks."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import TransitionEvent
from rcl_interfaces.msg import ParameterEvent as ParameterEventMessage
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import qos_profile_parameter_events
from rclpy.subscription import Subscription

from hpid_ros.base.errors import HpidError, MessageError, unknown_name
from hpid_ros.control.settings import PARAMETERS, Value
from hpid_ros.live.controllers import RunningGraph
from hpid_ros.live.graph import (
    MORE_PARAMETERS,
    SILENT_AFTER,
    Answer,
    Change,
    ControllerSummary,
    Health,
    Samples,
    StateOf,
    as_running,
    controller_summary,
    with_changes,
)
from hpid_ros.live.ros.orders import TRANSITIONS, ControllerRecord, ControllerRequests, Requests
from hpid_ros.live.ros.watching import (
    JOINT_STATE,
    ControllerTopics,
    Topic,
    Watched,
    Watching,
    controller_topics,
)
from hpid_ros.messages.reports import ParameterEvent, decode_parameter_event
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import RARE, steady_timer

_SERVICE, _TYPE = "/get_parameters", "rcl_interfaces/srv/GetParameters"
_NAMES = (*PARAMETERS, *MORE_PARAMETERS)
_ANSWER_WITHIN = 2.0  # [s]
_ASKS = 3  # of a node that does not answer: it may not have found the client yet
_LOOK_PERIOD, _FIRST_LOOKS, _AT_FIRST = 1.0, 0.25, 5.0  # [s]

Found = Callable[[str, Mapping[str, Any]], None]
"""Is called with a controller's full name and all parameters that are read of it."""


class Discovery:
    """Looks at the graph again and again, and asks each node that is new for its parameters.

    A node that has other parameters is no controller of this package, and is not asked again
    before it has gone. Of the executor's thread alone.
    """

    def __init__(
        self, node: Node, requests: Requests, found: Found, gone: Callable[[str], None]
    ) -> None:
        self._node, self._requests = node, requests
        self._tell_found, self._tell_gone = found, gone
        self._own_name = node.get_fully_qualified_name()
        self._here: set[str] = set()
        self._controllers: set[str] = set()
        self._asked: dict[str, int] = {}  # how often, while there is no answer
        self._born, self._next_look = time.monotonic(), 0.0

    def look(self) -> None:
        """Look at the graph, if it is time to."""
        now = time.monotonic()
        if now < self._next_look:
            return
        self._next_look = now + (_FIRST_LOOKS if now - self._born < _AT_FIRST else _LOOK_PERIOD)
        here = self._nodes_with_parameters()
        self._forget(self._here - here)
        for name in sorted(here - self._here):
            self._ask(name)
        self._here = here

    def is_reading(self, name: str) -> bool:
        """Return whether a node's parameters are being read: what comes may be old by then."""
        return name in self._asked

    def reread(self, name: str) -> None:
        """Read the parameters of a controller again, if it is here and they are not being read."""
        if name in self._here and not self.is_reading(name):
            self._ask(name)

    def _nodes_with_parameters(self) -> set[str]:
        services = self._node.get_service_names_and_types()
        asked = [name for name, types in services if name.endswith(_SERVICE) and _TYPE in types]
        # A service that has a client is in this list, also where its node has gone; and so are
        # nodes' names, by messages that the middleware may take after their participant's end.
        here = {name.removesuffix(_SERVICE) for name in asked if self._node.count_services(name)}
        return here - {self._own_name}

    def _forget(self, names: Iterable[str]) -> None:
        for name in sorted(names):
            self._asked.pop(name, None)
            self._requests.forget(name)
            if name in self._controllers:
                self._controllers.remove(name)
                self._tell_gone(name)

    def _ask(self, name: str) -> None:
        self._asked[name] = self._asked.get(name, 0) + 1
        self._requests.call(
            GetParameters,
            f"{name}{_SERVICE}",
            GetParameters.Request(names=_NAMES),
            _ANSWER_WITHIN,
            lambda answer: self._answered(name, answer),
        )

    def _answered(self, name: str, answer: Any) -> None:
        if answer is None and self._asked.get(name, _ASKS) < _ASKS:
            self._ask(name)
            return
        self._asked.pop(name, None)
        if answer is None or name not in self._here:  # it has gone meanwhile
            return
        values = [parameter_value_to_python(each) for each in answer.values]
        if len(values) == len(_NAMES) and None not in values:
            self._controllers.add(name)
            self._tell_found(name, dict(zip(_NAMES, values, strict=True)))


_OWN_FIGURE = "certified degrees"
"""A figure that joint controllers of this package alone have on ``/diagnostics``."""


class Listeners(NamedTuple):
    """Who is called with news, on the executor's thread."""

    event: Callable[[ParameterEvent], None]  # with what a node told of its parameters
    health: Callable[[str, Health], None]  # with a full name and what that node said of itself
    lifecycle: Callable[[str, str], None]  # with a full name and the label of that node's state


class News:
    """Listens to parameter events, diagnostics, and the lifecycles of chosen controllers."""

    def __init__(self, node: Node, listeners: Listeners) -> None:
        self._node, self._listeners = node, listeners
        self._lifecycles: dict[str, Subscription] = {}
        node.create_subscription(
            ParameterEventMessage,
            "/parameter_events",
            self._on_event,
            qos_profile_parameter_events,
            raw=True,
        )
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, RARE)

    def follow(self, controller: str) -> None:
        """Listen to the transitions of a controller."""
        if controller not in self._lifecycles:
            self._lifecycles[controller] = self._node.create_subscription(
                TransitionEvent,
                f"{controller}/transition_event",
                partial(self._on_transition, controller),
                RARE,
            )

    def leave(self, controller: str) -> None:
        """Listen to them no more."""
        subscription = self._lifecycles.pop(controller, None)
        if subscription is not None:
            self._node.destroy_subscription(subscription)

    def _on_event(self, raw: bytes) -> None:
        try:
            event = decode_parameter_event(raw)
        except MessageError:
            return
        self._listeners.event(event)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            figures = {each.key: each.value for each in status.values}
            if _OWN_FIGURE in figures:
                self._listeners.health(status.name, _health(status, figures))

    def _on_transition(self, controller: str, message: Any) -> None:
        self._listeners.lifecycle(controller, message.goal_state.label)


def _health(status: DiagnosticStatus, figures: dict[str, str]) -> Health:
    return Health(ord(status.level), status.message, figures, time.monotonic())


_TICK = 0.05  # [s]
_LOOK_FOR_TOPICS = 1.0  # [s]
_DECLARED_WITHIN = 0.3  # [s] without a new one, after which a node has declared its parameters
_CHANGES_KEPT = 1000
_LIFECYCLE, _SAMPLES = "lifecycle", "samples"


@dataclass
class _Known(ControllerRecord):
    """A controller that has been found."""

    topics: ControllerTopics  # where its samples come from
    is_settled: bool = False  # whether the graph has named all these topics


class LiveGraph:
    """A :class:`~hpid_ros.live.graph.Graph`, whose requests the node's executor carries out."""

    def __init__(self, node: ClosingNode) -> None:
        self._node = node
        self._lock = threading.RLock()
        self._known: dict[str, _Known] = {}
        self._shown: Mapping[str, ControllerSummary] = {}
        self._wanted: tuple[str, ...] = ()
        self._changes: deque[Change] = deque(maxlen=_CHANGES_KEPT)
        self._given: deque[tuple[Callable[[Future[Answer]], None], Future[Answer]]] = deque()
        self._unusable: set[str] = set()
        self._stale: dict[str, float] = {}  # when to read a controller again
        self._reborn: set[str] = set()
        self._heard: set[Topic] = set()  # commands that others hear, too
        self._next_look = 0.0
        self._watching = Watching(node)
        self._requests = Requests(node)
        self._orders = ControllerRequests(self._requests, self._known.__getitem__, self._reread)
        self._discovery = Discovery(node, self._requests, self._found, self._gone)
        self._news = News(node, Listeners(self._on_event, self._on_health, self._on_lifecycle))
        steady_timer(node, _TICK, self._tick)

    def controllers(self) -> Mapping[str, ControllerSummary]:
        """Return the controllers that have been seen, by the full names of their nodes, sorted."""
        return self._shown

    def watch(self, nodes: Sequence[str]) -> None:
        """Take samples of these controllers from now on, and of no others."""
        with self._lock:
            self._wanted = tuple(dict.fromkeys(nodes))
            self._rewatch()

    def take(self) -> Mapping[str, Samples]:
        """Return what came since the last call, by node; of one thread at a time."""
        return self._watching.take()

    def changes(self) -> Sequence[Change]:
        """Return the sets that were taken since the last call."""
        with self._lock:
            found = tuple(self._changes)
            self._changes.clear()
            return found

    def set(self, node: str, values: Mapping[str, Value]) -> Future[Answer]:
        """Have a controller take parameters, all or none; its values are read again afterwards."""
        content = dict(values)
        return self._order(node, lambda answer: self._orders.set(node, content, answer))

    def change_state(self, node: str, transition: str) -> Future[Answer]:
        """Have a controller go through a transition: configure, activate or deactivate."""
        if transition not in TRANSITIONS:
            return _answered(Answer(False, unknown_name("transition", transition, TRANSITIONS)))
        change = self._orders.change_state
        return self._order(node, lambda answer: change(node, transition, answer))

    def running(self, nodes: Sequence[str], state_of: StateOf) -> RunningGraph:
        """Return controllers as whatever moves joints wants them."""
        with self._lock:
            known = [self._known[node] for node in nodes]
            has_commands = all(
                each.topics.commands
                == Topic(f"{each.seen.namespace.rstrip('/')}/joint_commands", JOINT_STATE)
                for each in known
            )
            parameters = {each.seen.node: dict(each.parameters) for each in known}
        seen = [each.seen for each in known]
        return as_running(seen, parameters, state_of, has_commands=has_commands)

    def states_topic(self, node: str) -> str:
        """Return the full name of the topic that a controller takes its states from."""
        with self._lock:
            return self._known[node].topics.states.name

    def close(self) -> None:
        """Take no more samples, and leave no request without an answer."""
        self._watching.close()
        while self._given:
            self._given.popleft()[1].set_result(Answer(False, "not sent: the page has ended"))
        self._orders.close()

    # What follows is called on the executor's thread, but for the first method.

    def _order(self, node: str, give: Callable[[Future[Answer]], None]) -> Future[Answer]:
        """Have the executor's thread give an order."""
        if node not in self._shown:
            return _answered(Answer(False, unknown_name("controller", node, self._shown)))
        answer: Future[Answer] = Future()
        answer.set_running_or_notify_cancel()  # nobody takes back what has been sent
        self._given.append((give, answer))
        self._node.hand_over(self._give_orders)  # at once; without an executor, when it has one
        return answer

    def _give_orders(self) -> None:
        while self._given:
            give, answer = self._given.popleft()
            give(answer)

    def _tick(self) -> None:
        self._give_orders()
        self._discovery.look()
        self._requests.look()
        self._orders.look()
        now = time.monotonic()
        for name in [name for name, due in self._stale.items() if now > due]:
            if not self._discovery.is_reading(name):
                del self._stale[name]
                self._discovery.reread(name)
        if now > self._next_look:
            self._next_look = now + _LOOK_FOR_TOPICS
            self._look_for_topics()

    def _found(self, name: str, parameters: Mapping[str, Any]) -> None:
        try:
            seen = controller_summary(name, parameters)
        except HpidError as error:
            self._unusable.add(name)
            self._node.get_logger().warning(f"{name} is not shown: {error}")
            return
        before = self._known.get(name)
        is_same = before is not None and before.seen.is_here and name not in self._reborn
        self._reborn.discard(name)
        topics = before.topics if before else controller_topics(self._node, name)[0]
        known = _Known(seen, dict(parameters), topics)
        if before is not None and is_same:
            old = before.seen
            known.seen = replace(seen, lifecycle=old.lifecycle, health=old.health)
            known.is_settled = before.is_settled
        with self._lock:
            self._known[name] = known
            self._show()
        if not is_same:
            self._news.follow(name)
            self._orders.prepare(name)
            self._orders.ask_state(name, lambda label: self._on_lifecycle(name, label))

    def _gone(self, name: str) -> None:
        self._unusable.discard(name)
        self._news.leave(name)
        self._change(name, is_here=False, lifecycle="")

    def _change(self, name: str, **values: Any) -> None:
        with self._lock:
            known = self._known.get(name)
            if known is not None:
                known.seen = replace(known.seen, **values)
                self._show()

    def _show(self) -> None:
        self._shown = {name: self._known[name].seen for name in sorted(self._known)}
        self._rewatch()

    def _rewatch(self) -> None:
        """Watch those that are wanted, as far as that changes nothing for them.

        A controller begins when somebody hears its commands, and a simulated robot when enough of
        them hear its states: who only watches is not the one that they wait for.
        """
        watched = {}
        for name in self._wanted:
            known = self._known.get(name)
            if known is not None and _has_begun(known.seen):
                topics = known.topics
                if topics.commands not in self._heard:
                    topics = topics._replace(commands=None)
                watched[name] = Watched(known.seen.joint, topics)
        self._watching.watch(watched)

    def _look_for_topics(self) -> None:
        """Ask the graph for the topics of those that have not been heard of for certain."""
        with self._lock:
            for name, known in self._known.items():
                if known.seen.is_here and not known.is_settled:
                    topics, known.is_settled = controller_topics(self._node, name)
                    if known.is_settled or not self._is_heard(known.topics):
                        known.topics = topics
            commands = {each.topics.commands for each in self._known.values()}
            self._heard = {
                topic
                for topic in commands
                if topic is not None
                and self._node.count_subscribers(topic.name) > self._watching.listens_to(topic)
            }
            self._rewatch()

    def _is_heard(self, topics: ControllerTopics) -> bool:
        """Return whether somebody publishes states where a controller took them from before."""
        return self._node.count_publishers(topics.states.name) > 0

    def _on_event(self, event: ParameterEvent) -> None:
        if self._discovery.is_reading(event.node):  # what is read may be older than this
            self._reread(event.node)
        known = self._known.get(event.node)
        if known is None:
            return
        if event.declared.keys() & PARAMETERS.keys():  # it is another process
            self._stale[event.node] = time.monotonic() + _DECLARED_WITHIN
            self._reborn.add(event.node)
        names = event.changed.keys() & {*PARAMETERS, *MORE_PARAMETERS}
        values: dict[str, Any] = {name: event.changed[name] for name in sorted(names)}
        if not values:
            return
        moment = self._watching.time_of(event.node)
        with self._lock:
            known.parameters |= values
            try:
                known.seen = with_changes(known.seen, values)
            except HpidError:  # it has been set again since
                self._reread(event.node)
            self._changes.append(Change(event.node, values, time.time(), moment))
            self._show()
        self._orders.see(event.node)

    def _on_health(self, name: str, health: Health) -> None:
        if name not in self._known:
            if name not in self._unusable:
                self._discovery.reread(name)
            return
        before = self._known[name].seen.health
        if before is not None and _may_be_other(before, health):
            self._reread(name)
        self._change(name, health=health, lifecycle=health.values.get(_LIFECYCLE, ""))
        self._orders.hear(name)

    def _on_lifecycle(self, name: str, label: str) -> None:
        self._change(name, lifecycle=label)

    def _reread(self, name: str) -> None:
        self._stale[name] = time.monotonic()


def _may_be_other(before: Health, health: Health) -> bool:
    """Return whether nobody knows what a controller was told since it spoke last.

    A process that starts again has declared its parameters before anybody could hear it, and if it
    was quick, nobody saw that it was gone. But it counts its samples from the first one.
    """
    is_anew = _samples(health) < _samples(before)
    return is_anew or health.heard_at - before.heard_at > SILENT_AFTER


def _samples(health: Health) -> int:
    text = health.values.get(_SAMPLES, "")
    return int(text) if text.isdecimal() else 0


def _has_begun(seen: ControllerSummary) -> bool:
    """Return whether a controller takes states, or is not going to."""
    if seen.health is None:
        return False
    return seen.lifecycle != "active" or seen.health.values.get(_SAMPLES, "0") != "0"


def _answered(answer: Answer) -> Future[Answer]:
    future: Future[Answer] = Future()
    future.set_result(answer)
    return future

"""Looks at who gets the merged commands: its subscription, its joints, its manager's word."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future
from rclpy.timer import Timer

from hpid_ros.merging import Receiver
from hpid_ros.nodes.parts.merger.output import GroupOutput
from hpid_ros.nodes.ros.middleware import LATCHED, RARE
from hpid_ros.nodes.ros.steady_timer import steady_timer

_LOOK_EVERY = 0.05  # [s]
_LOOK_AGAIN = 0.002  # [s], while nobody knows whose a subscription is
_NAMED_WITHIN = 0.5  # [s]; then it is taken for the receiver's, which is asked anew
_NAMELESS = "_NODE_NAME_UNKNOWN_"  # of rmw, before a node has told which subscriptions it has
_ANSWER_WITHIN = 1.0  # [s]; then it is asked again
_ASKED = ("joints", "interface_name")
_ACTIVITY = "Controllers Activity"  # of a manager's diagnostics
_STATE = ".state"


class ReceiverWatch:
    """Keeps what is known of a receiver up to date."""

    def __init__(
        self,
        node: Node,
        receiver: Receiver,
        output: GroupOutput,
        manager: str,
        changed: Callable[[], None],
    ) -> None:
        self._node, self._receiver, self._output = node, receiver, output
        self._changed = changed
        self._timers: list[Timer] = []
        self._nameless: dict[bytes, float] = {}  # subscriptions without a node, since when
        self._requests = 0
        self._is_asking = False
        self._asked_at = 0.0
        self._client: Any = None
        self.told_by = "nobody"
        """Who says whether the controller is active."""
        if receiver.name:
            self._client = node.create_client(GetParameters, f"{receiver.name}/get_parameters")
            self.told_by = _hear_activity(node, manager, self._hear)

    def start(self) -> None:
        """Look from now on."""
        if not self._timers:
            self._timers = [
                steady_timer(self._node, every, self.look) for every in (_LOOK_EVERY, _LOOK_AGAIN)
            ]
            self._timers[1].cancel()

    def stop(self) -> None:
        """Look no more."""
        while self._timers:
            self._node.destroy_timer(self._timers.pop())

    def look(self) -> None:
        """See who subscribes now, and ask a controller that is new for its joints."""
        if not self._timers:
            return
        matches = self._output.matches  # before the graph is asked, which knows of all of them
        endpoints, are_all_known = self._endpoints()
        if self._receiver.see(endpoints):
            self._is_asking = False
            self._requests += 1  # who was asked before is not the one that is there now
        if self._receiver.must_be_asked:
            self._output.forget()  # it has been sent nothing that zeros would have to end
            self._ask()
        self._changed()
        self._settle(matches, are_all_known)

    def _settle(self, matches: int, are_all_known: bool) -> None:
        """Let the output go on once it is known whose all subscriptions are."""
        if are_all_known:
            self._output.settle(matches)
        if self._output.is_settled:
            self._timers[1].cancel()
        elif self._timers[1].is_canceled():
            self._timers[1].reset()

    def _endpoints(self) -> tuple[frozenset[bytes], bool]:
        """Return the receiver's subscriptions, and whether it is known whose the others are."""
        wanted, now = self._receiver.name, time.monotonic()
        found, nameless = set(), {}
        for info in self._node.get_subscriptions_info_by_topic(self._output.publisher.topic_name):
            endpoint = bytes(info.endpoint_gid)
            if not wanted or wanted == f"{info.node_namespace.rstrip('/')}/{info.node_name}":
                found.add(endpoint)
            elif info.node_name == _NAMELESS:
                nameless[endpoint] = self._nameless.get(endpoint, now)
        self._nameless = nameless
        taken = {each for each, since in nameless.items() if now - since > _NAMED_WITHIN}
        return frozenset(found | taken), len(taken) == len(nameless)

    def _ask(self) -> None:
        if self._is_asking and time.monotonic() - self._asked_at < _ANSWER_WITHIN:
            return
        if not self._client.service_is_ready():
            return
        self._is_asking, self._asked_at = True, time.monotonic()
        self._requests += 1
        request = self._client.call_async(GetParameters.Request(names=list(_ASKED)))
        request.add_done_callback(partial(self._answered, self._requests))

    def _answered(self, number: int, future: Future) -> None:
        answer = future.result()
        if number != self._requests or answer is None:
            return
        self._is_asking = False
        values = [parameter_value_to_python(value) for value in answer.values]
        joints, interface = [*values, None, None][:2]
        self._receiver.hear_joints(joints, interface)
        self._changed()

    def _hear(self, states: Mapping[str, str]) -> None:
        self._receiver.hear_state(states.get(self._receiver.name.rpartition("/")[2]))
        self._changed()


def _hear_activity(node: Node, manager: str, hear: Callable[[Mapping[str, str]], None]) -> str:
    """Listen to what a manager says of its controllers.

    Its topic of activity says so at once; where the package of that message is not installed, its
    diagnostics do, once a second.
    """
    try:
        from controller_manager_msgs.msg import ControllerManagerActivity
    except ImportError:
        names = {f"{manager}: {_ACTIVITY}"}
        if manager.count("/") == 1:  # of several managers with namespaces nobody knows which
            names.add(f"{manager[1:]}: {_ACTIVITY}")
        node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda message: _from_diagnostics(message, names, hear),
            RARE,
        )
        return "/diagnostics"
    topic = f"{manager}/activity"
    node.create_subscription(
        ControllerManagerActivity,
        topic,
        lambda message: hear({each.name: each.state.label for each in message.controllers}),
        LATCHED,
    )
    return topic


def _from_diagnostics(
    message: DiagnosticArray, names: set[str], hear: Callable[[Mapping[str, str]], None]
) -> None:
    for status in message.status:
        if status.name in names:
            hear(
                {
                    pair.key.removesuffix(_STATE): pair.value
                    for pair in status.values
                    if pair.key.endswith(_STATE)
                }
            )

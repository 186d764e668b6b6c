"""What controllers tell of themselves without being asked."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import TransitionEvent
from rcl_interfaces.msg import ParameterEvent as ParameterEventMessage
from rclpy.node import Node
from rclpy.qos import qos_profile_parameter_events
from rclpy.subscription import Subscription

from hpid_ros.base.errors import MessageError
from hpid_ros.live.graph import Health
from hpid_ros.nodes.ros.middleware import RARE
from hpid_ros.wire.parameter_events import ParameterEvent, decode_parameter_event

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

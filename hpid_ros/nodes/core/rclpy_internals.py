"""The private parts of rclpy that nodes need, each read in rclpy 7.1.5 and 7.1.6 (ROS 2 Jazzy).

rclpy has no public way to what these functions return. No other module of this package touches a
private name of another one (``test_architecture.py``). Where another version of rclpy lacks what
is used, :class:`.SettingError` says so in one line, which ends a process with the exit code of
input that cannot be used.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from rclpy import event_handler
from rclpy.impl import rcutils_logger
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription

from hpid_ros.base.errors import SettingError
from hpid_ros.base.text import shown

# What is throttled is told apart by who calls the logger: that is not this file.
getattr(rcutils_logger, "_internal_callers", []).append(os.path.realpath(__file__))


class LineLogger(rcutils_logger.RcutilsLogger):
    """Logs one line a message: a joint's or a node's name may hold line breaks and escapes.

    Uses ``rcutils_logger._internal_callers``, to which rclpy lets others add their files.
    """

    def log(self, message: object, severity: LoggingSeverity, **filters: Any) -> bool:
        return bool(super().log(shown(str(message)), severity, **filters))


KNOWN_RCLPY = "7.1 (ROS 2 Jazzy)"

ServiceCallback = Callable[[Any, Any], Any]


def given_parameters(node: Node) -> dict[str, Parameter]:
    """Return what was given for a node: command line, parameter files and constructor, by name.

    Uses ``Node._parameter_overrides``, which rclpy reads when a parameter is declared: an
    entry that is changed before changes what is declared. Values have the types that they came in.
    """
    given: dict[str, Parameter] = _private(node, "_parameter_overrides", "given parameters")
    return given


def lifecycle_state(node: LifecycleNode) -> str:
    """Return the label of a managed node's present state, for instance ``"inactive"``.

    Uses ``LifecycleNodeMixin._state_machine`` and its ``current_state``, a pair of id and label;
    the public way is a request to the node's own service, which it cannot wait for.
    """
    machine = _private(node, "_state_machine", "the lifecycle")
    _, label = _private(machine, "current_state", "the lifecycle")
    return str(label)


def destroy_lifecycle(node: LifecycleNode) -> None:
    """Destroy what ``Node.destroy_node`` leaves of a managed node: its state machine.

    Uses ``LifecycleNodeMixin._state_machine``, which holds the node in the middleware.
    """
    _private(node, "_state_machine", "the lifecycle").destroy_when_not_in_use()


def service_callback(service: Service) -> ServiceCallback:
    """Return what answers the requests of a service, also of those that rclpy makes itself.

    Uses ``Service.callback``.
    """
    callback: ServiceCallback = _private(service, "callback", "the services of a node")
    return callback


def answer_with(service: Service, callback: ServiceCallback) -> None:
    """Have a service's requests answered by something else from now on.

    Uses ``Service.callback``, which the executors read at each request.
    """
    service_callback(service)
    service.callback = callback


def send_with(service: Service, send: Callable[[Any, Any], None]) -> None:
    """Have a service's answers sent by something else from now on.

    Replaces ``Service.send_response``, which the executors call with response and header.
    """
    vars(service)["send_response"] = send


class MatchCounter:
    """How many subscriptions a publisher has ever been matched with, and how many it is now.

    Uses the ``EventHandle`` below ``rclpy.event_handler``. The public way is a callback, which
    comes after whatever the executor does first; this is true at the time of the call, also where
    one subscription has taken another's place since the last one.
    """

    def __init__(self, publisher: Publisher) -> None:
        purpose = "the matches of a publisher"
        library = _private(event_handler, "_rclpy", purpose)
        kind = event_handler.QoSPublisherEventType.RCL_PUBLISHER_MATCHED
        self._handle = _private(library, "EventHandle", purpose)(publisher.handle, kind)
        self.destroy = self._handle.destroy_when_not_in_use

    def __call__(self) -> tuple[int, int]:
        with self._handle:
            status = self._handle.take_event()
            return int(status.total_count), int(status.current_count)


def taker(subscription: Subscription) -> Callable[[], bytes | None]:
    """Return what takes the next message of a subscription, as bytes, without an executor.

    Uses ``take_message`` of ``Subscription.handle``, which the executors of rclpy call. The public
    way is a callback, which costs several times as much as the message itself. No executor may
    have the subscription's node.
    """
    handle = subscription.handle
    take = _private(handle, "take_message", "the messages of a subscription")
    kind = subscription.msg_type

    def next_one() -> bytes | None:
        taken = take(kind, True)
        return None if taken is None else taken[0]

    return next_one


def _private(owner: object, name: str, purpose: str) -> Any:
    try:
        return getattr(owner, name)
    except AttributeError:
        raise SettingError(
            f"cannot reach {purpose} with this rclpy: its {type(owner).__name__} has no {name}; "
            f"known to work is {KNOWN_RCLPY}"
        ) from None

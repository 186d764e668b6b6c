"""Prints what runs as JSON: the joint controllers, and where their joints are.

The first argument names the topic of the states; without it there are the parameters alone. The
second, if there is one, names the namespace of the controllers.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Sequence
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import JointState

from hpid_ros.base.errors import MessageError
from hpid_ros.control.settings import PARAMETERS
from hpid_ros.messages.joint_state import JointStateFields, decode_joint_state
from hpid_ros.messages.selection import is_below
from hpid_ros.nodes.core.middleware import NEWEST_STATES

_MORE = ("robot_description", "introspection_rate")
_WITHIN = 3.0  # [s] for the first state
_LISTENS_FOR = 0.5  # [s] from then on
_SERVICE = "rcl_interfaces/srv/GetParameters"
_QUIET_FOR = 1.0  # [s] without a new node, after which the graph is taken as known
_AT_MOST = 4.0  # [s]
_ANSWER_WITHIN = 2.0  # [s]
_ASKS = 3
_LOOKS = 3  # for controllers, on a machine so busy that other nodes are found before them


def nodes_with_parameters(node: Node) -> list[str]:
    """Return the nodes on the graph that have parameters, once no more of them appear."""
    found: set[str] = set()
    begun = changed = time.monotonic()
    while time.monotonic() - begun < _AT_MOST:
        if found and time.monotonic() - changed > _QUIET_FOR:
            break
        rclpy.spin_once(node, timeout_sec=0.05)
        services = node.get_service_names_and_types()
        names = {
            name.removesuffix("/get_parameters") for name, types in services if _SERVICE in types
        }
        if names - found:
            found, changed = names, time.monotonic()
    return sorted(found - {node.get_fully_qualified_name()})


def read(node: Node, name: str, more: Sequence[str] = ()) -> dict[str, Any]:
    """Return the loop parameters of one node; empty when it is no joint controller."""
    client = AsyncParameterClient(node, name)
    if not client.wait_for_services(timeout_sec=_ANSWER_WITHIN):
        return {}
    names = [*PARAMETERS, *more]
    for _ in range(_ASKS):  # a server that has not found the client yet answers nobody
        future = client.get_parameters(names)
        rclpy.spin_until_future_complete(node, future, timeout_sec=_ANSWER_WITHIN)
        if future.done() and future.result() is not None:
            break
    else:
        return {}
    values = map(parameter_value_to_python, future.result().values)
    read = dict(zip(names, values, strict=False))
    return read if all(value is not None for value in read.values()) else {}


def controllers(node: Node, namespace: str = "") -> dict[str, dict[str, Any]]:
    """Return the parameters of all joint controllers by the full names of their nodes."""
    for _ in range(_LOOKS):
        names = [name for name in nodes_with_parameters(node) if is_below(name, namespace)]
        read_ones = {name: read(node, name, _MORE) for name in names}
        found = {name: values for name, values in read_ones.items() if values}
        if found:
            return found
    return {}


class StateListener:
    """Takes the newest position of each joint, and its mean effort."""

    def __init__(self, node: Node, topic: str, namespaces: Iterable[str]) -> None:
        self._positions: dict[str, float] = {}
        self._efforts: dict[str, list[float]] = {}
        self._commands: dict[str, list[float]] = {}
        for space in namespaces:
            for name, take in ((topic, self._on_state), ("joint_commands", self._on_command)):
                full = name if name.startswith("/") else f"{space}/{name}"
                node.create_subscription(JointState, full, take, NEWEST_STATES, raw=True)

    def _on_state(self, raw: bytes) -> None:
        fields = _fields(raw)
        if fields is not None and len(fields.position) == len(fields.names):
            self._positions.update(zip(fields.names, fields.position, strict=True))
            _append(self._efforts, fields)

    def _on_command(self, raw: bytes) -> None:
        fields = _fields(raw)
        if fields is not None:
            _append(self._commands, fields)

    @property
    def has_commands(self) -> bool:
        """Whether there was a command."""
        return bool(self._commands)

    def has_any(self) -> bool:
        """Return whether there was a state."""
        return bool(self._positions)

    def joints(self) -> dict[str, dict[str, float | None]]:
        """Return position, and mean effort by commands or else as measured, of each joint."""
        return {
            joint: {
                "position": position,
                "effort": _mean(self._commands.get(joint) or self._efforts.get(joint)),
            }
            for joint, position in self._positions.items()
        }


def _fields(raw: bytes) -> JointStateFields | None:
    try:
        return decode_joint_state(raw)
    except MessageError:
        return None


def _append(efforts: dict[str, list[float]], fields: JointStateFields) -> None:
    if len(fields.effort) == len(fields.names):
        for joint, effort in zip(fields.names, fields.effort, strict=True):
            efforts.setdefault(joint, []).append(effort)


def _mean(efforts: Sequence[float] | None) -> float | None:
    return sum(efforts) / len(efforts) if efforts else None


def _listen(node: Node, listener: StateListener) -> None:
    begun = time.monotonic()
    while not listener.has_any() and time.monotonic() - begun < _WITHIN:
        rclpy.spin_once(node, timeout_sec=0.05)
    begun = time.monotonic()
    while listener.has_any() and time.monotonic() - begun < _LISTENS_FOR:
        rclpy.spin_once(node, timeout_sec=0.05)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what the graph has."""
    topics = list(sys.argv[1:] if arguments is None else arguments)
    rclpy.init(args=[])
    node = rclpy.create_node("hpid_graph_reader")
    try:
        document: dict[str, Any] = {
            "controllers": {
                name: {"ros__parameters": values}
                for name, values in controllers(node, *topics[1:]).items()
            }
        }
        if topics:
            spaces = {name.rpartition("/")[0] for name in document["controllers"]}
            listener = StateListener(node, topics[0], spaces)
            _listen(node, listener)
            document |= {"joints": listener.joints(), "has_commands": listener.has_commands}
        print(json.dumps(document))
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())

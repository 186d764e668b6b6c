"""Prints the parameters of all joint controllers on the graph as JSON, for other programs."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from hpid_ros.control.settings.table import PARAMETERS

_SERVICE = "rcl_interfaces/srv/GetParameters"
_QUIET_FOR = 1.0  # [s] without a new node, after which the graph is taken as known
_AT_MOST = 6.0  # [s]
_ANSWER_WITHIN = 5.0  # [s]


def nodes_with_parameters(node: Node) -> list[str]:
    """Return the nodes on the graph that have parameters, once no more of them appear."""
    found: set[str] = set()
    begun = changed = time.monotonic()
    while time.monotonic() - changed < _QUIET_FOR and time.monotonic() - begun < _AT_MOST:
        rclpy.spin_once(node, timeout_sec=0.05)
        services = node.get_service_names_and_types()
        names = {
            name.removesuffix("/get_parameters") for name, types in services if _SERVICE in types
        }
        if names - found:
            found, changed = names, time.monotonic()
    return sorted(found - {node.get_fully_qualified_name()})


def read(node: Node, name: str) -> dict[str, Any]:
    """Return the loop parameters of one node; empty when it is no joint controller."""
    client = AsyncParameterClient(node, name)
    if not client.wait_for_services(timeout_sec=_ANSWER_WITHIN):
        return {}
    names = list(PARAMETERS)
    future = client.get_parameters(names)
    rclpy.spin_until_future_complete(node, future, timeout_sec=_ANSWER_WITHIN)
    if not future.done() or future.result() is None:
        return {}
    values = map(parameter_value_to_python, future.result().values)
    read = dict(zip(names, values, strict=False))
    return read if all(value is not None for value in read.values()) else {}


def main() -> int:
    """Print what the graph has."""
    rclpy.init()
    try:
        node = rclpy.create_node("parameter_reader")
        found = {name: read(node, name) for name in nodes_with_parameters(node)}
        document = {name: {"ros__parameters": values} for name, values in found.items() if values}
        print(json.dumps(document))
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())

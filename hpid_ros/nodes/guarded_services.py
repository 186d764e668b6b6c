"""Services that no request can bring a node down with.

rclpy lets what a service's callback raises end the executor: a lifecycle transition that the
present state does not have does so, and so does a parameter of an unknown type.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter

ServiceCallback = Callable[[Any, Any], Any]


def guard_services(node: Node, fault: Callable[[str], None]) -> None:
    """Answer requests that raise with a refusal, and take sets of parameters as a whole.

    rclpy sets each parameter of a request alone, in the order of the alphabet: on the way from one
    valid set to another there would be sets that are refused, and of a set with one bad gain the
    others would be in force. What comes in one request is therefore set or refused as a whole. And
    where one parameter has no value, rclpy answers a request
    for many with nothing at all; here it is told as not set, as the service's definition says.

    Args:
        node: The node, with all of its services.
        fault: Called with one line for a request that raised.
    """
    for service in node.services:
        name = service.srv_name.rpartition("/")[2]
        callback = service.callback
        if name == "set_parameters":
            callback = _whole_sets(node)
        elif name == "get_parameters":
            callback = _all_values(node)
        service.callback = _guarded(callback, name, fault)


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


def _whole_sets(node: Node) -> ServiceCallback:
    def call(request: Any, response: Any) -> Any:
        results: list[SetParametersResult] = []
        changes: list[tuple[int, Parameter]] = []
        for index, message in enumerate(request.parameters):
            try:
                change = Parameter.from_parameter_msg(message)
            except (ValueError, TypeError) as error:
                results.append(SetParametersResult(successful=False, reason=str(error)))
                continue
            if not node.has_parameter(change.name) or not _is_same(node, change):
                changes.append((index, change))
            results.append(SetParametersResult(successful=True))
        # What is fixed is refused alone, and does not spoil the rest.
        free = [change for _, change in changes if not _is_fixed(node, change.name)]
        whole = _set(node, free) if free else SetParametersResult(successful=True)
        for index, change in changes:
            results[index] = whole if change in free else _set(node, [change])
        response.results = results
        return response

    return call


def _all_values(node: Node) -> ServiceCallback:
    def call(request: Any, response: Any) -> Any:
        found = [
            node._parameters[name] if node.has_parameter(name) else Parameter(name)
            for name in request.names
        ]
        response.values = [parameter.get_parameter_value() for parameter in found]
        return response

    return call


def _is_same(node: Node, change: Parameter) -> bool:
    present = node._parameters[change.name]  # also one that has no value yet
    return bool(present.type_ == change.type_ and present.value == change.value)


def _is_fixed(node: Node, name: str) -> bool:
    return not node.has_parameter(name) or bool(node.describe_parameter(name).read_only)


def _set(node: Node, changes: list[Parameter]) -> SetParametersResult:
    try:
        return node.set_parameters_atomically(changes)
    except ParameterNotDeclaredException as error:
        return SetParametersResult(successful=False, reason=str(error))

"""Requests to the services of other nodes, none of which is waited for, and each of which ends."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future as RosFuture

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

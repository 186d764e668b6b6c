"""Which joint controllers of this package are on the graph: nodes come, go, and come back."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from hpid_ros.control.settings.table import PARAMETERS
from hpid_ros.live.seen import MORE_PARAMETERS
from hpid_ros.nodes.parts.tuner.requests import Requests

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
        """Tell whether a node's parameters are being read: what comes may be old by then."""
        return name in self._asked

    def read_anew(self, name: str) -> None:
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

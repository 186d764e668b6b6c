"""What runs now: found once, by a node of its own, for commands that are no node."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from hpid_bench.live.graph_client import GraphClient, StateOf
from hpid_bench.live.history import JointHistory
from hpid_bench.live.known_controllers import RunningController, RunningGraph
from hpid_bench.live.streams import ControllerTopics, Watching
from hpid_ros.base.errors import RunError
from hpid_ros.control.parameter_files import settings_from_parameters
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.reading.topic_choice import is_below
from hpid_ros.nodes.core.middleware import destroy_when_quiet, load_profile

_QUIET_FOR = 1.0  # [s] without a new node, after which the graph is taken as known
_FOUND_WITHIN = 12.0  # [s]; on a busy machine other nodes are found before the controllers
_STATES_WITHIN = 3.0  # [s] for the first state
_LISTENS_FOR = 0.5  # [s] from then on

SpinOnce = Callable[[Callable[[], bool], float], None]
"""Goes on until a condition holds, or for so long, in [s]."""


class _Reading(NamedTuple):
    """A node that has found the controllers that run."""

    node: Node
    client: GraphClient
    spin: SpinOnce
    found: dict[str, dict[str, Any]]  # parameters of the controllers, by their nodes


@contextmanager
def _reading(namespace: str) -> Iterator[_Reading]:
    """Find the controllers that run, by a node that is there as long as the block."""
    load_profile()
    context = rclpy.Context()
    try:
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = Node("hpid_graph_reader", context=context, enable_rosout=False)
    except RuntimeError as error:
        raise RunError(f"cannot read the running graph: {' '.join(str(error).split())}") from None
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    client = GraphClient(node)

    def spin(condition: Callable[[], bool], within: float) -> None:
        deadline = time.monotonic() + within
        while not condition() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)

    def found() -> dict[str, dict[str, Any]]:
        every = client.parameters()
        return {name: every[name] for name in every if is_below(name, namespace)}

    try:
        spin(lambda: bool(found()) and client.is_quiet(_QUIET_FOR), _FOUND_WITHIN)
        yield _Reading(node, client, spin, found())
    finally:
        client.close()
        executor.shutdown()
        destroy_when_quiet(node)
        context.try_shutdown()


def running_loops(namespace: str = "") -> dict[str, LoopSettings]:
    """Return the settings of all running controllers by the names of their nodes."""
    with _reading(namespace) as reading:
        return _loops(reading.found, namespace)


def _loops(found: Mapping[str, Mapping[str, Any]], namespace: str) -> dict[str, LoopSettings]:
    document = {name: {"ros__parameters": each} for name, each in found.items()}
    return settings_from_parameters(document, f"the running graph {namespace}".rstrip())


def running_graph(states: str = "joint_states", namespace: str | None = None) -> RunningGraph:
    """Return what runs, and where the joints are by a topic of states."""
    below = f"/{namespace.strip('/')}" if namespace else ""
    with _reading(below) as reading:
        _loops(reading.found, below)
        controllers = [RunningController.of(name, each) for name, each in reading.found.items()]
        state_of = _listened(reading.node, controllers, states, reading.spin)
        return reading.client.running(list(reading.found), state_of, states)


def _listened(
    node: Node, controllers: Sequence[RunningController], states: str, spin: SpinOnce
) -> StateOf:
    """Return what returns positions and mean efforts of joints."""
    watching = Watching(node)
    watching.watch(
        {each.node: ControllerTopics.usual(each.node, each.joint, states) for each in controllers}
    )
    histories = {each.node: JointHistory(each.settings) for each in controllers}

    def has_states() -> bool:
        for name, samples in watching.take().items():
            histories[name].append(samples)
        return any(each.position is not None for each in histories.values())

    spin(has_states, _STATES_WITHIN)
    spin(lambda: False, _LISTENS_FOR)
    has_states()
    watching.close()
    return lambda name: histories[name].state

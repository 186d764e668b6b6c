"""The states that a controller listens to: by itself, or once for all controllers of a process."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from rclpy.node import Node
from rclpy.subscription import Subscription

from hpid_ros.nodes.core.middleware import NEWEST_STATES, subscribe_raw

TOPIC = "joint_states"

TakeState = Callable[[bytes], None]
"""Is called with each state as it came, in CDR."""


class StateSource(Protocol):
    """Gives one controller its states."""

    def expect(self) -> None:
        """Note that the controller will listen as soon as it is ready."""

    def listen(self, take: TakeState) -> None:
        """Give the controller states from now on."""

    def leave(self) -> None:
        """Give it none any more."""


class OwnStates:
    """A subscription of the controller's own."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscription: Subscription | None = None

    def expect(self) -> None:
        """Nobody else has to know."""

    def listen(self, take: TakeState) -> None:
        """Subscribe."""
        self._subscription = subscribe_raw(self._node, TOPIC, take, NEWEST_STATES)

    def leave(self) -> None:
        """Subscribe no more."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscription = None


class SharedStates:
    """One subscription for the controllers of a process, which gives each state to all of them.

    It begins when all that are going to listen are ready, so that a robot in lock-step, which
    publishes once somebody listens, is answered for every joint from its first state on. Who is
    ready later joins it. Only the executor's thread may call.
    """

    def __init__(
        self, node: Node, handing_round: Callable[[], AbstractContextManager[None]] = nullcontext
    ) -> None:
        self._node, self._handing_round = node, handing_round
        self._expected: set[Node] = set()
        self._takes: dict[Node, TakeState] = {}
        self._subscription: Subscription | None = None

    def of(self, controller: Node) -> StateSource:
        """Return the states of one controller; its own where it listens to another topic."""
        topic = controller.resolve_topic_name(TOPIC)
        if topic != self._node.resolve_topic_name(TOPIC):
            return OwnStates(controller)
        return _Member(self, controller)

    def expect(self, controller: Node) -> None:
        """Wait for a controller before the states are subscribed to."""
        self._expected.add(controller)

    def add(self, controller: Node, take: TakeState) -> None:
        """Give a controller states, with all others."""
        self._expected.discard(controller)
        self._takes = {**self._takes, controller: take}
        self._settle()

    def remove(self, controller: Node) -> None:
        """Give a controller no states, and wait for it no more."""
        self._expected.discard(controller)
        self._takes = {node: take for node, take in self._takes.items() if node != controller}
        self._settle()

    def _settle(self) -> None:
        """Subscribe once all are ready, and until all have left."""
        if self._subscription is None:
            if self._takes and not self._expected:
                self._subscription = subscribe_raw(self._node, TOPIC, self._give, NEWEST_STATES)
        elif not self._takes:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _give(self, raw: bytes) -> None:
        takes = self._takes  # one of them may leave, or make another leave
        with self._handing_round():
            for node, take in takes.items():
                if node in self._takes:
                    take(raw)


class _Member:
    """One controller's part in shared states."""

    def __init__(self, states: SharedStates, controller: Node) -> None:
        self._states, self._controller = states, controller

    def expect(self) -> None:
        self._states.expect(self._controller)

    def listen(self, take: TakeState) -> None:
        self._states.add(self._controller, take)

    def leave(self) -> None:
        self._states.remove(self._controller)

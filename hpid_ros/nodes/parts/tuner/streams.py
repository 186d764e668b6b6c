"""Messages of the topics that are watched, taken when somebody asks and by no callback."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from hpid_ros.nodes.parts.tuner.topics import KINDS, Topic
from hpid_ros.nodes.ros.executor import ClosingNode
from hpid_ros.nodes.ros.rclpy_internals import taker

KEPT = 10_000
"""Messages of a topic that are kept until somebody takes them: eight joints at 1 kHz for 1.2 s."""

_PROFILES = {
    is_reliable: QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=KEPT,
        reliability=reliability,
        durability=DurabilityPolicy.VOLATILE,
    )
    for is_reliable, reliability in enumerate(
        (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE)
    )
}


class Streams:
    """Subscriptions of a node of their own, which no executor spins: a message costs its copy.

    Of one thread at a time.
    """

    def __init__(self, node: Node) -> None:
        self._node = Node(
            f"{node.get_name()}_streams",
            context=node.context,
            namespace=node.get_namespace(),
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        ClosingNode.made.append(self._node)  # for a process that ends without closing it
        self._subscriptions: dict[Topic, tuple[Subscription, Callable[[], bytes | None]]] = {}
        self._taken: dict[Topic, list[bytes]] = {}

    def listen(self, topics: Iterable[Topic]) -> None:
        """Subscribe to these topics from now on, and to no others."""
        wanted = set(topics)
        for topic in set(self._subscriptions) - wanted:
            subscription, _ = self._subscriptions.pop(topic)
            self._node.destroy_subscription(subscription)
            self._taken.pop(topic, None)
        for topic in wanted - set(self._subscriptions):
            made = self._node.create_subscription(
                KINDS[topic.type],
                topic.name,
                _ignore,
                _PROFILES[topic.is_reliable],
                raw=True,
            )
            self._subscriptions[topic] = made, taker(made)

    def peek(self, topic: Topic) -> bytes | None:
        """Return the newest message of a topic that is not taken yet; None if there is none."""
        self._fill(topic)
        messages = self._taken.get(topic)
        return messages[-1] if messages else None

    def take(self, topic: Topic) -> list[bytes]:
        """Return the messages of a topic since the last call."""
        self._fill(topic)
        return self._taken.pop(topic, [])

    def _fill(self, topic: Topic) -> None:
        if topic not in self._subscriptions:
            return
        _, take = self._subscriptions[topic]
        messages = self._taken.setdefault(topic, [])
        # At most what can have waited: a publisher that is faster than this must not hold it up.
        for _ in range(KEPT):
            message = take()
            if message is None:
                return
            messages.append(message)
        del messages[:-KEPT]

    def close(self) -> None:
        """Subscribe to nothing any more."""
        self.listen(())
        self._node.destroy_node()


def _ignore(message: bytes) -> None:
    """No executor calls it."""

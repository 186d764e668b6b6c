"""The reference as it comes: latched from a publisher that stays, or once from anybody."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.nodes.qos import LATCHED, RARE, overridable


class TrajectorySubscriptions:
    """Takes ``joint_trajectory`` from latched and from volatile publishers alike.

    A subscription that asks for the latched message gets nothing at all from a volatile
    publisher (``ros2 topic pub``, rqt, MoveIt), and a volatile one gets nothing that was
    published before. So there are both, and what a latched publisher sends to both is taken
    once.

    Args:
        node: The node that listens.
        take: Called with the bytes of each message.
    """

    def __init__(self, node: Node, take: Callable[[bytes], None]) -> None:
        self._take = take
        self._taken: tuple[bool, bytes] | None = None
        self.subscriptions: list[Any] = []
        """Both, for whoever ends them."""
        # Only the contract's profile may be overridden: both would have the same parameters.
        latched = node.create_subscription(
            JointTrajectory,
            "joint_trajectory",
            partial(self._on_message, True),
            LATCHED,
            raw=True,
            # Without rclpy's warning of publishers that are not latched: the other takes them.
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=overridable(),
        )
        volatile = node.create_subscription(
            JointTrajectory,
            "joint_trajectory",
            partial(self._on_message, False),
            RARE,  # not a depth of 1: one message of zero bytes would end what a reader gets
            raw=True,
        )
        self.subscriptions += [latched, volatile]

    def _on_message(self, is_latched: bool, raw: bytes) -> None:
        if self._taken == (not is_latched, raw):
            self._taken = None  # its second copy; the next one is meant
            return
        self._taken = is_latched, raw
        self._take(raw)

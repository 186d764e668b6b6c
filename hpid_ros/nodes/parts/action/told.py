"""The topic ``joint_trajectory``: what this node tells controllers, and what others tell them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

from rclpy.duration import Duration
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.base.errors import HpidError
from hpid_ros.goals import GroupTrajectory
from hpid_ros.nodes.parts.controller.references import (
    Decoded,
    TrajectorySubscriptions,
    reference_decoder,
)
from hpid_ros.nodes.ros.executor import ClosingNode
from hpid_ros.nodes.ros.middleware import LATCHED, overridable
from hpid_ros.nodes.ros.trajectories import column_of
from hpid_ros.wire import encode_trajectory

_OWN_KEPT = 16  # messages that may be on their way back
_HEARD_WITHIN = Duration(seconds=0.5)


class ToldTrajectories:
    """Tells controllers trajectories, and hears what others tell them."""

    def __init__(
        self,
        node: ClosingNode,
        joints: Sequence[str],
        is_listening: Callable[[], bool],
        give_way: Callable[[Sequence[str]], None],
    ) -> None:
        self._node, self._joints = node, joints
        self._is_listening, self._give_way = is_listening, give_way
        self._own: deque[bytes] = deque(maxlen=_OWN_KEPT)
        self._sent = 0
        self._publisher = node.create_publisher(
            JointTrajectory, "joint_trajectory", LATCHED, qos_overriding_options=overridable()
        )
        TrajectorySubscriptions(node, self._on_trajectory)

    def tell(self, told: GroupTrajectory) -> None:
        """Publish a trajectory, latched."""
        raw = encode_trajectory(told.stamp_ns, told.names, told.times_ns, told.arrays)
        self._own.append(raw)
        self._sent += 1
        self._publisher.publish(raw)

    def wait_until_heard(self) -> None:
        """Wait until every controller has acknowledged the last trajectory, for a while."""
        if self._sent and not self._publisher.wait_for_all_acked(_HEARD_WITHIN):
            self._node.get_logger().warning(
                "the last trajectory was not acknowledged by every subscriber within "
                f"{_HEARD_WITHIN.nanoseconds * 1e-9:g} s"
            )

    def listeners(self) -> set[str]:
        """Return full names of the other nodes that hear trajectories."""
        return self._others(self._node.get_subscriptions_info_by_topic)

    def rivals(self) -> set[str]:
        """Return full names of the other nodes that may tell trajectories."""
        return self._others(self._node.get_publishers_info_by_topic)

    def _others(self, infos: Callable[..., Sequence[object]]) -> set[str]:
        names = {
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"  # type: ignore[attr-defined]
            for info in infos(self._publisher.topic_name)
        }
        return names - {self._node.get_fully_qualified_name()}

    def _on_trajectory(self, raw: bytes) -> None:
        if raw in self._own or not self._is_listening():
            return
        reference_decoder().decode(self, raw, partial(self._decoded, self._sent))

    def _decoded(self, sent: int, decoded: Decoded) -> None:
        """Find out, on the decoder's thread, whose joints follow this."""
        if isinstance(decoded, Exception):
            return  # no controller follows what cannot be read
        named = [joint for joint in self._joints if joint in decoded.names]
        try:
            is_followed = bool(named) and column_of(decoded, named[0]) is not None
        except HpidError:
            return
        if is_followed:
            self._node.hand_over(self._heard, sent, named)

    def _heard(self, sent: int, named: Sequence[str]) -> None:
        if sent == self._sent:  # else controllers have been told something newer since
            self._give_way(named)

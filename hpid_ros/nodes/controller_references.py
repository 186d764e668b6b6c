"""What a controller is told to follow: trajectories and setpoints, or the reason why not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_msgs.msg import Float64

from hpid_ros.control.joint_loop import Motion, Setpoint
from hpid_ros.errors import HpidError
from hpid_ros.messages import decode_float64
from hpid_ros.nodes.qos import RARE
from hpid_ros.nodes.trajectories import column_from_bytes
from hpid_ros.nodes.trajectory_subscriptions import TrajectorySubscriptions


class ControllerReferences:
    """Listens to ``joint_trajectory`` and ``~/setpoint``.

    Args:
        node: The controller.
        joint: Its joint.
        follow: Called with each motion of the joint.
        refuse: Called with one line for each message that could not be used.
    """

    def __init__(
        self,
        node: Node,
        joint: str,
        follow: Callable[[Motion], None],
        refuse: Callable[[str], None],
    ) -> None:
        self._node, self._joint, self._follow, self._refuse = node, joint, follow, refuse
        trajectories = TrajectorySubscriptions(node, self._on_trajectory)
        setpoint = node.create_subscription(
            Float64, "~/setpoint", self._on_setpoint, RARE, raw=True
        )
        self._subscriptions: list[Any] = [*trajectories.subscriptions, setpoint]

    def close(self) -> None:
        """Listen no more."""
        for each in self._subscriptions:
            self._node.destroy_subscription(each)
        self._subscriptions = []

    def _on_trajectory(self, raw: bytes) -> None:
        try:
            column = column_from_bytes(raw, self._joint)
        except HpidError as error:
            self._refuse(str(error))
            return
        if column is not None:
            self._follow(column)

    def _on_setpoint(self, raw: bytes) -> None:
        try:
            motion = Setpoint(decode_float64(raw))
        except HpidError as error:
            self._refuse(str(error))
            return
        self._follow(motion)

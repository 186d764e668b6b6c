"""What a controller is told to follow: trajectories and setpoints, or the reason why not."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from std_msgs.msg import Float64

from hpid_ros.control.joint_loop import Motion, Setpoint
from hpid_ros.errors import HpidError
from hpid_ros.messages import decode_float64
from hpid_ros.nodes.executor import ClosingNode
from hpid_ros.nodes.qos import RARE
from hpid_ros.nodes.reference_decoder import Decoded, reference_decoder
from hpid_ros.nodes.trajectories import column_of
from hpid_ros.nodes.trajectory_subscriptions import TrajectorySubscriptions


class ControllerReferences:
    """Listens to ``joint_trajectory`` and ``~/setpoint``.

    A trajectory is decoded on another thread and handed back to the executor's, which alone
    calls what is given here. Of all references the one that came last is followed, however long
    they took to decode.

    Args:
        node: The controller.
        joint: Its joint.
        follow: Called with each motion of the joint.
        refuse: Called with one line for each message that could not be used.
        reason_against: Asked when a reference comes; returns why none is taken now, or nothing.
    """

    def __init__(
        self,
        node: ClosingNode,
        joint: str,
        follow: Callable[[Motion], None],
        refuse: Callable[[str], None],
        reason_against: Callable[[], str],
    ) -> None:
        self._node, self._joint, self._follow, self._refuse = node, joint, follow, refuse
        self._reason_against = reason_against
        self._arrived = self._followed = self._discarded = 0  # references, in their order
        trajectories = TrajectorySubscriptions(node, self._on_trajectory)
        setpoint = node.create_subscription(
            Float64, "~/setpoint", self._on_setpoint, RARE, raw=True
        )
        self._subscriptions: list[Any] = [*trajectories.subscriptions, setpoint]

    def discard(self) -> None:
        """Forget what is still being decoded."""
        self._discarded = self._arrived

    def close(self) -> None:
        """Listen no more."""
        self.discard()
        for each in self._subscriptions:
            self._node.destroy_subscription(each)
        self._subscriptions = []

    def _on_trajectory(self, raw: bytes) -> None:
        self._arrived += 1
        take = partial(self._decoded, self._arrived, self._reason_against())
        reference_decoder().decode(self, raw, take)

    def _decoded(self, number: int, reason_against: str, decoded: Decoded) -> None:
        """Take the joint's own column on the decoder's thread, and hand it to the executor's."""
        found: Motion | Exception | None
        try:
            found = decoded if isinstance(decoded, Exception) else column_of(decoded, self._joint)
        except Exception as error:
            found = error
        self._node.hand_over(self._take, number, reason_against, found)

    def _take(self, number: int, reason_against: str, found: Motion | Exception | None) -> None:
        if number <= self._discarded or found is None:
            return
        if isinstance(found, HpidError):
            self._refuse(str(found))
        elif isinstance(found, Exception):
            raise found
        elif reason_against:
            self._refuse(reason_against)
        elif number > self._followed:
            self._followed = number
            self._follow(found)

    def _on_setpoint(self, raw: bytes) -> None:
        self._arrived += 1
        found: Motion | HpidError
        try:
            found = Setpoint(decode_float64(raw))
        except HpidError as error:
            found = error
        self._take(self._arrived, self._reason_against(), found)

"""What the bridge tells of a brick task, and the service with which a person grips."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.node import Node
from std_srvs.srv import SetBool

from hpid_ros.nodes.bridge_base import pose_message
from hpid_ros.nodes.qos import OFFERED
from hpid_ros.simulation.base_values import ODOM_FRAME
from hpid_ros.simulation.gripper import GRASPED, LOST, MISSED, GripEvent, Gripper
from hpid_ros.simulation.task_values import (
    BRICK_POSES,
    END_EFFECTOR,
    GRIP_EVENTS,
    grip_status,
)
from hpid_ros.simulation.world import World

_NANOSECONDS = 1_000_000_000


class BridgeTask:
    """Publishes ``ee_pose`` and, among bricks, ``brick_poses`` and ``grip_events``.

    ``ee_pose`` is the true pose of a link in the frame ``odom``. The service ``~/grip`` closes
    or opens the gripper.

    Args:
        node: The bridge.
        world: Its world.
        link: Whose pose ``ee_pose`` is.
        prefix: Of the frames' names.
        has_poses: Whether poses are told at all; events always are.
    """

    def __init__(self, node: Node, world: World, link: str, prefix: str, has_poses: bool) -> None:
        self._odom = prefix + ODOM_FRAME
        self._node, self._world, self._link = node, world, link
        self._counts: dict[str, int] = {}
        self._gripper: Gripper | None = None
        self._told = 0
        if has_poses:
            self._end_effector = node.create_publisher(PoseStamped, END_EFFECTOR, OFFERED)
            self._counts[self._end_effector.topic_name] = 0
        if world.gripper is None:
            return
        if has_poses:
            self._bricks = node.create_publisher(PoseArray, BRICK_POSES, OFFERED)
            self._counts[self._bricks.topic_name] = 0
        self._events = node.create_publisher(DiagnosticArray, GRIP_EVENTS, OFFERED)
        self._counts[self._events.topic_name] = 0
        node.create_service(SetBool, "~/grip", self._on_grip)

    @property
    def counts(self) -> dict[str, int]:
        """Messages published so far, by full name of their topic."""
        return dict(self._counts)

    def note(self) -> None:
        """Tell what the gripper did since the state before, once for each state."""
        gripper = self._world.gripper
        if gripper is None:
            return
        if gripper is not self._gripper:  # a reset made a new one
            self._gripper, self._told = gripper, 0
        for event in gripper.events[self._told :]:
            self._tell(event)
        self._told = len(gripper.events)

    def publish(self, stamp: Time) -> None:
        """Publish the poses.

        Args:
            stamp: Of the present state.
        """
        pose = PoseStamped(pose=pose_message(self._world.link_pose(self._link)))
        pose.header.stamp, pose.header.frame_id = stamp, self._odom
        self._end_effector.publish(pose)
        self._counts[self._end_effector.topic_name] += 1
        if self._world.gripper is None:
            return
        bricks = PoseArray(poses=[pose_message(each) for each in self._world.gripper.poses()])
        bricks.header = pose.header
        self._bricks.publish(bricks)
        self._counts[self._bricks.topic_name] += 1

    def figures(self) -> dict[str, str]:
        """Return what the gripper holds and did last, for ``/diagnostics``."""
        gripper = self._world.gripper
        if gripper is None:
            return {}
        held, last = gripper.held, gripper.events[-1:]
        return {
            "brick in the gripper": "none" if held is None else held.name,
            "last grip": _words(last[0]) if last else "none",
        }

    def _tell(self, event: GripEvent) -> None:
        level, name, message, values = grip_status(event)
        status = DiagnosticStatus(
            level=bytes([level]),
            name=name,
            message=message,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        seconds, rest = divmod(event.stamp_ns, _NANOSECONDS)
        array.header.stamp = Time(sec=seconds, nanosec=rest)
        self._events.publish(array)
        self._counts[self._events.topic_name] += 1
        # rclpy wants each severity on a line of its own.
        if event.outcome in (MISSED, LOST):
            self._node.get_logger().warning(_words(event))
        else:
            self._node.get_logger().info(_words(event))

    def _on_grip(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        assert self._world.gripper is not None
        event = self._world.gripper.move(request.data, self._world.time_ns)
        self.note()
        if event is None:
            response.success = True
            response.message = "nothing changed: it was so already, or holds nothing"
            return response
        response.success = event.outcome in (GRASPED, "released")
        response.message = _words(event)
        return response


def _words(event: GripEvent) -> str:
    reason = f": {event.reason}" if event.reason else ""
    return f"{event.brick} {event.outcome} at {event.stamp_ns / _NANOSECONDS:.3f} s{reason}"

"""Reports of the bridge beside the joint states: clock, base, end effector, task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped, Vector3Stamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import SetBool

from hpid_ros.nodes.ros.middleware import LATCHED, OFFERED, RARE
from hpid_ros.nodes.ros.parameters import read_number, read_only
from hpid_ros.simulation.base import REPORT_RATE
from hpid_ros.simulation.reports import CLOCK, KINDS, Reports, grip_words
from hpid_ros.simulation.world.gripper import GRASPED, LOST, MISSED, GripEvent
from hpid_ros.simulation.world.world import World
from hpid_ros.wire import reports as wire

_MESSAGES: dict[str, Any] = {
    wire.CLOCK: Clock,
    wire.ODOMETRY: Odometry,
    wire.VECTOR: Vector3Stamped,
    wire.POSE: PoseStamped,
    wire.POSES: PoseArray,
    wire.STATUSES: DiagnosticArray,
}


class BridgeReports:
    """Publishes what is told of base and task, at a rate of simulated time.

    The URDF is latched on ``robot_description``, where RViz and Foxglove look for it.
    Among bricks the service ``~/grip`` closes or opens the gripper.

    Args:
        node: The bridge; it gets the parameters ``report_rate`` and ``ee_link``.
        world: Its world.
        prefix: Of the frames' names.
        end_ns: Stamp of the last state in [ns], which is reported in any case; None if there is
            none.

    Raises:
        RobotDescriptionError: The robot lacks the link of ``ee_link``.
        SettingError: The rate is out of range.
    """

    def __init__(self, node: Node, world: World, prefix: str, end_ns: int | None = None) -> None:
        self._node, self._world = node, world
        rate = read_number(
            node,
            "report_rate",
            REPORT_RATE,
            "Rate of clock, odom, base_pose_ground_truth, wheel_slip and ee_pose [Hz]; 0 is off",
            (0.0, 1e6),
        )
        link = read_only(node, "ee_link", "", "Link whose pose is ee_pose; the last one if empty")
        link = world.description.link(str(link) or world.description.last_link)
        self._reports = Reports(world, link, rate, end_ns, prefix, self._on_grip_event)
        self._publishers = {
            topic: node.create_publisher(
                _MESSAGES[KINDS[topic]], topic, RARE if topic == CLOCK else OFFERED
            )
            for topic in self._reports.topics
        }
        node.create_publisher(String, "robot_description", LATCHED).publish(
            String(data=world.description.xml)
        )
        self.figures = self._reports.figures
        if world.gripper is not None:
            node.create_service(SetBool, "~/grip", self._on_grip)

    @property
    def counts(self) -> dict[str, int]:
        """Messages that a recorder must have got so far, by full name of their topic."""
        return {
            self._publishers[topic].topic_name: count
            for topic, count in self._reports.counts.items()
            if topic != CLOCK
        }

    def sample(self, stamp_ns: int, positions: Sequence[float]) -> None:
        """Publish what is due; once for each state.

        Args:
            stamp_ns: Simulated time in [ns].
            positions: Measured positions of the driven joints in [rad].
        """
        for topic, raw in self._reports.sample(stamp_ns, positions):
            self._publishers[topic].publish(raw)

    def _on_grip_event(self, event: GripEvent) -> None:
        # rclpy wants each severity on a line of its own.
        if event.outcome in (MISSED, LOST):
            self._node.get_logger().warning(grip_words(event))
        else:
            self._node.get_logger().info(grip_words(event))

    def _on_grip(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        assert self._world.gripper is not None
        event = self._world.gripper.move(request.data, self._world.time_ns)
        for topic, raw in self._reports.events():
            self._publishers[topic].publish(raw)
        if event is None:
            response.success = True
            response.message = "nothing changed: it was so already, or holds nothing"
            return response
        response.success = event.outcome in (GRASPED, "released")
        response.message = grip_words(event)
        return response

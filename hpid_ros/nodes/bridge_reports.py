"""What the bridge tells beside the joint states: clock, odometry, pose of the end effector."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Vector3
from geometry_msgs.msg import Pose as PoseMessage
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from hpid_ros.nodes.parameters import read_number, read_only
from hpid_ros.nodes.qos import RARE
from hpid_ros.simulation.poses import Pose
from hpid_ros.simulation.world import World

_NANOSECONDS = 1_000_000_000


class BridgeReports:
    """Publishes ``clock``, ``odom`` and ``ee_pose`` at a limited rate of simulated time.

    ``odom`` is the simulation's own pose of the robot's root in the frame ``odom``, its twist
    in the root's frame (REP 105).

    Args:
        node: The bridge; it gets the parameters ``report_rate`` and ``ee_link``.
        world: Its world.

    Raises:
        RobotDescriptionError: The robot lacks the link of ``ee_link``.
        SettingError: The rate is out of range.
    """

    def __init__(self, node: Node, world: World) -> None:
        self._world = world
        rate = read_number(
            node,
            "report_rate",
            50.0,
            "Rate of clock, odom and ee_pose [Hz]; 0 is off",
            (0.0, 1e6),
        )
        self._link = str(
            read_only(node, "ee_link", "", "Link whose pose is ee_pose; the last one if empty")
        )
        self._link = world.description.link(self._link or world.description.links[-1])
        self._root = world.description.links[0]
        self._period_ns = round(_NANOSECONDS / rate) if rate > 0.0 else 0
        self._last_ns: int | None = None
        if not self._period_ns:
            return
        self._clock = node.create_publisher(Clock, "clock", RARE)
        self._odometry = node.create_publisher(Odometry, "odom", RARE)
        self._end_effector = node.create_publisher(PoseStamped, "ee_pose", RARE)

    def sample(self, stamp_ns: int) -> None:
        """Publish what is due.

        Args:
            stamp_ns: Simulated time in [ns].
        """
        if not self._period_ns:
            return
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < self._period_ns:
            return
        self._last_ns = stamp_ns
        stamp = Time(sec=stamp_ns // _NANOSECONDS, nanosec=stamp_ns % _NANOSECONDS)
        self._clock.publish(Clock(clock=stamp))
        self._odometry.publish(self._odometry_message(stamp))
        pose = PoseStamped(pose=_pose(self._world.link_pose(self._link)))
        pose.header.stamp, pose.header.frame_id = stamp, "odom"
        self._end_effector.publish(pose)

    def _odometry_message(self, stamp: Time) -> Odometry:
        twist = self._world.base_velocity()
        message = Odometry(child_frame_id=self._root)
        message.header.stamp, message.header.frame_id = stamp, "odom"
        message.pose.pose = _pose(self._world.base_pose())
        message.twist.twist.linear = _vector(twist.linear)
        message.twist.twist.angular = _vector(twist.angular)
        return message


def _pose(pose: Pose) -> PoseMessage:
    x, y, z = pose.position
    qx, qy, qz, qw = pose.orientation
    return PoseMessage(
        position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)
    )


def _vector(values: tuple[float, float, float]) -> Vector3:
    x, y, z = values
    return Vector3(x=x, y=y, z=z)

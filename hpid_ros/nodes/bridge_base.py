"""What the bridge tells of the base: odometry of its wheels, the truth beside it, and slip."""

from __future__ import annotations

from collections.abc import Sequence

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion, Vector3, Vector3Stamped
from geometry_msgs.msg import Pose as PoseMessage
from nav_msgs.msg import Odometry
from rclpy.node import Node

from hpid_ros.errors import SettingError
from hpid_ros.nodes.parameters import read_only
from hpid_ros.nodes.qos import OFFERED
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.simulation.base_monitor import BaseMonitor
from hpid_ros.simulation.base_values import (
    ODOM_FRAME,
    OdometryValues,
    true_odometry,
    wheel_odometry,
)
from hpid_ros.simulation.poses import Pose
from hpid_ros.simulation.slip import Slip
from hpid_ros.simulation.world import World


def base_parameters(node: Node, description: RobotDescription) -> DifferentialDrive | None:
    """Declare the parameters of the base and return what they say; None without wheels.

    Args:
        node: The bridge.
        description: The robot, which is asked for what is not given.

    Raises:
        SettingError: Only one wheel is named, or a length is out of range.
        RobotDescriptionError: The robot's wheels are not a pair on one axle.
    """
    left, right = (
        str(
            read_only(node, f"base.{side}_wheel", "", f"Joint of the {side} wheel; empty: no base")
        )
        for side in ("left", "right")
    )
    radius, separation = (
        float(read_only(node, f"base.wheel_{name}", 0.0, f"{what} [m]; 0 asks the URDF"))
        for name, what in (("radius", "Of both wheels"), ("separation", "Between the wheels"))
    )
    if not left and not right:
        return None
    if not (left and right):
        raise SettingError(
            f"base.left_wheel {left!r} and base.right_wheel {right!r} must both name a joint, "
            f"or neither"
        )
    return DifferentialDrive.of(description, left, right, radius or None, separation or None)


class BridgeBase:
    """Publishes ``odom``, ``base_pose_ground_truth`` and ``wheel_slip``.

    ``odom`` is what the wheels say where the robot has a base, else the truth. ``wheel_slip`` is
    how far the contacts have slid: x the left wheel, y the right wheel, z the axle sideways.

    Args:
        node: The bridge.
        world: Its world.
        prefix: Of the frames' names.

    Attributes:
        counts: Messages published, by full name of their topic.
    """

    def __init__(self, node: Node, world: World, prefix: str = "") -> None:
        self._world = world
        self._odom, self._root = prefix + ODOM_FRAME, prefix + world.description.root
        self._odometry = node.create_publisher(Odometry, "odom", OFFERED)
        self._truth = node.create_publisher(Odometry, "base_pose_ground_truth", OFFERED)
        self._publishers = [self._odometry, self._truth]
        self._monitor: BaseMonitor | None = None
        if world.settings.base is not None:
            self._monitor = BaseMonitor(world)
            self._slip = node.create_publisher(Vector3Stamped, "wheel_slip", OFFERED)
            self._publishers.append(self._slip)
        self._published = 0
        self._reported = Slip(0.0, 0.0, 0.0)

    @property
    def counts(self) -> dict[str, int]:
        """Messages published so far, by full name of their topic."""
        return {publisher.topic_name: self._published for publisher in self._publishers}

    def note(self, positions: Sequence[float]) -> None:
        """Take the present state of the world, once for each state.

        Args:
            positions: Measured positions of the driven joints in [rad].
        """
        if self._monitor is not None:
            self._monitor.note(positions)

    def publish(self, stamp: Time) -> None:
        """Publish how the base is.

        Args:
            stamp: Of the state that was noted last.
        """
        truth = true_odometry(self._world)
        values = truth
        if self._monitor is not None:
            report = self._monitor.report()
            values = wheel_odometry(report)
            left, right, lateral = report.slip
            slip = Vector3Stamped(vector=Vector3(x=left, y=right, z=lateral))
            slip.header.stamp, slip.header.frame_id = stamp, self._root
            self._slip.publish(slip)
        self._odometry.publish(_message(stamp, self._odom, self._root, values))
        self._truth.publish(_message(stamp, self._odom, self._root, truth))
        self._published += 1

    def figures(self) -> dict[str, float]:
        """Return slip up to now and since the last call, for ``/diagnostics``."""
        if self._monitor is None:
            return {}
        slip, before = self._monitor.slip, self._reported
        self._reported = slip
        figures = {"driven by the wheels [m]": self._monitor.distance}
        for name, now, then in zip(
            ("left wheel", "right wheel", "axle, sideways"), slip, before, strict=True
        ):
            figures[f"slip of the {name} [m]"] = now
            figures[f"slip of the {name}, recent [m]"] = max(now - then, 0.0)
        return figures


def _message(stamp: Time, odom: str, root: str, values: OdometryValues) -> Odometry:
    message = Odometry(child_frame_id=root)
    message.header.stamp, message.header.frame_id = stamp, odom
    message.pose.pose = pose_message(values.pose)
    message.pose.covariance = values.pose_covariance
    message.twist.twist.linear = _vector(values.twist.linear)
    message.twist.twist.angular = _vector(values.twist.angular)
    message.twist.covariance = values.twist_covariance
    return message


def pose_message(pose: Pose) -> PoseMessage:
    """Return a pose as a ``geometry_msgs/Pose``."""
    x, y, z = pose.position
    qx, qy, qz, qw = pose.orientation
    return PoseMessage(
        position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)
    )


def _vector(values: tuple[float, float, float]) -> Vector3:
    x, y, z = values
    return Vector3(x=x, y=y, z=z)

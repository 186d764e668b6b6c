"""Reports of the bridge beside the joint states: clock, base, end effector, task."""

from __future__ import annotations

from collections.abc import Sequence

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseArray, PoseStamped, Quaternion, Vector3, Vector3Stamped
from geometry_msgs.msg import Pose as PoseMessage
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.ros.middleware import OFFERED, RARE
from hpid_ros.nodes.ros.parameters import read_number, read_only
from hpid_ros.simulation.base import (
    ODOM_FRAME,
    REPORT_RATE,
    BaseMonitor,
    OdometryValues,
    ReportTimes,
    Slip,
    true_odometry,
    wheel_odometry,
)
from hpid_ros.simulation.poses import Pose
from hpid_ros.simulation.world.gripper import (
    BRICK_POSES,
    END_EFFECTOR,
    GRASPED,
    GRIP_EVENTS,
    LOST,
    MISSED,
    GripEvent,
    Gripper,
    grip_status,
)
from hpid_ros.simulation.world.world import World


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
        seconds, rest = divmod(event.stamp_ns, NANOSECONDS)
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
    return f"{event.brick} {event.outcome} at {event.stamp_ns / NANOSECONDS:.3f} s{reason}"


class BridgeReports:
    """Publishes ``clock`` and what is told of base and task, at a rate of simulated time.

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
        self._world = world
        rate = read_number(
            node,
            "report_rate",
            REPORT_RATE,
            "Rate of clock, odom, base_pose_ground_truth, wheel_slip and ee_pose [Hz]; 0 is off",
            (0.0, 1e6),
        )
        self._link = str(
            read_only(node, "ee_link", "", "Link whose pose is ee_pose; the last one if empty")
        )
        self._link = world.description.link(self._link or world.description.links[-1])
        self._times = ReportTimes(rate, end_ns)
        self._task = BridgeTask(node, world, self._link, prefix, not self._times.is_off)
        if self._times.is_off:
            return
        self._clock = node.create_publisher(Clock, "clock", RARE)
        self._base = BridgeBase(node, world, prefix)

    @property
    def counts(self) -> dict[str, int]:
        """Messages that a recorder must have got so far, by full name of their topic."""
        of_base = {} if self._times.is_off else self._base.counts
        return of_base | self._task.counts

    def figures(self) -> dict[str, object]:
        """Return figures for ``/diagnostics``, with their units."""
        of_base = {} if self._times.is_off else self._base.figures()
        return {**of_base, **self._task.figures()}

    def sample(self, stamp_ns: int, positions: Sequence[float]) -> None:
        """Publish what is due; once for each state.

        Args:
            stamp_ns: Simulated time in [ns].
            positions: Measured positions of the driven joints in [rad].
        """
        self._task.note()
        if self._times.is_off:
            return
        self._base.note(positions)
        if not self._times.is_due(stamp_ns):
            return
        stamp = Time(sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)
        self._clock.publish(Clock(clock=stamp))
        self._base.publish(stamp)
        self._task.publish(stamp)

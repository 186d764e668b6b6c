"""What the bridge tells beside the joint states: clock, odometry, pose of the end effector."""

from __future__ import annotations

from collections.abc import Sequence

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from hpid_ros.nodes.bridge_base import BridgeBase
from hpid_ros.nodes.bridge_task import BridgeTask
from hpid_ros.nodes.parameters import read_number, read_only
from hpid_ros.nodes.qos import RARE
from hpid_ros.simulation.base_monitor import REPORT_RATE, ReportTimes
from hpid_ros.simulation.world import World

_NANOSECONDS = 1_000_000_000


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
        stamp = Time(sec=stamp_ns // _NANOSECONDS, nanosec=stamp_ns % _NANOSECONDS)
        self._clock.publish(Clock(clock=stamp))
        self._base.publish(stamp)
        self._task.publish(stamp)

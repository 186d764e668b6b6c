"""The base's topics of a run: which are recorded, and how a run without ROS writes them."""

from __future__ import annotations

import time

from hpid_ros.bags.base_messages import ODOMETRY, VECTOR, encode_odometry, encode_vector
from hpid_ros.bags.whole_messages import Stamp
from hpid_ros.bags.writer import BagWriter
from hpid_ros.simulation.base_monitor import REPORT_RATE, BaseMonitor, ReportTimes
from hpid_ros.simulation.base_values import (
    ODOM_FRAME,
    OdometryValues,
    true_odometry,
    wheel_odometry,
)
from hpid_ros.simulation.in_process import Sample
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.task_values import task_topics
from hpid_ros.simulation.world import World

ODOM, TRUTH, SLIP = "odom", "base_pose_ground_truth", "wheel_slip"


def recorded_topics(settings: WorldSettings) -> list[str]:
    """Return the topics of a run, in the order in which a recorder is to subscribe them.

    Args:
        settings: The world; where it names no base, there is nothing of one to record.
    """
    of_the_base = () if settings.base is None else (ODOM, TRUTH, SLIP)
    # The states last: whoever waits for their subscribers has a recorder of all the rest.
    others = (*of_the_base, *task_topics(settings))
    return ["joint_trajectory", "joint_commands", *others, "joint_states"]


class BaseRecorder:
    """Writes what the bridge would have published of the base.

    Args:
        writer: The bag.
        world: The world, whose settings name a base.
        end_ns: Stamp of the last state in [ns].
    """

    def __init__(self, writer: BagWriter, world: World, end_ns: int) -> None:
        self._writer, self._world = writer, world
        self._monitor = BaseMonitor(world)
        self._times = ReportTimes(REPORT_RATE, end_ns)
        self._root = world.description.root
        self._odom = writer.add_topic(f"/{ODOM}", ODOMETRY)
        self._truth = writer.add_topic(f"/{TRUTH}", ODOMETRY)
        self._slip = writer.add_topic(f"/{SLIP}", VECTOR)

    def observe(self, sample: Sample) -> None:
        """Take the present state, and write what is due."""
        self._monitor.note(sample.positions)
        if not self._times.is_due(sample.stamp_ns):
            return
        now = time.time_ns()
        report = self._monitor.report()
        header = Stamp(sample.stamp_ns, ODOM_FRAME)
        for topic, values in (
            (self._odom, wheel_odometry(report)),
            (self._truth, true_odometry(self._world)),
        ):
            self._writer.write(topic, now, self._encoded(header, values))
        slip = encode_vector(header._replace(frame=self._root), report.slip)
        self._writer.write(self._slip, now, slip)

    def _encoded(self, header: Stamp, values: OdometryValues) -> bytes:
        return encode_odometry(
            header,
            self._root,
            values.pose,
            values.pose_covariance,
            values.twist,
            values.twist_covariance,
        )

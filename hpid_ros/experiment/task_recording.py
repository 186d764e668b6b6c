"""How a run without ROS writes what the bridge would have told of the task."""

from __future__ import annotations

import time

from hpid_ros.bags.task_messages import (
    POSE,
    POSES,
    STATUSES,
    Status,
    encode_pose,
    encode_poses,
    encode_status,
)
from hpid_ros.bags.whole_messages import Stamp
from hpid_ros.bags.writer import BagWriter
from hpid_ros.simulation.base_monitor import REPORT_RATE, ReportTimes
from hpid_ros.simulation.base_values import ODOM_FRAME
from hpid_ros.simulation.in_process import Sample
from hpid_ros.simulation.task_values import (
    BRICK_POSES,
    END_EFFECTOR,
    GRIP_EVENTS,
    grip_status,
    task_topics,
)
from hpid_ros.simulation.world import World

_KINDS = {END_EFFECTOR: POSE, BRICK_POSES: POSES, GRIP_EVENTS: STATUSES}


class TaskRecorder:
    """Writes end effector, bricks and gripper; nothing where nobody asks for them.

    Args:
        writer: The bag.
        world: The world.
        link: Whose pose ``ee_pose`` is.
        end_ns: Stamp of the last state in [ns].
    """

    def __init__(self, writer: BagWriter, world: World, link: str, end_ns: int) -> None:
        self._writer, self._world, self._link = writer, world, link
        self._times = ReportTimes(REPORT_RATE, end_ns)
        self._topics = {
            name: writer.add_topic(f"/{name}", _KINDS[name])
            for name in task_topics(world.settings)
        }
        self._told = 0

    def observe(self, sample: Sample) -> None:
        """Take the present state, and write what is due."""
        if not self._topics:
            return
        gripper = self._world.gripper
        if gripper is not None:
            for event in gripper.events[self._told :]:
                status = Status(event.stamp_ns, *grip_status(event))
                self._write(GRIP_EVENTS, encode_status(status))
            self._told = len(gripper.events)
        if not self._times.is_due(sample.stamp_ns):
            return
        header = Stamp(sample.stamp_ns, ODOM_FRAME)
        self._write(END_EFFECTOR, encode_pose(header, self._world.link_pose(self._link)))
        if gripper is not None:
            self._write(BRICK_POSES, encode_poses(header, gripper.poses()))

    def _write(self, topic: str, raw: bytes) -> None:
        self._writer.write(self._topics[topic], time.time_ns(), raw)

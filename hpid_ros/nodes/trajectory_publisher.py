"""Publishes one reference trajectory, latched, for every controller that is or comes.

Where states come already, it carries the stamp at which it begins, the same one for all. Before
the first state it has stamp 0 and starts with that one, which would be another one for a
controller that is restarted in the middle. So the publisher listens to the states until the motion
has begun and then latches it once more with the stamp at which it began: those that follow it keep
their reference to the last bit, and those that come later carry on where the others are.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from trajectory_msgs.msg import JointTrajectory

from hpid_ros.base.errors import MessageError, SettingError, TrajectoryError
from hpid_ros.base.records import Record, names_of, quantity
from hpid_ros.base.resources import find_resource
from hpid_ros.base.yaml_files import load_document
from hpid_ros.messages.joint_state import decode_joint_state
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.motion.references import planned_reference
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import ALL_STATES, LATCHED, steady_timer, subscribe_raw
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.core.status import StatusParameters, StatusPipe
from hpid_ros.nodes.core.waiting import Wait, Waiting, described, other_side
from hpid_ros.nodes.parts.goals import LEAD_NS
from hpid_ros.robot.description import RobotDescription

_LOOK_PERIOD = 0.02  # [s]
_LOOKS = 4  # for a state, once there is a publisher of states


@dataclass(frozen=True)
class ReferenceParameters(Record):
    """What is published."""

    reference_file: str = quantity(
        "YAML file with a reference section, e.g. an experiment", default=""
    )


class TrajectoryPublisher(executor.ClosingNode):
    """Publishes the ``reference`` section of a file on ``joint_trajectory``.

    A brick task is planned here: the file is an experiment then, whose robot and scene are read.
    """

    def __init__(self) -> None:
        super().__init__("trajectory_publisher")
        path = read(self, ReferenceParameters).reference_file
        if not path:
            raise SettingError("the parameter reference_file must name a YAML file, it is empty")
        document = load_document(path, TrajectoryError)
        with document.blaming(TrajectoryError):
            trajectory, _ = planned_reference(
                document.values,
                "reference",
                lambda section: section.load(
                    lambda name: RobotDescription.load(find_resource(name, document.folders))
                ),
            )
        self._trajectory = trajectory
        self._newest_ns: int | None = None
        self._start_ns: int | None = None
        self._looks_left = _LOOKS
        self._is_published = self._is_under_way = False
        self._publisher = self.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
        self._states = subscribe_raw(self, "joint_states", self._on_state, ALL_STATES)
        self._status = StatusPipe(self)
        self._look = steady_timer(self, _LOOK_PERIOD, self._publish_when_states_are_heard)
        waiting = Waiting(self)
        waiting.add(self._awaited)
        waiting.begin()

    def _awaited(self) -> Wait | None:
        """Return what the trajectory waits for, for the log."""
        if self._is_published:
            return None
        topic = self._states.topic_name
        return Wait(
            f"a publisher of {topic}",
            "is there",
            topic,
            lambda _: described(other_side(self, self._states)),
        )

    def _publish_when_states_are_heard(self) -> None:
        """Publish once the states' publisher is known, so that the first of them is not missed."""
        if not self._states.get_publisher_count():
            return
        self._looks_left -= 1
        if self._newest_ns is None and self._looks_left:
            return
        self._look.cancel()
        self._is_published = True
        if self._newest_ns is None:
            self._publisher.publish(encode_joint_trajectory(self._trajectory))
        else:
            self._begin(self._newest_ns + LEAD_NS)
        points, joints = len(self._trajectory.points), len(self._trajectory.joint_names)
        self.get_logger().info(f"published {points} points for {joints} joints")
        self._status.send("published")

    def _begin(self, start_ns: int) -> None:
        """Publish when the motion begins, and listen no more."""
        self._is_under_way = True
        self._publisher.publish(encode_joint_trajectory(self._trajectory.started(start_ns)))
        self._status.send("under way", start_ns=start_ns)
        # Not from its own callback; what paces the robot has one subscriber less to serve.
        self.hand_over(self.destroy_subscription, self._states)

    def _on_state(self, raw: bytes) -> None:
        """Wait for the first point of the motion, then publish when it began."""
        if self._is_under_way:
            return
        try:
            stamp_ns = decode_joint_state(raw).stamp_ns
        except MessageError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=1.0)
            return
        self._newest_ns = stamp_ns
        if not self._is_published:
            return
        if self._start_ns is None or stamp_ns < self._start_ns:
            self._start_ns = stamp_ns
        if stamp_ns < self._start_ns + self._trajectory.points[0].time_from_start_ns:
            return
        self._begin(self._start_ns)


USAGE = Usage(
    "trajectory_publisher",
    "Publishes the reference section of a YAML file, latched.",
    "-p reference_file:=FILE",
    names_of(ReferenceParameters, StatusParameters),
    ["joint_states"],
    ["joint_trajectory"],
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [TrajectoryPublisher()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())

"""A run in this process, recorded as a run on the graph is."""

from __future__ import annotations

import time
from pathlib import Path

from hpid_ros.bags.message_types import JOINT_STATE, JOINT_TRAJECTORY, encode_joint_trajectory
from hpid_ros.bags.messages import (
    ODOMETRY,
    POSE,
    POSES,
    STATUSES,
    VECTOR,
    Stamp,
    Status,
    encode_odometry,
    encode_pose,
    encode_poses,
    encode_status,
    encode_vector,
)
from hpid_ros.bags.writer import BagWriter, TopicQos
from hpid_ros.base.interrupts import raise_if_interrupted
from hpid_ros.compensation.build import compensators
from hpid_ros.control import JointLoop
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.progress import Progress, RunReport
from hpid_ros.simulation.base import (
    ODOM_FRAME,
    REPORT_RATE,
    BaseMonitor,
    OdometryValues,
    ReportTimes,
    true_odometry,
    wheel_odometry,
)
from hpid_ros.simulation.engine import Sample, run_in_process
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.gripper import (
    BRICK_POSES,
    END_EFFECTOR,
    GRIP_EVENTS,
    grip_status,
    task_topics,
)
from hpid_ros.simulation.world.world import World
from hpid_ros.wire import JointStateTemplate

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


_PROGRESS_EVERY = 200  # samples


def run_without_ros(
    experiment: Experiment, label: str, bag: Path, progress: Progress
) -> RunReport:
    """Run one controller in this process and record it.

    Args:
        experiment: The experiment.
        label: Which of its controllers.
        bag: Folder of the bag to create.
        progress: Is told how far the run is.

    Raises:
        HpidError: The world cannot be built or the bag cannot be written.
    """
    settings = experiment.controllers[label]
    loops = [JointLoop(each) for each in settings]
    for loop in loops:
        loop.follow(experiment.trajectory.column(loop.settings.joint))
    models = compensators(settings, str(experiment.world.robot_description))
    progress.phase(label, "running in this process")
    with World(experiment.world) as world, BagWriter(bag) as writer:
        recorder = _Recorder(writer, world, experiment, label, progress)
        begin = time.monotonic()
        run_in_process(world, loops, experiment.periods, recorder.observe, models)
        wall_time = time.monotonic() - begin
    return RunReport(label, wall_time, experiment.periods + 1, 1)


class _Recorder:
    """Writes the messages that the nodes would have sent."""

    def __init__(
        self,
        writer: BagWriter,
        world: World,
        experiment: Experiment,
        label: str,
        progress: Progress,
    ) -> None:
        joints = experiment.world.joints
        self._writer, self._label, self._progress = writer, label, progress
        has_velocity = experiment.world.velocity != "none"
        self._state = JointStateTemplate(joints, position=True, velocity=has_velocity, effort=True)
        self._commands = [JointStateTemplate([joint], effort=True) for joint in joints]
        latched = TopicQos(transient_local=True, depth=1)
        trajectory = writer.add_topic("/joint_trajectory", JOINT_TRAJECTORY, latched)
        self._command_topic = writer.add_topic("/joint_commands", JOINT_STATE)
        self._state_topic = writer.add_topic("/joint_states", JOINT_STATE)
        writer.write(trajectory, time.time_ns(), encode_joint_trajectory(experiment.trajectory))
        end_ns = experiment.periods * experiment.world.control_period_ns
        has_base = experiment.world.base is not None
        self._base = BaseRecorder(writer, world, end_ns) if has_base else None
        self._task = TaskRecorder(writer, world, experiment.end_effector, end_ns)
        self._count = 0

    def observe(self, sample: Sample) -> None:
        """Write one state and its commands."""
        now = time.time_ns()
        stamp_ns = sample.stamp_ns
        self._writer.write(
            self._state_topic,
            now,
            self._state.encode(
                stamp_ns,
                position=sample.positions,
                velocity=sample.velocities or (),
                effort=sample.applied,
            ),
        )
        for template, effort in zip(self._commands, sample.efforts, strict=True):
            raw = template.encode(stamp_ns, effort=(effort,))
            self._writer.write(self._command_topic, now, raw)
        if self._base is not None:
            self._base.observe(sample)
        self._task.observe(sample)
        self._count += 1
        if self._count % _PROGRESS_EVERY == 0:
            self._progress.advanced(self._label, stamp_ns * 1e-9)
            raise_if_interrupted()

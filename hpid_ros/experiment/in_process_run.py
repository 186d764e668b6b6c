"""One controller of an experiment without ROS, recorded like the graph would be."""

from __future__ import annotations

import time
from pathlib import Path

from hpid_ros.bags.message_types import (
    JOINT_STATE,
    JOINT_TRAJECTORY,
    encode_joint_trajectory,
)
from hpid_ros.bags.writer import BagWriter, TopicQos
from hpid_ros.control import JointLoop
from hpid_ros.experiment.base_recording import BaseRecorder
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.progress import Progress, RunReport
from hpid_ros.experiment.task_recording import TaskRecorder
from hpid_ros.interrupts import raise_if_interrupted
from hpid_ros.messages import JointStateTemplate
from hpid_ros.simulation.in_process import Sample, run_in_process
from hpid_ros.simulation.world import World
from hpid_ros.tuning.compensation import compensators

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

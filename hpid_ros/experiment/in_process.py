"""A run in this process, recorded as a run on the graph is."""

from __future__ import annotations

import time
from pathlib import Path

from hpid_ros.bags.message_types import JOINT_STATE, JOINT_TRAJECTORY, encode_joint_trajectory
from hpid_ros.bags.metadata import PARAMETERS, slides_entry
from hpid_ros.bags.writer import BagWriter, TopicQos
from hpid_ros.base.interrupts import raise_if_interrupted
from hpid_ros.compensation.build import compensators
from hpid_ros.control import JointLoop
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.parameter_files import controllers_text
from hpid_ros.experiment.progress import Progress, RunReport
from hpid_ros.simulation.base import REPORT_RATE
from hpid_ros.simulation.engine import Sample, run_in_process
from hpid_ros.simulation.reports import KINDS as REPORT_KINDS
from hpid_ros.simulation.reports import Reports, recorded_reports
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.world import World
from hpid_ros.wire import JointStateTemplate


def recorded_topics(settings: WorldSettings) -> list[str]:
    """Return the topics of a run, in the order in which a recorder is to subscribe them."""
    # The states last: whoever waits for their subscribers has a recorder of all the rest.
    return ["joint_trajectory", "joint_commands", *recorded_reports(settings), "joint_states"]


_PROGRESS_EVERY = 200  # samples


def run_without_ros(
    experiment: Experiment, label: str, bag: Path, progress: Progress
) -> RunReport:
    """Run one controller in this process and record it."""
    settings = experiment.controllers[label]
    loops = [JointLoop(each) for each in settings]
    for loop in loops:
        loop.follow(experiment.trajectory.column(loop.settings.joint))
    robot = str(experiment.world.robot_description)
    models = compensators(settings, robot)
    progress.phase(label, "running in this process")
    parameters = {PARAMETERS: controllers_text(settings, robot)}
    metadata = parameters | slides_entry(experiment.slides)
    with World(experiment.world) as world, BagWriter(bag, metadata=metadata) as writer:
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
        wanted = recorded_reports(experiment.world)
        link = experiment.end_effector
        self._reports = Reports(world, link, REPORT_RATE, end_ns, wanted=wanted)
        self._topics = {
            name: writer.add_topic(f"/{name}", REPORT_KINDS[name]) for name in self._reports.topics
        }
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
        for topic, raw in self._reports.sample(stamp_ns, sample.positions):
            self._writer.write(self._topics[topic], now, raw)
        self._count += 1
        if self._count % _PROGRESS_EVERY == 0:
            self._progress.advanced(self._label, stamp_ns * 1e-9)
            raise_if_interrupted()

"""A run in this process, recorded like one on the graph; how a run went; parameter files.

The same files serve the nodes on a real robot: ``ros2 run hpid_ros joint_controllers --ros-args
--params-file controllers.yaml``, in whatever namespace.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from hpid_bench.experiment.description import Experiment, following_loops, nested
from hpid_ros.base.durations import NO_DURATIONS
from hpid_ros.base.errors import ExperimentError
from hpid_ros.base.names import ANYWHERE, controller_name
from hpid_ros.base.processes import raise_if_interrupted
from hpid_ros.base.yaml_files import parse_yaml
from hpid_ros.base.yaml_text import dump_yaml
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.columns import JOINT_STATE, JOINT_TRAJECTORY
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.messages.metadata import CONTROLLERS_ENTRY, slides_entry
from hpid_ros.messages.writer import BagWriter, TopicQos
from hpid_ros.robot.compensation import compensators
from hpid_ros.simulation.engine import Sample, run_in_process
from hpid_ros.simulation.reports import REPORT_KINDS, REPORT_RATE, Reports, recorded_reports
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World


def controllers_document(settings: Sequence[LoopSettings], robot: str = "") -> dict[str, Any]:
    """Return the parameters of all controllers, and of their composition in one process."""
    document: dict[str, Any] = {
        f"{ANYWHERE}joint_controllers": {
            "ros__parameters": {"joints": [each.joint for each in settings]}
        }
    }
    for each in settings:
        values = each.to_parameters()
        if each.model.is_on and not each.model.description:
            values["model.description"] = robot
        document[f"{ANYWHERE}{controller_name(each.joint)}"] = {"ros__parameters": nested(values)}
    return document


def controllers_text(settings: Sequence[LoopSettings], robot: str = "") -> str:
    return dump_yaml(controllers_document(settings, robot))


def bridge_document(experiment: Experiment, world_file: Path) -> dict[str, Any]:
    return {
        f"{ANYWHERE}{bridge_name(experiment.world)}": {
            "ros__parameters": {
                "world_file": str(world_file.resolve()),
                "duration": experiment.duration,
                "answer_timeout": experiment.answer_timeout,
                "ee_link": experiment.end_effector,
            }
        }
    }


def bridge_name(world: WorldSettings) -> str:
    """Return the executable, and the node, that simulates a world."""
    return f"{world.engine}_bridge"


def write_run_files(
    folder: Path, experiment: Experiment, settings: Sequence[LoopSettings]
) -> tuple[Path, Path]:
    """Write the parameter files of controllers, bridge and world, and return the first."""
    controllers, bridge, world = (
        folder / f"{name}.yaml" for name in ("controllers", "bridge", "world")
    )
    write_document(world, experiment.world_document())
    write_document(bridge, bridge_document(experiment, world))
    robot = str(experiment.world.robot_description)
    write_document(controllers, controllers_document(settings, robot))
    return controllers, bridge


def write_reference(folder: Path, experiment: Experiment) -> Path:
    """Write what the publisher of the reference reads: the file may have changed meanwhile."""
    file = folder / "reference.yaml"
    values = parse_yaml(experiment.path, experiment.text, ExperimentError)
    write_document(file, {**experiment.world_document(), "reference": values["reference"]})
    return file


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write a YAML file; the text of a robot gets a file of its own beside it."""
    values = _with_robots_beside(document, path.resolve().parent)
    path.write_text(dump_yaml(values), encoding="utf-8")


def _with_robots_beside(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return parameters in which a URDF's text has become the path of a file with that text."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            value = _with_robots_beside(value, folder)
        elif isinstance(value, str) and value.startswith("<robot"):
            value = str(_robot_file(value, folder))
        result[name] = value
    return result


def _robot_file(text: str, folder: Path) -> Path:
    """Return the file with this text; it is written where it is not there yet."""
    for number in itertools.count(1):
        path = folder / ("robot.urdf" if number == 1 else f"robot_{number}.urdf")
        if not path.exists():
            path.write_text(text, encoding="utf-8")
        if path.read_text(encoding="utf-8") == text:
            break
    return path


def recorded_topics(settings: WorldSettings) -> list[str]:
    """Return the topics of a run, in the order in which a recorder is to subscribe them."""
    # The states last: whoever waits for their subscribers has a recorder of all the rest.
    return ["joint_trajectory", "joint_commands", *recorded_reports(settings), "joint_states"]


def run_timing(
    finished: Mapping[str, Any], controllers: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the durations that bridge and controllers measured, ready for JSON.

    Of each joint, seen from itself and from the bridge: states that it answered, that never
    reached it, and that have no answer; between two states, from a state's bytes to the command
    handed to the middleware, and from a state's publication to the arrival of its answer.
    """
    bridge, counts = finished["timing"], finished["counts"]
    joints = {
        joint: {
            "samples": event["samples"],
            "missed": event["missed"],
            "unanswered": counts[joint]["unanswered"],
            "period": event["period"],
            "compute": event["compute"],
            "latency": bridge["latency"].get(joint, NO_DURATIONS._asdict()),
        }
        for joint, event in controllers.items()
        if joint in counts
    }
    return {"unit": "us", "cycle": bridge["cycle"], "joints": joints}


class Progress(Protocol):
    """Receives how far a run is."""

    def phase(self, label: str, what: str) -> None: ...
    def note(self, line: str) -> None: ...  # something worth knowing before a run begins
    def advanced(self, label: str, simulated: float) -> None: ...


class NoProgress:
    def phase(self, label: str, what: str) -> None: ...
    def note(self, line: str) -> None: ...
    def advanced(self, label: str, simulated: float) -> None: ...


@dataclass
class RunReport:
    """How a run went, apart from its numbers."""

    label: str  # the controller's label
    wall_time: float  # [s] from the first state to the last answer
    states: int  # states of the run
    processes: int  # processes that took part
    warnings: list[str] = field(default_factory=list)
    timing: Mapping[str, Any] | None = None  # see run_timing; None without nodes
    # [s] of wall time, by phase: until all nodes have found each other, until the last state,
    # until all of it is recorded, until all nodes are gone
    spent: Mapping[str, float] = field(default_factory=dict)

    def as_mapping(self) -> dict[str, object]:
        return {**vars(self), "rate": self.rate}

    @property
    def rate(self) -> float:
        """States per second of wall time [Hz]."""
        return self.states / self.wall_time if self.wall_time > 0.0 else 0.0


_PROGRESS_EVERY = 200  # samples


def run_without_ros(
    experiment: Experiment, label: str, bag: Path, progress: Progress
) -> RunReport:
    """Run one controller in this process and record it."""
    settings = experiment.controllers[label]
    loops = following_loops(settings, experiment.trajectory)
    robot = str(experiment.world.robot_description)
    models = compensators(settings, robot)
    progress.phase(label, "running in this process")
    parameters = {CONTROLLERS_ENTRY: controllers_text(settings, robot)}
    metadata = parameters | slides_entry(experiment.slides)
    with (
        World(experiment.world, experiment.description) as world,
        BagWriter(bag, metadata=metadata) as writer,
    ):
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

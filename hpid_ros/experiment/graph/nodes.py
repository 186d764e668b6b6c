"""The nodes of an experiment on the graph: their processes and their parameter files.

The same files serve the nodes on a real robot: ``ros2 run hpid_ros joint_controllers --ros-args
--params-file controllers.yaml``, in whatever namespace.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from hpid_ros.base.errors import ExperimentError
from hpid_ros.base.names import ANYWHERE, controller_name
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.graph.options import GraphOptions
from hpid_ros.experiment.graph.processes import NodeGroup, NodeProcess
from hpid_ros.experiment.in_process import recorded_topics
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.simulation.base import REPORT_RATE
from hpid_ros.simulation.columns import columns
from hpid_ros.simulation.drives import Motor, Pwm
from hpid_ros.simulation.sensors import Homing
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.disturbances import Disturbances
from hpid_ros.simulation.world.gripper import task_topics
from hpid_ros.simulation.world.workpieces import Support, Workplace


def scene_document(workplace: Workplace) -> dict[str, Any]:
    """Return the parameters, nested; empty where nothing stands about the robot.

    Args:
        workplace: What does.
    """
    document: dict[str, Any] = {}
    if workplace.supports:
        document["supports"] = _boxes(workplace.supports)
    if workplace.bricks:
        masses = {"masses": [brick.mass for brick in workplace.bricks]}
        document["bricks"] = _boxes(workplace.bricks) | masses
        document["gripper"] = asdict(workplace.gripper)
    if workplace.schedule:
        document["gripper_schedule"] = {
            "times": [command.time_ns / NANOSECONDS for command in workplace.schedule],
            "closed": [command.is_closed for command in workplace.schedule],
        }
    return document


def _boxes(boxes: Sequence[Support]) -> dict[str, list[Any]]:
    return {
        "names": [box.name for box in boxes],
        "sizes": [edge for box in boxes for edge in box.size],
        "positions": [coordinate for box in boxes for coordinate in box.position],
        "yaws": [box.yaw for box in boxes],
        "frictions": [box.friction for box in boxes],
    }


def controllers_document(settings: Sequence[LoopSettings], robot: str = "") -> dict[str, Any]:
    """Return the parameters of all controllers, and of their composition in one process.

    Args:
        settings: One for each joint.
        robot: The robot's URDF, for controllers whose model has no other.
    """
    document: dict[str, Any] = {
        f"{ANYWHERE}joint_controllers": {
            "ros__parameters": {"joints": [each.joint for each in settings]}
        }
    }
    for each in settings:
        values = each.to_parameters()
        if each.model.is_on and not each.model.description:
            values["model.description"] = robot
        document[f"{ANYWHERE}{controller_name(each.joint)}"] = {"ros__parameters": _nested(values)}
    return document


def bridge_document(experiment: Experiment) -> dict[str, Any]:
    """Return the parameters of the bridge."""
    world = experiment.world
    return {
        f"{ANYWHERE}pybullet_bridge": {
            "ros__parameters": {
                "robot_description": str(world.robot_description),
                "joints": list(world.joints),
                "control_rate": NANOSECONDS / world.control_period_ns,
                "physics_steps": world.physics_steps,
                "initial_positions": [
                    float(world.initial_positions.get(joint, 0.0)) for joint in world.joints
                ],
                "encoder_counts": list(world.counts),
                "seed": world.seed,
                "fixed_base": world.fixed_base,
                "payload_mass": world.payload_mass,
                "duration": experiment.duration,
                "answer_timeout": experiment.answer_timeout,
                "ee_link": experiment.end_effector,
                **_models(world),
            }
        }
    }


def _models(world: WorldSettings) -> dict[str, Any]:
    """Return the parameters of all that is not ideal; what is left out is."""
    drives = world.drives
    parameters: dict[str, Any] = {
        "motor": columns(Motor, [drive.motor for drive in drives]),
        "pwm": columns(Pwm, [drive.pwm for drive in drives]),
        "homing": columns(Homing, world.homing),
        "payload_schedule": _payload(world.disturbances),
        "wrench_schedule": _wrenches(world.disturbances),
    }
    if any(drive.delay for drive in drives):
        parameters["effort_delay"] = [drive.delay for drive in drives]
    if any(world.position_noises):
        parameters["position_noise"] = list(world.position_noises)
    if world.base is not None:
        parameters["base"] = _base(world.base)
    if world.velocity != "none":
        parameters["velocity"] = world.velocity
    parameters |= scene_document(world.workplace)
    return {name: values for name, values in parameters.items() if values}


def _base(base: DifferentialDrive) -> dict[str, Any]:
    return {
        "left_wheel": base.left,
        "right_wheel": base.right,
        "wheel_radius": base.radius,
        "wheel_separation": base.separation,
    }


def _payload(disturbances: Disturbances) -> dict[str, Any]:
    changes = disturbances.payload
    if not changes:
        return {}
    return {
        "times": [change.time_ns / NANOSECONDS for change in changes],
        "masses": [change.mass for change in changes],
    }


def _wrenches(disturbances: Disturbances) -> dict[str, Any]:
    pulses = disturbances.wrenches
    if not pulses:
        return {}
    return {
        "links": [pulse.link for pulse in pulses],
        "forces": [component for pulse in pulses for component in pulse.force],
        "torques": [component for pulse in pulses for component in pulse.torque],
        "starts": [pulse.start_ns / NANOSECONDS for pulse in pulses],
        "durations": [pulse.duration_ns / NANOSECONDS for pulse in pulses],
    }


def write_parameters(path: Path, document: Mapping[str, Any]) -> None:
    """Write a ROS parameter file; the text of a robot gets a file of its own beside it."""
    values = _with_robots_beside(document, path.resolve().parent)
    path.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


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


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted names as nested mappings, the form that ``ros2 param dump`` gives."""
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *path, last = name.split(".")
        inner = nested
        for part in path:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return nested


_NODE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,200}")
BRIDGE, RECORDER, REFERENCE = "pybullet_bridge", "bag_recorder", "trajectory_publisher"
COMPOSED, SINGLE = "joint_controllers", "single_process"


class GraphNodes:
    """Starts the nodes of one run.

    Attributes:
        bridge: Name of the process that holds the bridge.
        recorder: Name of the process that holds the recorder.
        vital: Names of the processes that a run cannot do without.
        topics: What is recorded, in the order in which the recorder subscribes.

    Args:
        experiment: The experiment.
        label: Which of its controllers.
        bag: Folder of the bag to create.
        folder: Existing folder for parameter files and logs.
        options: How the run is spread over processes, paced and recorded.
    """

    def __init__(
        self,
        experiment: Experiment,
        label: str,
        bag: Path | None,
        folder: Path,
        options: GraphOptions,
    ) -> None:
        self._experiment, self._label, self._options = experiment, label, options
        self._bag, self._folder = bag, folder
        self.topics = recorded_topics(experiment.world)
        is_single = options.processes == "single"
        self.bridge = SINGLE if is_single else BRIDGE
        self.recorder = SINGLE if is_single else RECORDER
        self.vital = frozenset({self.bridge, self.recorder, REFERENCE})

    def start(self, group: NodeGroup) -> list[NodeProcess]:
        """Write the parameter files and start every process.

        Args:
            group: Takes the processes.
        """
        settings = self._experiment.controllers[self._label]
        robot = str(self._experiment.world.robot_description)
        write_parameters(self._folder / "bridge.yaml", bridge_document(self._experiment))
        write_parameters(self._folder / "controllers.yaml", controllers_document(settings, robot))
        reference = _parameters(reference_file=self._experiment.path)
        nodes = [group.start(REFERENCE, REFERENCE, reference)]
        topics = self.topics
        of_recorder = (
            _parameters(bag=self._bag, topics=topics) if self._options.is_recorded else []
        )
        of_all = _parameters(realtime_priority=self._options.realtime_priority)
        controllers, bridge = self.controller_arguments(), self.bridge_arguments() + of_all
        if self._options.processes == "single":
            of_recorder += _parameters(record=self._options.is_recorded)
            everything = [*controllers, *bridge, *of_recorder]
            return [*nodes, group.start(SINGLE, SINGLE, everything, is_renamed=False)]
        if self._options.is_recorded:
            nodes.append(group.start(RECORDER, RECORDER, of_recorder))
        if self._options.processes == "composed":
            nodes.append(group.start(COMPOSED, COMPOSED, controllers, is_renamed=False))
        else:
            names = [controller_name(each.joint) for each in settings]
            nodes += [group.start(name, "joint_controller", controllers) for name in names]
        return [*nodes, group.start(BRIDGE, BRIDGE, bridge)]

    def controller_arguments(self) -> list[str]:
        """Return the ROS arguments of a controller of the run, also for one that starts late."""
        return [
            *("--params-file", str(self._folder / "controllers.yaml")),
            *_parameters(
                wait_for_command_subscribers=1 + self._options.is_recorded,
                wait_for_reference=True,
                introspection_rate=0.0,
                certify=False,
                # In lock-step silence is a slow machine or a pause, and the control clock waits.
                state_watchdog=self._options.is_realtime,
                state_clock="simulated",
                realtime_priority=self._options.realtime_priority,
            ),
        ]

    def bridge_arguments(self) -> list[str]:
        """Return the ROS arguments of the bridge."""
        joints = len(self._experiment.world.joints)
        return [
            *("--params-file", str(self._folder / "bridge.yaml")),
            *_parameters(
                mode="realtime" if self._options.is_realtime else "lockstep",
                exit_when_done=False,
                # The controllers, the recorder, and the publisher of the reference.
                wait_for_subscribers=joints + self._options.is_recorded + 1,
                wait_for_publishers=joints,
                report_rate=REPORT_RATE if task_topics(self._experiment.world) else 0.0,
            ),
        ]


def require_node_names(joints: Iterable[str]) -> None:
    """Refuse joints after which no node, and no file of its log, can be called.

    Args:
        joints: Their names, as the robot's description has them.

    Raises:
        ExperimentError: A name is not letters, digits and underscores.
    """
    for joint in joints:
        if not _NODE_NAME.fullmatch(controller_name(joint)):
            raise ExperimentError(
                f"joint {joint!r} cannot have a node, whose name is letters, digits and "
                "underscores, the first no digit; --in-process needs none"
            )


def _parameters(**values: object) -> list[str]:
    """Return ROS arguments that set parameters."""
    arguments = []
    for name, value in values.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ["-p", f"{name}:={text}"]
    return arguments

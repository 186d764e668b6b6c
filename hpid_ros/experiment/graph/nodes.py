"""The nodes of an experiment on the graph: their processes and their parameters."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from hpid_ros.base.errors import ExperimentError
from hpid_ros.base.names import controller_name
from hpid_ros.control import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.graph.options import GraphOptions
from hpid_ros.experiment.graph.processes import NodeGroup, NodeProcess
from hpid_ros.experiment.in_process import recorded_topics
from hpid_ros.experiment.parameter_files import (
    bridge_name,
    controllers_document,
    write_document,
    write_run_files,
)
from hpid_ros.simulation.base import REPORT_RATE
from hpid_ros.simulation.world.gripper import task_topics

_NODE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,200}")
RECORDER, REFERENCE = "bag_recorder", "trajectory_publisher"
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
        self._executable = bridge_name(experiment.world)
        self.bridge = SINGLE if is_single else self._executable
        self.recorder = SINGLE if is_single else RECORDER
        self.vital = frozenset({self.bridge, self.recorder, REFERENCE})

    def start(self, group: NodeGroup) -> list[NodeProcess]:
        """Write the parameter files and start every process.

        Args:
            group: Takes the processes.
        """
        settings = self._experiment.controllers[self._label]
        write_run_files(self._folder, self._experiment, settings)
        reference = _parameters(reference_file=self._experiment.path)
        nodes = [group.start(REFERENCE, REFERENCE, reference)]
        topics = self.topics
        of_recorder = (
            _parameters(bag=self._bag, topics=topics, controllers_file=self._kept(settings))
            if self._options.is_recorded
            else []
        )
        slides = sorted(self._experiment.slides)
        if of_recorder and slides:
            of_recorder += _parameters(slides=slides)
        of_all = _parameters(realtime_priority=self._options.realtime_priority)
        controllers, bridge = self.controller_arguments(), self.bridge_arguments() + of_all
        if self._are_messages_shared:
            controllers += _parameters(share_messages=True)
        if self._options.processes == "single":
            of_recorder += _parameters(
                record=self._options.is_recorded, engine=self._experiment.world.engine
            )
            everything = [*controllers, *bridge, *of_recorder]
            return [*nodes, group.start(SINGLE, SINGLE, everything, is_renamed=False)]
        if self._options.is_recorded:
            nodes.append(group.start(RECORDER, RECORDER, of_recorder))
        if self._options.processes == "composed":
            nodes.append(group.start(COMPOSED, COMPOSED, controllers, is_renamed=False))
        else:
            names = [controller_name(each.joint) for each in settings]
            nodes += [group.start(name, "joint_controller", controllers) for name in names]
        return [*nodes, group.start(self._executable, self._executable, bridge)]

    def _kept(self, settings: Sequence[LoopSettings]) -> Path:
        """Write the parameters that the bag keeps: with all that is given on the command line."""
        file = self._folder / "recorded_controllers.yaml"
        kept = [
            replace(each, timing=replace(each.timing, state_clock="simulated"))
            for each in settings
        ]
        write_document(
            file, controllers_document(kept, str(self._experiment.world.robot_description))
        )
        return file

    @property
    def _are_messages_shared(self) -> bool:
        """Whether all controllers are in one process, and answer each state in one message."""
        return self._options.processes != "each"

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
        controllers = 1 if self._are_messages_shared else joints
        return [
            *("--params-file", str(self._folder / "bridge.yaml")),
            *_parameters(
                mode="realtime" if self._options.is_realtime else "lockstep",
                exit_when_done=False,
                # The controllers, the recorder, and the publisher of the reference.
                wait_for_subscribers=controllers + self._options.is_recorded + 1,
                wait_for_publishers=controllers,
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

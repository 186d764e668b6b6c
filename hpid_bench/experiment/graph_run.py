"""A run on the ROS graph, and a short trial that measures the rate a machine holds."""

from __future__ import annotations

import os
import select
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from hpid_bench.experiment.description import Experiment
from hpid_bench.experiment.in_process import (
    NoProgress,
    Progress,
    RunReport,
    bridge_name,
    controllers_text,
    recorded_topics,
    run_timing,
    write_reference,
    write_run_files,
)
from hpid_bench.experiment.processes import (
    NodeGroup,
    blaming_shared_memory,
    closed_environment,
    own_domain,
    parameters,
    require_no_sockets,
    require_shared_memory,
)
from hpid_ros.base.errors import ExperimentError, RunError, SettingError
from hpid_ros.base.names import controller_name, require_node_names
from hpid_ros.base.processes import raise_if_interrupted
from hpid_ros.control.settings import LoopSettings
from hpid_ros.simulation.gripper import task_topics
from hpid_ros.simulation.reports import REPORT_RATE

PROCESSES = ("each", "composed", "single")


@dataclass(frozen=True)
class GraphOptions:
    """Choices that change how fast a run goes and, in lock-step, nothing of its numbers."""

    # each: every controller in a process of its own; composed: all of them in one; single: the
    # robot, too; None: each where every process has a core, else composed
    processes: str | None = None
    is_recorded: bool = True  # whether a recorder writes a bag
    # the wall clock paces the states, and no state waits for its answers
    is_realtime: bool = False
    realtime_priority: int = 0  # SCHED_FIFO priority of controllers and bridge; 0 asks for none

    def __post_init__(self) -> None:
        if self.processes not in (None, *PROCESSES):
            raise SettingError(
                f"processes must be one of {', '.join(PROCESSES)}, not {self.processes!r}"
            )
        if not 0 <= self.realtime_priority <= 99:
            raise SettingError(
                f"realtime_priority must lie in [0, 99], not {self.realtime_priority}"
            )

    def for_joints(self, count: int, cores: int) -> GraphOptions:
        """Return these with the processes of so many controllers on so many cores."""
        if self.processes is not None:
            return self
        return replace(self, processes="each" if count + 1 <= cores else "composed")


_START_WITHIN = 60.0  # [s] from the first process to the first state
_START_EACH = 3.0  # [s] more for each process: they find each other two by two
_RECORD_WITHIN = 10.0  # [s] from the last answer, or from one message more in the bag, to the next
_LEAVE_WITHIN = 10.0  # [s] for all nodes to leave and to say how long they took
_CLOSE_WITHIN = 30.0  # [s] for the recorder to finish the bag

_PHASES = ("starting", "running", "recording", "leaving")
BAG_RECORDER, TRAJECTORY_PUBLISHER = "bag_recorder", "trajectory_publisher"
COMPOSED, SINGLE = "joint_controllers", "single_process"


class GraphNodes:
    def __init__(
        self,
        experiment: Experiment,
        label: str,
        bag: Path | None,
        folder: Path,
        options: GraphOptions,
    ) -> None:
        self._experiment, self._label = experiment, label
        joints, cores = len(experiment.controllers[label]), len(os.sched_getaffinity(0))
        self._options = options = options.for_joints(joints, cores)
        self._bag, self._folder = bag, folder
        self.topics = recorded_topics(experiment.world)
        is_single = options.processes == "single"
        self._executable = bridge_name(experiment.world)
        self.bridge = SINGLE if is_single else self._executable
        # In real time a disk that blocks must not hold the robot up.
        self._is_apart = options.is_recorded and options.is_realtime and not is_single
        self.recorder = BAG_RECORDER if self._is_apart else self.bridge
        self.vital = frozenset({self.bridge, self.recorder, TRAJECTORY_PUBLISHER})

    def start(self, group: NodeGroup) -> None:
        """Write the parameter files and start every process."""
        options, world = self._options, self._experiment.world
        settings = self._experiment.controllers[self._label]
        write_run_files(self._folder, self._experiment, settings)
        reference = write_reference(self._folder, self._experiment)
        group.start(
            TRAJECTORY_PUBLISHER, TRAJECTORY_PUBLISHER, parameters(reference_file=reference)
        )
        recorder = []
        if options.is_recorded:
            kept = self._kept(settings)
            recorder = parameters(bag=self._bag, topics=self.topics, controllers_file=kept)
            if self._experiment.slides:
                recorder += parameters(slides=sorted(self._experiment.slides))
        controllers = self.controller_arguments()
        bridge = self.bridge_arguments()
        if self._is_apart:
            group.start(BAG_RECORDER, BAG_RECORDER, recorder)
        elif options.is_recorded:
            bridge += [*recorder, *parameters(record=True)]
        bridge += parameters(realtime_priority=options.realtime_priority)
        if self._are_messages_shared:
            controllers += parameters(share_messages=True)
        if options.processes == "single":
            everything = [*controllers, *bridge, *parameters(engine=world.engine)]
            group.start(SINGLE, SINGLE, everything, is_renamed=False)
            return
        if options.processes == "composed":
            group.start(COMPOSED, COMPOSED, controllers, is_renamed=False)
        else:
            for each in settings:
                group.start(controller_name(each.joint), "joint_controller", controllers)
        group.start(self._executable, self._executable, bridge, is_renamed=False)

    def _kept(self, settings: Sequence[LoopSettings]) -> Path:
        """Write the parameters that the bag keeps: with all that is given on the command line."""
        file = self._folder / "recorded_controllers.yaml"
        kept = [
            replace(each, timing=replace(each.timing, state_clock="simulated"))
            for each in settings
        ]
        # The robot's text within: a bag must not name a file of this folder, which may move.
        robot = str(self._experiment.world.robot_description)
        file.write_text(controllers_text(kept, robot), encoding="utf-8")
        return file

    @property
    def _are_messages_shared(self) -> bool:
        """Whether all controllers are in one process, and answer each state in one message."""
        return self._options.processes != "each"

    def controller_arguments(self) -> list[str]:
        """Return the ROS arguments of a controller of the run, also for one that starts late."""
        return [
            "--params-file",
            str(self._folder / "controllers.yaml"),
            *parameters(
                wait_for_command_subscribers=1 + self._is_apart,
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
        joints = len(self._experiment.world.joints)
        controllers = 1 if self._are_messages_shared else joints
        return [
            "--params-file",
            str(self._folder / "bridge.yaml"),
            *parameters(
                mode="realtime" if self._options.is_realtime else "lockstep",
                exit_when_done=False,
                # The controllers, a recorder apart, and the publisher of the reference.
                wait_for_subscribers=controllers + self._is_apart + 1,
                wait_for_publishers=controllers,
                report_rate=REPORT_RATE if task_topics(self._experiment.world) else 0.0,
            ),
        ]


def run_on_graph(
    experiment: Experiment,
    label: str,
    bag: Path | None,
    folder: Path,
    progress: Progress,
    options: GraphOptions | None = None,
) -> RunReport:
    """Run one controller on the real ROS 2 graph and record it.

    The graph is closed to everything outside this run. Whatever ends the run, also an
    interrupt, ends every process, and the recorder finishes its bag.
    """
    options = options or GraphOptions()
    begun = [time.monotonic()]
    require_node_names((each.joint for each in experiment.controllers[label]), ExperimentError)
    require_shared_memory()
    nodes = GraphNodes(experiment, label, bag, folder, options)
    with (
        blaming_shared_memory(),
        own_domain() as domain,
        NodeGroup(
            closed_environment(domain), folder, is_batch=not options.is_realtime, is_forked=True
        ) as group,
    ):
        run = _GraphRun(nodes, label, group, progress)
        try:
            progress.phase(label, "starting the nodes")
            nodes.start(group)
            start_within = _START_WITHIN + _START_EACH * len(group.nodes)
            lonely = "not every node had found the others"
            run.wait_for("started", nodes.bridge, start_within, lonely)
            begun.append(time.monotonic())
            run.wait_for("finished", nodes.bridge, None, "no last state")
            begun.append(time.monotonic())
        except BaseException:
            # The recorder has its time all the same.
            if options.is_recorded and nodes.recorder in group.nodes:
                group.stop([nodes.recorder], patience=_CLOSE_WITHIN)
            raise
        if options.is_recorded:
            run.wait_until_recorded(_RECORD_WITHIN)
            # First, so that the zero efforts with which the controllers leave are not in the bag.
            group.stop([nodes.recorder], patience=_CLOSE_WITHIN)
        begun.append(time.monotonic())
        processes = len(group.nodes)
        group.stop(patience=_LEAVE_WITHIN)
        begun.append(time.monotonic())
        run.take_events()  # what they said when they ended
        finished = run.events[nodes.bridge, "finished"]
        timing = run_timing(finished, run.timing)
        wall_time, states = finished["wall_time"], finished["states"]
        spent = {
            phase: round(later - earlier, 3)
            for phase, (earlier, later) in zip(_PHASES, pairwise(begun), strict=True)
        }
        return RunReport(label, wall_time, states, processes, run.warnings, timing, spent)


class _GraphRun:
    """Watches the nodes of one run through their event pipes."""

    def __init__(
        self, nodes: GraphNodes, label: str, group: NodeGroup, progress: Progress
    ) -> None:
        self._nodes, self._label = nodes, label
        self._group, self._progress = group, progress
        self.events: dict[tuple[str, str], Mapping[str, Any]] = {}
        self.timing: dict[str, Mapping[str, Any]] = {}
        self.warnings: list[str] = []
        self._excused: set[str] = set()
        self._closed: set[str] = set()

    def wait_for(self, event: str, node: str, within: float | None, what: str) -> None:
        self._wait(lambda: (node, event) in self.events, within, lambda: what)

    def wait_until_recorded(self, within: float) -> None:
        """Wait until the bag holds every state and every command that was answered."""
        self._progress.phase(self._label, "closing the bag")
        finished = self.events[self._nodes.bridge, "finished"]
        expected = {"/joint_states": finished["states"], "/joint_commands": finished["commands"]}
        reports = finished.get("reports", {})
        expected |= {each: reports[each] for each in reports if each[1:] in self._nodes.topics}

        def missing() -> dict[str, int]:
            counts = self.events.get((self._nodes.recorder, "recorded"), {}).get("counts", {})
            return {
                topic: count - counts.get(topic, 0)
                for topic, count in expected.items()
                if counts.get(topic, 0) < count
            }

        self._wait(
            lambda: not missing(),
            within,
            lambda: f"the recorder lacks {missing()}",
            lambda: sum(missing().values()),
        )

    def _wait(
        self,
        is_true: Callable[[], bool],
        within: float | None,
        what: Callable[[], str],
        left: Callable[[], int] = int,
    ) -> None:
        """Wait for something, and longer whenever less of it is left."""
        deadline = None if within is None else time.monotonic() + within
        before = left()
        while not is_true():
            open_pipes = [each.events for each in self._group.nodes.values() if each.is_open]
            select.select(open_pipes, [], [], 0.05)
            self.take_events()
            self._look_after_nodes()
            raise_if_interrupted()
            if within is not None and left() < before:
                before, deadline = left(), time.monotonic() + within
            if deadline is not None and time.monotonic() > deadline and not is_true():
                raise RunError(f"{self._label}: timed out after {within:g} s: {what()}")

    def take_events(self) -> None:
        for node in self._group.nodes.values():
            for event in node.read_events():
                self._on_event(node.name, event)

    def _on_event(self, node: str, event: Mapping[str, Any]) -> None:
        name = str(event["event"])
        self._require_closed(node)
        self.events[node, name] = event
        if name == "timing":
            self.timing[event["joint"]] = event
        if name == "progress":
            self._progress.advanced(self._label, event["stamp_ns"] * 1e-9)
        elif name == "started":
            for each in self._group.nodes:
                self._require_closed(each)
            self._progress.phase(self._label, "running")
        elif name == "silent":
            seconds = event["stamp_ns"] * 1e-9
            joints = ", ".join(event["joints"])
            line = f"{joints}: no command since {seconds:.3f} s; zero effort is applied"
            self.warnings.append(line)
        elif name == "failed":
            raise RunError(f"{self._label}: {event['reason']}")

    def _require_closed(self, name: str) -> None:
        """Look once at every node that is up whether it is closed to the network."""
        node = self._group.nodes[name]
        if name not in self._closed and node.process.poll() is None:
            require_no_sockets([node.pid])
            self._closed.add(name)

    def _look_after_nodes(self) -> None:
        """Raise when a node ended that the run cannot do without."""
        for name, node in self._group.nodes.items():
            code = node.process.poll()
            if code is None or name in self._excused:
                continue
            for event in node.read_events():
                self._on_event(name, event)
            has_started = (self._nodes.bridge, "started") in self.events
            others = self._group.nodes.keys() - self._nodes.vital - {name}
            others_run = any(self._group.nodes[e].process.poll() is None for e in others)
            if name not in self._nodes.vital and has_started and others_run:
                self._excused.add(name)
                self.warnings.append(f"{name} ended with code {code}; the other joints go on")
                continue
            raise RunError(
                f"{self._label}: {name} ended with code {code}: {node.last_words()} "
                f"(log: {node.log})"
            )


TRIAL_DURATION = 1.0  # [s] of simulated time
_MILLISECONDS = 1e-3  # in a microsecond


def run_trial(experiment: Experiment, label: str, options: GraphOptions) -> str:
    """Run the beginning of an experiment in lock-step, and say whether its rate can be held."""
    short = replace(experiment, duration=min(TRIAL_DURATION, experiment.duration))
    with tempfile.TemporaryDirectory(prefix="hpid_trial_") as name:
        folder = Path(name)
        report = run_on_graph(
            short, label, folder / "bag", folder, NoProgress(), replace(options, is_realtime=False)
        )
    assert report.timing is not None
    median, p99 = (report.timing["cycle"][name] * _MILLISECONDS for name in ("median", "p99"))
    return trial_line(report.states, median, p99, experiment.world.control_period_ns * 1e-6)


def trial_line(cycles: int, median: float, p99: float, period: float) -> str:
    """Say what so many cycles took, in [ms], beside the control period that is asked for."""
    found = (
        f"trial of {cycles} states: a cycle takes {median:.2f} ms, 99 of 100 at most {p99:.2f} ms"
    )
    wanted = f"{period:.4g} ms ({1e3 / period:.4g} Hz)"
    if p99 <= period:
        return f"{found}: {wanted} can be held"
    how_often = "most" if median > period else "some"
    return (
        f"{found}: more than {wanted}, so that {how_often} states will be late or lost; a "
        f"lower control.rate, fewer processes, --engine mujoco or --no-record ask for less"
    )

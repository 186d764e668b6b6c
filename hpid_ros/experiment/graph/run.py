"""One controller of an experiment on the real graph of ROS 2."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hpid_ros.base.errors import RunError
from hpid_ros.base.interrupts import raise_if_interrupted
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.graph.isolation import closed_environment, own_domain, require_no_sockets
from hpid_ros.experiment.graph.nodes import GraphNodes, require_node_names
from hpid_ros.experiment.graph.options import GraphOptions
from hpid_ros.experiment.graph.processes import NodeGroup, NodeProcess
from hpid_ros.experiment.progress import Progress, RunReport, run_timing

_START_WITHIN = 60.0  # [s] from the first process to the first state
_START_EACH = 3.0  # [s] more for each process: they find each other two by two
_RECORD_WITHIN = 10.0  # [s] from the last answer to the last message in the bag
_CLOSE_WITHIN = 30.0  # [s] for the recorder to finish the bag


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

    Args:
        experiment: The experiment.
        label: Which of its controllers.
        bag: Folder of the bag to create; not used when nothing is recorded.
        folder: Existing folder for parameter files and logs of the nodes.
        progress: Is told how far the run is.
        options: How it is spread over processes, paced and recorded; by default every node has
            a process of its own, in lock-step, recorded.

    Raises:
        ExperimentError: A joint's name cannot be part of a node's.
        RunError: A node failed, or something was not recorded.
    """
    options = options or GraphOptions()
    require_node_names(each.joint for each in experiment.controllers[label])
    nodes = GraphNodes(experiment, label, bag, folder, options)
    with (
        own_domain() as domain,
        NodeGroup(closed_environment(domain), folder, is_batch=not options.is_realtime) as group,
    ):
        run = _GraphRun(nodes, label, group, progress)
        run.start()
        start_within = _START_WITHIN + _START_EACH * len(group.nodes)
        run.wait_for("started", nodes.bridge, start_within, "every node to find the others")
        run.wait_for("finished", nodes.bridge, None, "the last state")
        if options.is_recorded:
            run.wait_until_recorded(_RECORD_WITHIN)
            # First, so that the zero efforts with which the controllers leave are not in the bag.
            group.stop([nodes.recorder], patience=_CLOSE_WITHIN)
        processes = len(group.nodes)
        group.stop()
        run.take_last_events()
        finished = run.events[nodes.bridge, "finished"]
        timing = run_timing(finished, run.timing)
        return RunReport(
            label,
            wall_time=finished["wall_time"],
            states=finished["states"],
            processes=processes,
            warnings=run.warnings,
            timing=timing,
        )


class _GraphRun:
    """Watches the nodes of one run through their event pipes."""

    def __init__(
        self, nodes: GraphNodes, label: str, group: NodeGroup, progress: Progress
    ) -> None:
        self._nodes, self._label = nodes, label
        self._group, self._progress = group, progress
        self._selector = selectors.DefaultSelector()
        self.events: dict[tuple[str, str], Mapping[str, Any]] = {}
        self.timing: dict[str, Mapping[str, Any]] = {}
        self.warnings: list[str] = []
        self._excused: set[str] = set()
        self._closed: set[str] = set()

    def start(self) -> None:
        """Start every node."""
        self._progress.phase(self._label, "starting the nodes")
        for node in self._nodes.start(self._group):
            self._selector.register(node.events, selectors.EVENT_READ, node)

    def take_last_events(self) -> None:
        """Read what the nodes said when they ended."""
        for node in self._group.nodes.values():
            self._take_events(node)

    def wait_for(self, event: str, node: str, within: float | None, what: str) -> None:
        """Wait for an event of a node.

        Raises:
            RunError: It did not come in time, or a node that is needed has ended.
        """
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

        self._wait(lambda: not missing(), within, lambda: f"the recorder: it lacks {missing()}")

    def _wait(
        self, is_true: Callable[[], bool], within: float | None, what: Callable[[], str]
    ) -> None:
        deadline = None if within is None else time.monotonic() + within
        while not is_true():
            ready = self._selector.select(timeout=0.05)
            for key, _ in ready:
                self._take_events(key.data)
            self._look_after_nodes()
            raise_if_interrupted()
            if deadline is not None and time.monotonic() > deadline and not is_true():
                raise RunError(f"{self._label}: waited {within:g} s in vain for {what()}")

    def _take_events(self, node: NodeProcess) -> None:
        events = node.read_events()
        if not events and node.process.poll() is not None:
            self._forget(node)
        for event in events:
            self._on_event(node.name, event)

    def _forget(self, node: NodeProcess) -> None:
        if node.events in self._selector.get_map():
            self._selector.unregister(node.events)

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
            self.warnings.append(f"no answer from {joints} from {seconds:.3f} s on: no effort")
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
            if name not in self._nodes.vital and has_started and self._others_run(name):
                self._excused.add(name)
                self.warnings.append(f"{name} ended with code {code}; the other joints go on")
                continue
            raise RunError(
                f"{self._label}: {name} ended with code {code}: {node.last_words()} "
                f"(log: {node.log})"
            )

    def _others_run(self, name: str) -> bool:
        return any(
            node.process.poll() is None
            for other, node in self._group.nodes.items()
            if other != name and other not in self._nodes.vital
        )

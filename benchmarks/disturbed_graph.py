"""The package's graph while its controllers are killed, ended and frozen, one after the other."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hpid_bench.experiment.description import Experiment
from hpid_bench.experiment.graph_run import GraphNodes, GraphOptions
from hpid_bench.experiment.processes import NodeGroup, NodeProcess
from hpid_ros.base.errors import RunError
from hpid_ros.base.names import controller_name
from hpid_ros.base.processes import raise_if_interrupted

KINDS = ("kill", "terminate", "freeze")
"""SIGKILL and a restart; SIGTERM and a restart; SIGSTOP and, some time after, SIGCONT."""

SETTLE = 3.0  # [s] of simulated time between the end of a fault and the next
_UP_WITHIN = 60.0  # [s]
_BACK_WITHIN = 30.0  # [s] of wall time for a joint to be answered for again
_FROZEN_FOR = (0.0, 0.5)  # [s] of wall time after the bridge has given up
_PAUSE = 0.02  # [s]


@dataclass
class Fault:
    """One fault of one controller."""

    joint: str  # whose controller it hits
    kind: str  # one of :data:`KINDS`
    # simulated time last told before it was injected, in [ns]. From here on the joint may differ,
    # though no state goes unanswered: an ended controller's last zero replaces its answer, and a
    # successor may be up before the bridge gives the joint up
    begin_ns: int
    # stamp of the first state that the joint did not answer, in [ns]; None if the controller was
    # back before the bridge gave it up
    silent_ns: int | None = None
    # simulated time at which the joint was seen to answer again, in [ns]
    back_ns: int | None = None


class DisturbedGraph:
    """One run whose controllers are disturbed at random, one at a time."""

    def __init__(
        self,
        experiment: Experiment,
        label: str,
        group: NodeGroup,
        folder: Path,
        bag: Path | None,
        chance: random.Random,
    ) -> None:
        options = GraphOptions("each", is_recorded=bag is not None)
        self.nodes = GraphNodes(experiment, label, bag, folder, options)
        self.joints = experiment.world.joints
        self.faults: list[Fault] = []
        self.misses: list[tuple[str, int]] = []  # joint and stamp [ns] of each that was given up
        self.events: dict[tuple[str, str], Mapping[str, Any]] = {}
        self.stamp_ns = 0
        self._group, self._chance = group, chance
        self._processes: dict[str, NodeProcess] = {}
        self._silent: tuple[str, ...] = ()
        self._starts = 0
        self._next_ns = 0

    def start(self) -> None:
        """Start every node and wait for the first state."""
        self.nodes.start(self._group)
        self._processes.update(self._group.nodes)
        self._wait(lambda: (self.nodes.bridge, "started") in self.events, _UP_WITHIN, "a start")
        self._plan_next()

    @property
    def is_finished(self) -> bool:
        """Whether the last state has come."""
        return (self.nodes.bridge, "finished") in self.events

    def pids(self) -> dict[str, int]:
        """Return the process ids of all nodes by name."""
        return {name: process.pid for name, process in self._processes.items()}

    def look(self) -> None:
        """Take what the nodes have told since the last look."""
        time.sleep(_PAUSE)
        raise_if_interrupted()
        for name, process in self._processes.items():
            for event in process.read_events():
                self._take(name, event)
            code = process.process.poll()
            if code is not None:
                raise RunError(f"{name} ended with code {code}: {process.last_words()}")

    def take_last_events(self) -> None:
        """Take what the nodes said when they ended."""
        for name, process in self._processes.items():
            for event in process.read_events():
                self._take(name, event)

    def disturb_when_due(self, until_ns: int | None = None) -> bool:
        """Inject one fault if it is time for the next, and see it through to its end.

        Returns:
            Whether there was a fault.
        """
        if self.stamp_ns < self._next_ns or self.is_finished:
            return False
        if until_ns is not None and self.stamp_ns > until_ns:
            return False
        fault = Fault(self._chance.choice(self.joints), self._chance.choice(KINDS), self.stamp_ns)
        self.faults.append(fault)
        if fault.kind == "freeze":
            self._freeze(fault)
        else:
            self._restart(fault)
        undone_ns = self.stamp_ns
        self._wait(
            lambda: fault.joint not in self._silent and self.stamp_ns > undone_ns,
            _BACK_WITHIN,
            f"{fault.joint} to answer again",
        )
        fault.back_ns = self.stamp_ns
        self._plan_next()
        return True

    def _freeze(self, fault: Fault) -> None:
        pid = self._processes[controller_name(fault.joint)].pid
        os.kill(pid, signal.SIGSTOP)
        try:
            self._wait_for_silence(fault)
            time.sleep(self._chance.uniform(*_FROZEN_FOR))
        finally:
            os.kill(pid, signal.SIGCONT)

    def _wait_for_silence(self, fault: Fault) -> None:
        before = len(self.misses)
        self._wait(
            lambda: (
                any(joint == fault.joint for joint, _ in self.misses[before:]) or self.is_finished
            ),
            _BACK_WITHIN,
            f"the bridge to give up {fault.joint}",
        )

    def _restart(self, fault: Fault) -> None:
        name = controller_name(fault.joint)
        old = self._processes[name]
        number = signal.SIGKILL if fault.kind == "kill" else signal.SIGTERM
        old.process.send_signal(number)
        old.process.wait(_BACK_WITHIN)
        for event in old.read_events():
            self._take(name, event)
        self.events.pop((name, "listening"), None)
        self._starts += 1
        self._processes[name] = self._group.start(
            f"{name}.{self._starts}",
            "joint_controller",
            ["-r", f"__node:={name}", *self.nodes.controller_arguments()],
            is_renamed=False,
        )
        self._wait(
            lambda: (name, "listening") in self.events or self.is_finished,
            _UP_WITHIN,
            f"{name} to listen again",
        )

    def _take(self, name: str, event: Mapping[str, Any]) -> None:
        kind = str(event["event"])
        self.events[name, kind] = event
        if kind == "failed":
            raise RunError(f"{name}: {event['reason']}")
        if kind == "progress":
            self.stamp_ns, self._silent = event["stamp_ns"], tuple(event["silent"])
        elif kind == "silent":
            self._silent = (*self._silent, *event["joints"])
            self.misses += [(joint, event["stamp_ns"]) for joint in event["joints"]]
            for joint in event["joints"]:
                self._note_silence(joint, event["stamp_ns"])

    def _note_silence(self, joint: str, stamp_ns: int) -> None:
        if self.faults and self.faults[-1].joint == joint and self.faults[-1].silent_ns is None:
            self.faults[-1].silent_ns = stamp_ns

    def _plan_next(self) -> None:
        self._next_ns = self.stamp_ns + round(1e9 * (SETTLE + self._chance.random()))

    def _wait(self, is_true: Any, within: float, what: str) -> None:
        deadline = time.monotonic() + within
        while not is_true():
            self.look()
            if time.monotonic() > deadline:
                raise RunError(f"waited {within:g} s in vain for {what}")

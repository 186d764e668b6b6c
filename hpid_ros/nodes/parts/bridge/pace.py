"""The bridge's parameters and measurements of time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from hpid_ros.base.durations import Durations
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.ros.parameters import read_choice, read_number, read_only


class BridgeTiming:
    """Wall-clock figures of the bridge.

    A cycle is the time between two published states; a joint's latency the time from a state's
    publication to the arrival of the joint's answer to it.

    Args:
        joints: The driven joints.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self._cycles = Durations()
        self._latencies = {joint: Durations() for joint in joints}
        self._notes = {joint: each.note for joint, each in self._latencies.items()}
        self.published_ns = self._first_ns = 0
        self._reported = time.perf_counter_ns(), 0

    def published(self) -> None:
        """Note that a state is about to be published."""
        now = time.perf_counter_ns()
        if self.published_ns:
            self._cycles.note(now - self.published_ns)
        else:
            self._first_ns = now
        self.published_ns = now

    def answered(self, joints: Sequence[str]) -> None:
        """Note that the answers of joints to the last published state have come."""
        delay_ns = time.perf_counter_ns() - self.published_ns
        for joint in joints:
            note = self._notes.get(joint)
            if note is not None:
                note(delay_ns)

    @property
    def elapsed(self) -> float:
        """Time since the first state was published, in [s]."""
        return (time.perf_counter_ns() - self._first_ns) / NANOSECONDS

    def recent(self, simulated_ns: int) -> dict[str, float]:
        """Return the figures since the last call, with their units, for ``/diagnostics``.

        Args:
            simulated_ns: Simulated time in [ns].
        """
        now, (then, before) = time.perf_counter_ns(), self._reported
        self._reported = now, simulated_ns
        cycle = self._cycles.recent()
        figures = {
            "real-time factor": max(simulated_ns - before, 0) / max(now - then, 1),
            "cycle, median [us]": cycle.median,
            "cycle, 99th percentile [us]": cycle.p99,
            "cycle, largest [us]": cycle.maximum,
        }
        for joint, durations in self._latencies.items():
            latency = durations.recent()
            figures[f"{joint}: answer latency, median [us]"] = latency.median
            figures[f"{joint}: answer latency, 99th percentile [us]"] = latency.p99
        return figures

    def whole(self) -> dict[str, Any]:
        """Return the figures of the whole run, in [us], for a parent process."""
        return {
            "cycle": self._cycles.whole()._asdict(),
            "latency": {
                joint: durations.whole()._asdict() for joint, durations in self._latencies.items()
            },
        }


MODES = ("lockstep", "realtime")

_RESTART_TAKES = 0.2  # [s], at least: nobody waits for the place of one that was killed
_POSITIVE = (1e-6, 1e6)


@dataclass(frozen=True)
class Pace:
    """When a state is published.

    Attributes:
        is_lockstep: Every state waits for its answers; otherwise the wall clock paces them.
        end_ns: Stamp of the last state in [ns]; None runs for ever.
        exits: Whether the process ends after the last state.
        real_time_factor: Simulated time per wall time in realtime.
        answer_timeout: Wall time that lockstep waits for one answer in [s].
        command_timeout_ns: Simulated time for which a command stands in realtime in [ns].
        subscribers: Subscribers that the states must have before the first one.
        publishers: Publishers that the commands must have before the first state.
    """

    is_lockstep: bool
    end_ns: int | None
    exits: bool
    real_time_factor: float
    answer_timeout: float
    command_timeout_ns: int
    subscribers: int
    publishers: int

    @property
    def command_patience(self) -> float:
        """Silence of a joint's publisher after which another one may command it, in [s]."""
        if self.is_lockstep:
            return min(self.answer_timeout, _RESTART_TAKES)
        return self.command_timeout_ns / NANOSECONDS / self.real_time_factor


def read_pace(node: Node, joints: int, answer_timeout: float) -> Pace:
    """Declare the parameters of time and return what they say.

    Args:
        node: The bridge.
        joints: Number of driven joints; lockstep waits for as many controllers.
        answer_timeout: Wall time that lockstep waits for one answer in [s].

    Raises:
        SettingError: A value is out of range.
    """
    mode = read_choice(node, "mode", "lockstep", f"Pace of the states: {', '.join(MODES)}", MODES)
    everyone = joints if mode == "lockstep" else 0

    def positive(name: str, default: float, description: str) -> float:
        return read_number(node, name, default, description, _POSITIVE)

    duration = read_number(
        node, "duration", 0.0, "Stamp of the last state [s]; 0 runs for ever", (0.0, 1e9)
    )
    timeout = positive(
        "command_timeout", 0.1, "Simulated time for which a command stands in realtime [s]"
    )
    return Pace(
        is_lockstep=mode == "lockstep",
        end_ns=round(duration * NANOSECONDS) if duration > 0.0 else None,
        exits=read_only(node, "exit_when_done", True, "End the process after the last state"),
        real_time_factor=positive(
            "real_time_factor", 1.0, "Simulated time per wall time in realtime"
        ),
        answer_timeout=answer_timeout,
        command_timeout_ns=round(timeout * NANOSECONDS),
        subscribers=read_only(
            node, "wait_for_subscribers", everyone, "Subscribers that states must have first"
        ),
        publishers=read_only(
            node, "wait_for_publishers", everyone, "Publishers that commands must have first"
        ),
    )

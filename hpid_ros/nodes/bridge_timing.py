"""How fast the bridge goes round, and how soon each joint answers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from hpid_ros.durations import Durations

_NANOSECONDS = 1_000_000_000


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

    def answered(self, joint: str) -> None:
        """Note that a joint's answer to the last published state has come."""
        note = self._notes.get(joint)
        if note is not None:
            note(time.perf_counter_ns() - self.published_ns)

    @property
    def elapsed(self) -> float:
        """Time since the first state was published, in [s]."""
        return (time.perf_counter_ns() - self._first_ns) / _NANOSECONDS

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

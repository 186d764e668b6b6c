"""A merger's health: who is silent, late, twice or not heard, counted and named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rclpy.node import Node

from hpid_ros.base.durations import Durations
from hpid_ros.merging import CommandMerger
from hpid_ros.nodes.ros.status import ERROR, OK, WARN, Diagnostics

_OFTEN_LATE = 0.1  # of the messages of a report
_MICROSECOND = 1e3  # [ns]


class Standing(NamedTuple):
    """How a merger stands at its surroundings."""

    lifecycle: str  # the managed node's state
    waiting: str  # what it waits for before it sends anything; empty if nothing
    is_unheard: bool  # whether that is a controller that does not act, or cannot be used
    claim: str  # how its claim of the topic stands
    refusal: str  # whose the topic is if not its own; empty if nobody has said so
    told_by: str  # who says whether the receiver is active
    rivals: Sequence[str]  # nodes that publish beside it
    withheld: int  # messages that were not sent while it was not known to whom they would go


class MergerHealth:
    """Counts what came, and publishes the merger's status."""

    period = 1.0

    def __init__(self, node: Node, topic: str) -> None:
        self._topic = topic
        self._diagnostics = Diagnostics(node, topic)
        self.fault = self._diagnostics.fault
        self.misread = 0
        self.delays = Durations()
        self._requests = 0
        self._before: dict[str, tuple[int, int]] = {}  # late and invalid, by joint
        self._sent_before = 0
        self.scheduling = ""

    def misread_command(self, line: str) -> None:
        """Note bytes that were no command."""
        self.misread += 1
        self.fault(f"command refused: {line}")

    def refused_request(self, line: str) -> None:
        """Note a service request, or a transition, that failed."""
        self._requests += 1
        self.fault(line)

    def report(self, standing: Standing, merger: CommandMerger | None, conflict: str) -> None:
        """Publish the status now."""
        level, message = self._verdict(standing, merger, conflict)
        self._diagnostics.publish(
            level,
            message,
            {
                "lifecycle": standing.lifecycle,
                "claim": standing.claim,
                "topic": self._topic,
                "activity told by": standing.told_by,
                **(_readings(merger) if merger is not None else {}),
                "messages withheld": standing.withheld,
                **self._delays(),
                "misread commands": self.misread,
                "refused requests": self._requests,
                "scheduling": self.scheduling,
                "last fault": self._diagnostics.last_fault,
            },
        )

    def _verdict(
        self, standing: Standing, merger: CommandMerger | None, conflict: str
    ) -> tuple[bytes, str]:
        if standing.lifecycle != "active":
            if standing.refusal:
                return WARN, f"{standing.lifecycle}: {standing.refusal}"
            return OK, standing.lifecycle
        errors = [conflict] if conflict else []
        if standing.rivals:
            errors.append(f"{', '.join(standing.rivals)} also publishes on {self._topic}")
        if standing.is_unheard:
            errors.insert(0, standing.waiting)
        if merger is not None and merger.has_begun and merger.silent:
            errors.append(shown_silent(merger))
        warnings = [standing.waiting] if standing.waiting and not standing.is_unheard else []
        warnings += self._irregular(merger) if merger is not None else []
        if errors or warnings:
            return ERROR if errors else WARN, "; ".join(errors + warnings)
        return OK, "merging"

    def _irregular(self, merger: CommandMerger) -> list[str]:
        """Return warnings of joints that were often late since the last report, or not finite."""
        messages, self._sent_before = merger.sent - self._sent_before, merger.sent
        lines = []
        for name, counts in merger.counts.items():
            late, invalid = self._before.get(name, (0, 0))
            self._before[name] = counts.late, counts.invalid
            if counts.invalid > invalid:
                lines.append(f"{name} commands what is not finite")
            elif counts.late - late > _OFTEN_LATE * max(messages, 1):
                lines.append(f"{name} is late")
        return lines

    def begin_anew(self) -> None:
        """Note that what was counted is counted from zero."""
        self._before, self._sent_before = {}, 0

    def _delays(self) -> dict[str, float]:
        spread = self.delays.recent()
        return {
            "first answer to message, median [us]": spread.median,
            "first answer to message, 99th percentile [us]": spread.p99,
            "first answer to message, largest [us]": spread.maximum,
        }


def shown_silent(merger: CommandMerger) -> str:
    """Return one line about the joints that are silent."""
    joints = ", ".join(f"{joint.name} (sent {joint.fallback:g})" for joint in merger.silent)
    return f"silent: {joints}"


def _readings(merger: CommandMerger) -> dict[str, object]:
    """Return what a merger counted, by name, for ``/diagnostics``."""
    counts = merger.counts.values()
    by_joint = {
        "late": {name: each.late for name, each in merger.counts.items()},
        "silences": {name: each.silences for name, each in merger.counts.items()},
        "returns": {name: each.returns for name, each in merger.counts.items()},
        "commands not finite": {name: each.invalid for name, each in merger.counts.items()},
    }
    return {
        "joints": ", ".join(merger.settings.names),
        "silent": ", ".join(joint.name for joint in merger.silent) or "none",
        "period of the states [us]": merger.rounds.period_ns / _MICROSECOND,
        "wait for stragglers [us]": merger.rounds.wait_ns / _MICROSECOND,
        "messages": merger.sent,
        "messages with every answer": merger.sent_whole,
        "commands": sum(each.commands for each in counts),
        "commands for other joints": merger.foreign,
        **{what: _named(values) for what, values in by_joint.items()},
    }


def _named(values: dict[str, int]) -> str:
    """Return the counts that are not zero, with their joints."""
    return ", ".join(f"{name} {count}" for name, count in values.items() if count) or "none"

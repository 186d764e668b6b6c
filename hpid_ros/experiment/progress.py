"""The progress of a run, and where its time went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from hpid_ros.base.durations import NOTHING, DurationSpread


@dataclass(frozen=True)
class JointTiming:
    """One joint's controller, seen from itself and from the bridge."""

    samples: int  # states that it answered
    missed: int  # states that never reached it, by their stamps
    unanswered: int  # states for which the bridge had no command of it
    period: DurationSpread  # between two states
    compute: DurationSpread  # from a state's bytes to the command handed to the middleware
    latency: DurationSpread  # from a state's publication to the arrival of its answer


@dataclass(frozen=True)
class RunTiming:
    cycle: DurationSpread  # between two states, as the bridge publishes them
    joints: Mapping[str, JointTiming]  # by joint

    def as_mapping(self) -> dict[str, object]:
        """Return all figures with their units, ready for JSON."""
        return {
            "unit": "us",
            "cycle": self.cycle._asdict(),
            "joints": {
                joint: {
                    name: value._asdict() if isinstance(value, DurationSpread) else value
                    for name, value in vars(timing).items()
                }
                for joint, timing in self.joints.items()
            },
        }


def run_timing(
    finished: Mapping[str, Any], controllers: Mapping[str, Mapping[str, Any]]
) -> RunTiming:
    bridge = finished["timing"]
    joints = {
        joint: JointTiming(
            samples=event["samples"],
            missed=event["missed"],
            unanswered=finished["counts"][joint]["unanswered"],
            period=DurationSpread(**event["period"]),
            compute=DurationSpread(**event["compute"]),
            latency=DurationSpread(**bridge["latency"].get(joint, NOTHING._asdict())),
        )
        for joint, event in controllers.items()
        if joint in finished["counts"]
    }
    return RunTiming(DurationSpread(**bridge["cycle"]), joints)


class Progress(Protocol):
    """Receives how far a run is."""

    def phase(self, label: str, what: str) -> None: ...
    def note(self, line: str) -> None: ...  # something worth knowing before a run begins
    def advanced(self, label: str, simulated: float) -> None: ...


class NoProgress:
    """Progress that nobody looks at."""

    def phase(self, label: str, what: str) -> None: ...
    def note(self, line: str) -> None: ...
    def advanced(self, label: str, simulated: float) -> None: ...


class NamedProgress:
    """Progress of runs that need another name beside their label."""

    def __init__(self, progress: Progress, name: str, labels: Sequence[str]) -> None:
        self._progress, self._name, self._last = progress, name, labels[-1]

    def phase(self, label: str, what: str) -> None:
        """Pass it on; what follows all runs is of the last one."""
        self._progress.phase(named(label or self._last, self._name), what)

    def note(self, line: str) -> None:
        self._progress.note(line)

    def advanced(self, label: str, simulated: float) -> None:
        self._progress.advanced(named(label, self._name), simulated)


def named(label: str, name: str) -> str:
    """Return a run's label with what it has in common with others."""
    return f"{label} ({name})"


@dataclass
class RunReport:
    """How a run went, apart from its numbers."""

    label: str  # the controller's label
    wall_time: float  # [s] from the first state to the last answer
    states: int  # states of the run
    processes: int  # processes that took part
    warnings: list[str] = field(default_factory=list)
    timing: RunTiming | None = None  # what the nodes measured; None without nodes

    def as_mapping(self) -> dict[str, object]:
        timing = self.timing.as_mapping() if self.timing else None
        return {**vars(self), "rate": self.rate, "timing": timing}

    @property
    def rate(self) -> float:
        """States per second of wall time [Hz]."""
        return self.states / self.wall_time if self.wall_time > 0.0 else 0.0

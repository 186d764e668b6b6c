"""What a run tells while it goes on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from hpid_ros.experiment.run_timing import RunTiming


class Progress(Protocol):
    """Is told how far a run is."""

    def phase(self, label: str, what: str) -> None:
        """A run enters a phase.

        Args:
            label: The controller's label.
            what: The phase in a few words.
        """

    def advanced(self, label: str, simulated: float) -> None:
        """A run has come this far.

        Args:
            label: The controller's label.
            simulated: Simulated time in [s].
        """


class Silence:
    """Progress that nobody looks at."""

    def phase(self, label: str, what: str) -> None:
        """Say nothing."""

    def advanced(self, label: str, simulated: float) -> None:
        """Say nothing."""


@dataclass
class RunReport:
    """How a run went, apart from its numbers.

    Attributes:
        label: The controller's label.
        wall_time: From the first state to the last answer in [s].
        states: States of the run.
        processes: Processes that took part.
        warnings: What went otherwise than planned, one line each.
        timing: What the nodes measured; None without nodes.
    """

    label: str
    wall_time: float
    states: int
    processes: int
    warnings: list[str] = field(default_factory=list)
    timing: RunTiming | None = None

    def as_mapping(self) -> dict[str, object]:
        """Return everything, ready for JSON."""
        timing = self.timing.as_mapping() if self.timing else None
        return {**vars(self), "rate": self.rate, "timing": timing}

    @property
    def rate(self) -> float:
        """States per second of wall time [Hz]."""
        return self.states / self.wall_time if self.wall_time > 0.0 else 0.0

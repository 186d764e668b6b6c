"""A short trial in lock-step, which tells what rate a machine holds before a run in real time."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.graph.options import GraphOptions
from hpid_ros.experiment.graph.run import run_on_graph
from hpid_ros.experiment.progress import NoProgress

LONGEST = 1.0  # [s] of simulated time
_MILLISECONDS = 1e-3  # in a microsecond


@dataclass(frozen=True)
class Trial:
    """What a graph did as fast as it could, beside what is asked of it."""

    cycles: int  # states of the trial
    median: float  # [ms] time of one cycle, from a state to the next
    p99: float  # [ms] what 99 of 100 cycles do not exceed
    period: float  # [ms] the control period that is asked for, in wall time

    @property
    def holds(self) -> bool:
        """Whether 99 of 100 cycles are shorter than the period."""
        return self.p99 <= self.period

    @property
    def line(self) -> str:
        """The trial in one line."""
        found = (
            f"trial of {self.cycles} states: a cycle takes {self.median:.2f} ms, 99 of 100 at "
            f"most {self.p99:.2f} ms"
        )
        wanted = f"{self.period:.4g} ms ({1e3 / self.period:.4g} Hz)"
        if self.holds:
            return f"{found}: {wanted} can be held"
        how_often = "most" if self.median > self.period else "some"
        return (
            f"{found}: more than {wanted}, so that {how_often} states will be late or lost; a "
            f"lower control.rate, --composed, --engine mujoco or --no-record ask for less"
        )


def run_trial(experiment: Experiment, label: str, options: GraphOptions) -> Trial:
    """Run the beginning of an experiment in lock-step, in the same processes."""
    short = replace(experiment, duration=min(LONGEST, experiment.duration))
    with tempfile.TemporaryDirectory(prefix="hpid_trial_") as name:
        folder = Path(name)
        report = run_on_graph(
            short, label, folder / "bag", folder, NoProgress(), replace(options, is_realtime=False)
        )
    assert report.timing is not None
    cycle = report.timing.cycle
    return Trial(
        report.states,
        cycle.median * _MILLISECONDS,
        cycle.p99 * _MILLISECONDS,
        experiment.world.control_period_ns * 1e-6,
    )

"""From the bags of a comparison to its numbers, tables, figures and report."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hpid_ros.analysis import Comparison
from hpid_ros.analysis.doubts import unfollowed_lines, unfollowed_mapping
from hpid_ros.analysis.indices.base import BaseFigures
from hpid_ros.analysis.signals import GainSignals
from hpid_ros.bags.selection import BagSelection
from hpid_ros.base.foreign_text import shown
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.progress import RunReport
from hpid_ros.experiment.result.folder import versions
from hpid_ros.experiment.result.places import ResultPlaces
from hpid_ros.experiment.result.robot import TaskResult, base_results, task_result
from hpid_ros.metrics import Measuring, measure
from hpid_ros.recordings.series import RunSeries

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Result:
    """A comparison, computed."""

    experiment: Experiment  # what was compared
    runs: tuple[RunSeries, ...]  # the recorded runs, the baseline first
    comparison: Comparison  # their numbers
    base: Mapping[str, BaseFigures] = field(default_factory=dict)
    task: TaskResult = field(default_factory=TaskResult)

    def as_mapping(self) -> dict[str, object]:
        """Return everything that the experiment determines, and nothing that the clock does.

        Two runs of the same experiment with the same versions give the same mapping to the
        last bit, on the graph and in one process. A repeated command is no part of it: a bridge
        asks again when a machine was slow, and the answer to a repeat is the same.
        """
        experiment = self.experiment
        return {
            "experiment": experiment.name,
            "sha256": experiment.digest,
            "seed": experiment.seed,
            "duration": experiment.duration,
            "engine": experiment.world.engine,
            "control_period": experiment.world.control_period_ns * 1e-9,
            "versions": versions(),
            "indices": self.comparison.as_mapping(),
            "samples": {
                run.label: {
                    series.joint: {
                        "states": len(series.position),
                        "commands": len(series.effort),
                        "unanswered_states": run.losses[series.joint].unanswered_states,
                    }
                    for series in run.joints
                }
                for run in self.runs
            },
            **self._unfollowed(),
            **self._of_the_base(),
            **self.task.as_mapping(),
            "parameters": self.parameters(),
        }

    def _unfollowed(self) -> dict[str, object]:
        found = unfollowed_mapping(self.runs)
        return {"unfollowed": found} if found else {}

    def _of_the_base(self) -> dict[str, object]:
        if not self.base:
            return {}
        return {"base": {label: each.as_mapping() for label, each in self.base.items()}}

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines that belong below the table: what a reader must know of the runs."""
        slips = [each.line(label) for label, each in self.base.items() if each.has_slipped]
        return (*unfollowed_lines(self.runs), *self.task.notes, *slips)

    def parameters(self) -> dict[str, dict[str, dict[str, object]]]:
        """Return every parameter by run, joint and name."""
        return {
            label: {each.joint: dict(each.to_parameters()) for each in settings}
            for label, settings in self.experiment.controllers.items()
        }


def compute(experiment: Experiment, bags: Mapping[str, Path]) -> Result:
    """Read the bags and compute the indices."""
    how = Measuring(
        BagSelection(joints=experiment.world.joints), description=experiment.description
    )
    measured = [measure(bag, label, how) for label, bag in bags.items()]
    runs = tuple(each.series for each in measured if each.series is not None)
    for run in runs:
        for line in run.quality.lines if run.quality is not None else ():
            _log.warning("%s", shown(f"run {run.label!r}: {line}"))
    comparison = Comparison(tuple(each.run for each in measured))
    base = base_results(experiment, bags, runs)
    return Result(experiment, runs, comparison, base, task_result(experiment, bags, runs))


def save_numbers(
    result: Result, folder: ResultPlaces, reports: Sequence[RunReport], how: str
) -> None:
    """Write the numbers of a result: indices and table, and how long everything took."""
    from hpid_ros.report.tables.table import table_text

    folder.write("result.json", json.dumps(result.as_mapping(), indent=2) + "\n")
    notes = "".join(f"{note}\n" for note in result.notes)
    folder.write("table.txt", table_text(result.comparison) + notes)
    save_timing(folder, reports, how)


def save_timing(folder: ResultPlaces, reports: Sequence[RunReport], how: str) -> None:
    """Write how long the runs took, as for :func:`save_numbers`."""
    timing = {"ran": how, "runs": {each.label: each.as_mapping() for each in reports}}
    folder.write("timing.json", json.dumps(timing, indent=2) + "\n")


def save(
    result: Result,
    folder: ResultPlaces,
    reports: Sequence[RunReport],
    how: str,
    *,
    has_figures: bool = True,
) -> None:
    """Write the result: first the numbers, then what is drawn from them."""
    save_numbers(result, folder, reports, how)

    # Drawing is slow to import, and numbers that are saved survive a failure to draw them.
    from hpid_ros.report.html.page import render_report
    from hpid_ros.report.tables.export import table_csv, table_latex

    folder.write("table.csv", table_csv(result.comparison))
    folder.write("table.tex", table_latex(result.comparison))
    gains = _gain_signals(result)
    paths = result.task.paths
    if has_figures:
        from hpid_ros.report.figures.plots import save_figures

        save_figures(
            result.runs, folder.figures, comparison=result.comparison, gains=gains, paths=paths
        )
    provenance = {
        "experiment": result.experiment.name,
        "ran": how,
        "engine": result.experiment.world.engine,
        "command": f"hpid compare {result.experiment.path.name}",
        "seed": result.experiment.seed,
        "SHA-256 of experiment and robot": result.experiment.digest,
        "versions": versions(),
    }
    folder.write(
        "report.html",
        render_report(
            result.comparison,
            result.runs,
            provenance,
            result.parameters(),
            gains=gains,
            paths=paths,
        ),
    )


def _gain_signals(result: Result) -> dict[str, dict[str, GainSignals]]:
    """Return norm and gain multiplier over time, by run and joint."""
    from hpid_ros.metrics.gain_signals import gain_signals

    found = {}
    for run in result.runs:
        settings = {each.joint: each for each in result.experiment.controllers[run.label]}
        signals = gain_signals(run, settings)
        if signals is not None:
            found[run.label] = signals
    return found

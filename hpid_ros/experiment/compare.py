"""Running an experiment: all of its controllers compared, or one of them alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hpid_ros.base.errors import ExperimentError, unknown_name
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.graph_run import GraphOptions, run_on_graph, run_trial
from hpid_ros.experiment.in_process import run_without_ros, write_run_files
from hpid_ros.experiment.progress import NamedProgress, Progress, RunReport
from hpid_ros.experiment.result import Result, compute, save, save_numbers, save_timing
from hpid_ros.experiment.result_folder import EXPERIMENT, ResultFolder
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.folding import BySeed, EngineTotal, engine_mapping
from hpid_ros.metrics.quantities import PAPER, Quantity
from hpid_ros.report.export import engine_grids, engines_csv
from hpid_ros.report.table import Grid, grids_text, slides_note
from hpid_ros.stability.gain_check import certificates


@dataclass(frozen=True)
class SingleRun:
    report: RunReport  # how it went
    result: Result | None  # the numbers; None when nothing was recorded
    folder: ResultFolder  # where everything lies


def run_controller(
    experiment: Experiment,
    label: str,
    output: Path,
    progress: Progress,
    options: GraphOptions,
    *,
    force: bool = False,
    is_tried: bool = False,
) -> SingleRun:
    if label not in experiment.controllers:
        raise ExperimentError(unknown_name("controller", label, experiment.controllers))
    with ResultFolder.create(output, force=force, inputs=experiment.inputs) as folder:
        _tell_engine(experiment, progress)
        if options.is_realtime and is_tried:
            progress.phase(label, "trying what the machine can hold")
            progress.note(run_trial(experiment, label, options).line)
        folder.write(EXPERIMENT, experiment.text)
        bag, nodes = folder.bag(label), folder.nodes(label)
        report = run_on_graph(experiment, label, bag, nodes, progress, options)
        progress.advanced(label, experiment.duration)
        how = f"ROS 2 graph, {report.processes} processes"
        if not options.is_recorded:
            save_timing(folder, [report], how)
            return SingleRun(report, None, folder)
        result = compute(experiment, {label: bag})
        save_numbers(result, folder, [report], how)
        return SingleRun(report, result, folder)


def _tell_engine(experiment: Experiment, progress: Progress) -> None:
    if experiment.engine_note:
        progress.note(experiment.engine_note)


@dataclass(frozen=True)
class Compared:
    result: Result  # the numbers
    reports: tuple[RunReport, ...]  # how each run went
    folder: ResultFolder  # where everything lies


def compare(
    experiment: Experiment,
    output: Path,
    progress: Progress,
    *,
    in_process: bool = False,
    force: bool = False,
    has_figures: bool = True,
) -> Compared:
    """Run an experiment's controllers one after the other, record, compute, draw, certify.

    Args:
        experiment: The experiment.
        output: Folder of the result.
        progress: Is told how far it is.
        in_process: Run without ROS; the numbers are the same.
        force: Replace a result that is there already.
        has_figures: Draw the figures as well, which take the longest.

    Raises:
        HpidError: The folder is in the way, a run failed, or a bag cannot be read.
    """
    with ResultFolder.create(output, force=force, inputs=experiment.inputs) as folder:
        _tell_engine(experiment, progress)
        result, reports = _compare(experiment, folder, progress, in_process, has_figures)
    return Compared(result, tuple(reports), folder)


@dataclass(frozen=True)
class ComparedEngines:
    compared: Mapping[str, Compared]  # the comparison in each engine, by its name
    totals: tuple[EngineTotal, ...]  # each total of each controller in all engines
    folder: ResultFolder  # where everything lies

    @property
    def grids(self) -> list[Grid]:
        """How far the engines lie apart, as tables."""
        comparison = next(iter(self.compared.values())).result.comparison
        slides = slides_note(comparison.joint_names, comparison.slides)
        note = f"Totals over all driven joints, one seed. {slides}"
        return engine_grids(self.totals, note.strip())


def compare_engines(
    experiments: Sequence[Experiment],
    output: Path,
    progress: Progress,
    *,
    in_process: bool = False,
    has_figures: bool = True,
    force: bool = False,
) -> ComparedEngines:
    """Make the same comparison in two engines, and say how far they lie apart."""
    with ResultFolder.create(output, force=force, inputs=experiments[0].inputs) as folder:
        compared = {}
        for experiment in experiments:
            engine = experiment.world.engine
            part = folder.part(engine)
            told = NamedProgress(progress, engine, list(experiment.controllers))
            result, reports = _compare(experiment, part, told, in_process, has_figures)
            compared[engine] = Compared(result, tuple(reports), part)
        totals = _engine_totals({engine: each.result for engine, each in compared.items()})
        both = ComparedEngines(compared, totals, folder)
        folder.write("engines.txt", grids_text(both.grids))
        folder.write("engines.csv", engines_csv(totals))
        folder.write("engines.json", json.dumps(engine_mapping(totals), indent=2) + "\n")
    return both


def _engine_totals(results: Mapping[str, Result]) -> tuple[EngineTotal, ...]:
    first = next(iter(results.values()))
    name, seed = first.experiment.name, first.experiment.seed

    def in_each(number: Callable[[Comparison], float]) -> dict[str, BySeed]:
        return {engine: {seed: number(each.comparison)} for engine, each in results.items()}

    def total(label: str, quantity: Quantity) -> EngineTotal:
        values = in_each(lambda comparison: comparison.run(label).value(quantity))
        ratios = in_each(lambda comparison: comparison.ratio(label, quantity))
        is_baseline = label == first.comparison.baseline.label
        unit = first.comparison.unit(quantity)
        return EngineTotal(name, label, quantity, values, {} if is_baseline else ratios, unit)

    return tuple(total(run.label, each) for run in first.comparison.runs for each in PAPER)


def _compare(
    experiment: Experiment,
    folder: ResultFolder,
    progress: Progress,
    in_process: bool,
    has_figures: bool,
) -> tuple[Result, list[RunReport]]:
    folder.write(EXPERIMENT, experiment.text)
    reports = []
    for label in experiment.controllers:
        bag, nodes = folder.bag(label), folder.nodes(label)
        if in_process:
            # For who then starts the same controllers on a graph.
            write_run_files(nodes, experiment, experiment.controllers[label])
            reports.append(run_without_ros(experiment, label, bag, progress))
        else:
            reports.append(run_on_graph(experiment, label, bag, nodes, progress))
        progress.advanced(label, experiment.duration)
    progress.phase("", "computing and drawing")
    bags = {label: folder.bag(label) for label in experiment.controllers}
    result = compute(experiment, bags)
    how = "in one process" if in_process else "ROS 2 graph"
    save(result, folder, reports, how, has_figures=has_figures)
    progress.phase("", "certifying the degrees")
    folder.write("certificates.json", json.dumps(certificates(experiment.controllers)) + "\n")
    return result, reports

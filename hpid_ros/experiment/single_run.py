"""Runs one controller of an experiment on the graph and leaves its bag, numbers and timing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hpid_ros.errors import ExperimentError, unknown_name
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.graph_options import GraphOptions
from hpid_ros.experiment.graph_run import run_on_graph
from hpid_ros.experiment.progress import Progress, RunReport
from hpid_ros.experiment.result import Result, compute, save_numbers, save_timing
from hpid_ros.experiment.result_folder import EXPERIMENT, ResultFolder


@dataclass(frozen=True)
class SingleRun:
    """What one run gives back.

    Attributes:
        report: How it went.
        result: The numbers; None when nothing was recorded.
        folder: Where everything lies.
    """

    report: RunReport
    result: Result | None
    folder: ResultFolder


def run_controller(
    experiment: Experiment,
    label: str,
    output: Path,
    progress: Progress,
    options: GraphOptions,
    *,
    force: bool = False,
) -> SingleRun:
    """Run one controller.

    Args:
        experiment: The experiment.
        label: Which of its controllers.
        output: Folder of the result.
        progress: Is told how far it is.
        options: How the run is spread over processes, paced and recorded.
        force: Replace a result that is there already.

    Raises:
        HpidError: There is no such controller, the folder is in the way, or the run failed.
    """
    if label not in experiment.controllers:
        raise ExperimentError(unknown_name("controller", label, experiment.controllers))
    with ResultFolder.create(output, force=force, inputs=experiment.inputs) as folder:
        return _run(experiment, label, folder, progress, options)


def _run(
    experiment: Experiment,
    label: str,
    folder: ResultFolder,
    progress: Progress,
    options: GraphOptions,
) -> SingleRun:
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

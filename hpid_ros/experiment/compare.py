"""Runs every controller of an experiment and leaves the result."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.graph_run import run_on_graph
from hpid_ros.experiment.in_process_run import run_without_ros
from hpid_ros.experiment.progress import Progress, RunReport
from hpid_ros.experiment.result import Result, compute, save
from hpid_ros.experiment.result_folder import EXPERIMENT, ResultFolder
from hpid_ros.tuning.saved_certificates import certificates


@dataclass(frozen=True)
class Compared:
    """What a comparison gives back.

    Attributes:
        result: The numbers.
        reports: How each run went.
        folder: Where everything lies.
    """

    result: Result
    reports: tuple[RunReport, ...]
    folder: ResultFolder


def compare(
    experiment: Experiment,
    output: Path,
    progress: Progress,
    *,
    in_process: bool = False,
    force: bool = False,
) -> Compared:
    """Run an experiment's controllers one after the other, record, compute, draw, certify.

    Args:
        experiment: The experiment.
        output: Folder of the result.
        progress: Is told how far it is.
        in_process: Run without ROS; the numbers are the same.
        force: Replace a result that is there already.

    Raises:
        HpidError: The folder is in the way, a run failed, or a bag cannot be read.
    """
    with ResultFolder.create(output, force=force, inputs=experiment.inputs) as folder:
        result, reports = _compare(experiment, folder, progress, in_process)
    return Compared(result, tuple(reports), folder)


def _compare(
    experiment: Experiment, folder: ResultFolder, progress: Progress, in_process: bool
) -> tuple[Result, list[RunReport]]:
    folder.write(EXPERIMENT, experiment.text)
    reports = []
    for label in experiment.controllers:
        bag = folder.bag(label)
        if in_process:
            reports.append(run_without_ros(experiment, label, bag, progress))
        else:
            nodes = folder.nodes(label)
            reports.append(run_on_graph(experiment, label, bag, nodes, progress))
        progress.advanced(label, experiment.duration)
    progress.phase("", "computing and drawing")
    bags = {label: folder.bag(label) for label in experiment.controllers}
    result = compute(experiment, bags)
    save(result, folder, reports, "in one process" if in_process else "ROS 2 graph")
    progress.phase("", "certifying the degrees")
    folder.write("certificates.json", json.dumps(certificates(experiment.controllers)) + "\n")
    return result, reports

"""The loops that a file holds, whether it is a parameter file or an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hpid_ros.base.errors import SettingError

if TYPE_CHECKING:
    from hpid_ros.control import LoopSettings
    from hpid_ros.experiment.description import Experiment
    from hpid_ros.tuning.controller_files import ParameterFile


class LoopFile(NamedTuple):
    """A file of loops; one of the two is there.

    Attributes:
        experiment: What an experiment file says.
        parameters: What a parameter file says.
    """

    experiment: Experiment | None
    parameters: ParameterFile | None


def loop_file(path: Path) -> LoopFile:
    """Read a file of loops.

    Args:
        path: An experiment, which has the key ``compare``, or a parameter file.

    Raises:
        SettingError: It is no parameter file, or one that cannot be used.
        ExperimentError: It is an experiment that cannot be used.
    """
    from hpid_ros.documents.yaml_files import load_document
    from hpid_ros.experiment.description import load_experiment
    from hpid_ros.tuning.controller_files import parameters_from

    document = load_document(path, SettingError).values
    if isinstance(document, Mapping) and "compare" in document:
        return LoopFile(load_experiment(path), None)
    return LoopFile(None, parameters_from(document, str(path)))


def first_homogeneous(experiment: Experiment) -> tuple[LoopSettings, ...]:
    """Return the loops of the first homogeneous controller, or else of the first.

    Args:
        experiment: An experiment.
    """
    controllers = list(experiment.controllers.values())
    homogeneous = [each for each in controllers if any(loop.law == "hpid" for loop in each)]
    return (homogeneous or controllers)[0]

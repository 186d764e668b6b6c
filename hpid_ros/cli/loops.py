"""The loops that a file holds, whether it is a parameter file or an experiment."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hpid_ros.base.errors import SettingError

if TYPE_CHECKING:
    from hpid_ros.control import LoopSettings
    from hpid_ros.experiment.description import Experiment
    from hpid_ros.stability.degrees import Loop
    from hpid_ros.tuning.controller_files import ParameterFile


class LoopFile(NamedTuple):
    """A file of loops; one of the two is there."""

    experiment: Experiment | None  # what an experiment file says
    parameters: ParameterFile | None  # what a parameter file says


def loop_file(path: Path) -> LoopFile:
    """Read a file of loops."""
    from hpid_ros.documents.yaml_files import load_document
    from hpid_ros.experiment.description import load_experiment
    from hpid_ros.tuning.controller_files import parameters_from

    document = load_document(path, SettingError).values
    if isinstance(document, Mapping) and "compare" in document:
        return LoopFile(load_experiment(path), None)
    return LoopFile(None, parameters_from(document, str(path)))


def first_homogeneous(experiment: Experiment) -> tuple[LoopSettings, ...]:
    """Return the loops of the first homogeneous controller, or else of the first."""
    controllers = list(experiment.controllers.values())
    homogeneous = [each for each in controllers if any(loop.law == "hpid" for loop in each)]
    return (homogeneous or controllers)[0]


def named_loops(file: LoopFile) -> ParameterFile:
    """Return every loop of a file by the name to show it under, and the inertias that it holds."""
    from hpid_ros.tuning.controller_files import ParameterFile

    if file.parameters is not None:
        return file.parameters
    assert file.experiment is not None
    loops = {
        f"{label} {each.joint}": each
        for label, settings in file.experiment.controllers.items()
        for each in settings
    }
    return ParameterFile(loops, {})


def shown_name(name: str) -> str:
    """Return a loop's name as tables have it."""
    return name.strip("/").removesuffix("_controller")


def judged_loops(options: argparse.Namespace, file: ParameterFile) -> list[Loop]:
    """Return loops with the inertias to judge them on."""
    from hpid_ros.cli.robot_options import inertias_from
    from hpid_ros.stability.gain_check import inertia_of

    loops = file.loops.values()
    known = {**file.inertias, **inertias_from(options, [each.joint for each in loops])}
    return [(each, inertia_of(each, known.get(each.joint))) for each in loops]


def sliding_joints(options: argparse.Namespace, experiment: Experiment | None) -> frozenset[str]:
    """Return the joints that slide: by ``--urdf``, the experiment's robot, or ``--bag``."""
    from hpid_ros.cli.robot_options import load_robot

    if options.urdf:
        return load_robot(options.urdf).description.slides
    if experiment is not None:
        return experiment.slides
    bag = getattr(options, "bag", None)
    if bag is None:
        return frozenset()
    from hpid_ros.metrics.slides import sliding_joints as slides_of_bag

    return slides_of_bag(bag, None).slides

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


def named_loops(file: LoopFile) -> ParameterFile:
    """Return every loop of a file by the name to show it under, and the inertias that it holds.

    Args:
        file: The file; of an experiment a loop's name is ``LABEL JOINT``.
    """
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
    """Return a loop's name as tables have it.

    Args:
        name: Of a node, or ``LABEL JOINT``.
    """
    return name.strip("/").removesuffix("_controller")


def judged_loops(options: argparse.Namespace, file: ParameterFile) -> list[Loop]:
    """Return loops with the inertias to judge them on.

    Args:
        options: Parsed; what they say of inertias is laid over what the file says.
        file: The loops.

    Raises:
        SettingError: The inertia of a loop is unknown, or impossible.
    """
    from hpid_ros.cli.robot_options import inertias_from
    from hpid_ros.stability.gain_check import inertia_of

    loops = file.loops.values()
    known = {**file.inertias, **inertias_from(options, [each.joint for each in loops])}
    return [(each, inertia_of(each, known.get(each.joint))) for each in loops]


def sliding_joints(options: argparse.Namespace, experiment: Experiment | None) -> frozenset[str]:
    """Return the joints that slide: as ``--urdf`` says, or the experiment's robot, or ``--bag``.

    Args:
        options: With what :func:`.add_robot_options` adds, and a bag where the command takes one.
        experiment: The file's, if it is one.

    Raises:
        RobotDescriptionError: The robot cannot be read.
        BagError: The bag cannot.
    """
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

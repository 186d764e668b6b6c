"""The end effector in ``hpid metrics``: which robot a bag is of, and what is told of its hand."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import SettingError

if TYPE_CHECKING:
    from hpid_ros.analysis.indices.task import EndEffectorFigures, EndEffectorPath
    from hpid_ros.experiment.result.end_effector import TaskFrame
    from hpid_ros.recordings.series import RunSeries

_PATH_POINTS = 4000


def add_robot_options(group: Any) -> None:
    """Add the options to a group of the command's parser."""
    group.add_argument(
        "--robot",
        metavar="URDF",
        help="also tell how far its end effector was from the reference, by forward kinematics; "
        "an experiment file (.yaml) names wheels and initial positions, too",
    )
    group.add_argument(
        "--end-effector", metavar="LINK", help="link whose pose counts, with --robot (the last)"
    )
    group.add_argument(
        "--wheels",
        nargs=2,
        metavar=("LEFT", "RIGHT"),
        help="joints of the wheels of a base, with --robot: its odometry is added",
    )


def task_frame(options: argparse.Namespace) -> TaskFrame | None:
    """Return the robot that the options name; None without one.

    Raises:
        SettingError: There are options of a robot, but no robot.
        HpidError: The robot cannot be used.
    """
    if options.robot is None:
        if options.end_effector is not None or options.wheels is not None:
            raise SettingError("--end-effector and --wheels need --robot URDF")
        return None
    from hpid_ros.base.resources import find_resource
    from hpid_ros.experiment.description import load_experiment
    from hpid_ros.experiment.result.end_effector import TaskFrame
    from hpid_ros.robot.description import RobotDescription
    from hpid_ros.robot.differential_drive import DifferentialDrive

    file = find_resource(options.robot)
    if file.suffix in (".yaml", ".yml"):
        experiment = load_experiment(file)
        world = experiment.world
        description = RobotDescription.load(world.robot_description)
        base, others, link = world.base, world.initial_positions, experiment.end_effector
    else:
        description = RobotDescription.load(file)
        base, others, link = None, {}, description.last_link
    if options.wheels is not None:
        base = DifferentialDrive.of(description, *options.wheels)
    return TaskFrame(description, description.link(options.end_effector or link), base, others)


def end_effector_of(
    frame: TaskFrame, run: RunSeries
) -> tuple[EndEffectorFigures, EndEffectorPath]:
    """Return the end effector's figures and its path.

    Raises:
        HpidError: The recording lacks the joints that move it.
    """
    from hpid_ros.experiment.result.end_effector import EndEffector

    end_effector = EndEffector(frame, run)
    return end_effector.figures(), end_effector.path(_PATH_POINTS)


def with_end_effectors(text: str, form: str, figures: Mapping[str, EndEffectorFigures]) -> str:
    """Return a printed comparison together with the end effectors of its runs.

    As lines below a table, as ``end_effector`` in JSON; CSV and LaTeX are tables of joints and
    stay as they are.

    Args:
        text: The comparison as printed.
        form: ``table``, ``csv``, ``json`` or ``latex``.
        figures: By label of the run.
    """
    if not figures:
        return text
    if form == "json":
        document = json.loads(text)
        document["end_effector"] = {label: each.as_mapping() for label, each in figures.items()}
        return json.dumps(document, indent=2) + "\n"
    return text + "".join(end_effector_lines(figures)) if form == "table" else text


def end_effector_lines(figures: Mapping[str, EndEffectorFigures]) -> list[str]:
    """Return one line a run, with its end."""
    return [f"{each.line(label)}\n" for label, each in figures.items()]

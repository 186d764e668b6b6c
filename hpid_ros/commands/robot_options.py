"""The options that say what a joint's motor has to accelerate, for every command that asks."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hpid_ros.errors import ExperimentError, HpidError, SettingError

if TYPE_CHECKING:
    from hpid_ros.robot.description import RobotDescription


@dataclass(frozen=True)
class Robot:
    """A robot that an option names.

    Attributes:
        source: Path of its URDF, or the XML text where more is known than the URDF says.
        description: What that says.
        fixed_base: Whether its root is held.
        initial_positions: Where its joints stand at first, in [rad]; others at 0.
    """

    source: str
    description: RobotDescription
    fixed_base: bool = False
    initial_positions: Mapping[str, float] = field(default_factory=dict)


def load_robot(name: str) -> Robot:
    """Return the robot of a URDF, or of an experiment file.

    Args:
        name: A file that :func:`~hpid_ros.resources.find_resource` finds; an experiment's name
            ends in ``.yaml`` or ``.yml``.

    Raises:
        HpidError: There is no such file, or it cannot be read.
    """
    from hpid_ros.resources import find_resource
    from hpid_ros.robot.description import RobotDescription

    file = find_resource(name)
    if file.suffix not in (".yaml", ".yml"):
        return Robot(str(file), RobotDescription.load(file))
    from hpid_ros.experiment.description import load_experiment

    world = load_experiment(file).world
    source = str(world.robot_description)
    description = RobotDescription.load(source)
    return Robot(source, description, world.fixed_base, world.initial_positions)


def add_robot_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--inertia``, ``--urdf``, ``--payload`` and ``--poses``."""
    parser.add_argument(
        "--inertia", nargs="+", type=float, metavar="M", help="of the joint, or least and largest"
    )
    parser.add_argument(
        "--urdf",
        metavar="FILE",
        help="compute inertias over the joints' ranges from this robot: a URDF, or an experiment "
        "file (.yaml) with what it knows better",
    )
    parser.add_argument(
        "--payload", type=float, default=0.0, metavar="KG", help="largest payload, with --urdf"
    )
    parser.add_argument("--poses", type=int, default=200, help="poses sampled, with --urdf")


def inertias_from(
    options: argparse.Namespace, joints: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """Return the least and the largest inertia that the options say, by joint.

    Args:
        options: Parsed options.
        joints: The joints asked for.

    Returns:
        In [kg m^2]; empty when the options say nothing.

    Raises:
        SettingError: They contradict each other, or the robot cannot be used.
    """
    if options.inertia:
        if options.urdf or len(options.inertia) > 2:
            raise SettingError(
                "--inertia takes one number, or the least and the largest, and not --urdf as well"
            )
        return dict.fromkeys(joints, (options.inertia[0], options.inertia[-1]))
    if not options.urdf:
        return {}
    from hpid_ros.tuning.inertias import inertia_ranges

    try:
        description = load_robot(options.urdf).description
        return inertia_ranges(description, joints, options.payload, options.poses)
    except ExperimentError:  # names the file itself
        raise
    except HpidError as error:
        raise SettingError(f"{options.urdf}: {error}") from None

"""The options that say what a joint's motor has to accelerate, for every command that asks."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hpid_ros.errors import ExperimentError, HpidError, SettingError, unknown_name

if TYPE_CHECKING:
    from hpid_ros.robot.description import RobotDescription

_POSES = 200


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
        "--inertia",
        action="append",
        nargs="+",
        default=[],
        metavar="M",
        help="of every joint: M, or LOW HIGH; of one: JOINT=M or JOINT=LOW:HIGH, also where "
        "--urdf says that of the others",
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
    parser.add_argument(
        "--poses",
        type=int,
        metavar="N",
        help=f"sampled over the joints' ranges, with --urdf ({_POSES})",
    )


Range = tuple[float, float]


def inertias_from(
    options: argparse.Namespace,
    joints: Sequence[str],
    poses: Sequence[Mapping[str, float]] = (),
) -> dict[str, Range]:
    """Return the least and the largest inertia that the options say, by joint.

    Args:
        options: Parsed options.
        joints: The joints asked for.
        poses: Where the robot is known to go, in [rad]: the inertias are those of these poses,
            unless the options want some sampled.

    Returns:
        In [kg m^2]; empty when the options say nothing.

    Raises:
        SettingError: They contradict each other, or the robot cannot be used.
    """
    of_all, of_one = _given(options.inertia)
    unknown = [joint for joint in of_one if joint not in joints]
    if unknown:
        raise SettingError(unknown_name("joint in --inertia", unknown[0], joints))
    if of_all and options.urdf:
        raise SettingError(
            "--inertia takes JOINT=M or JOINT=LOW:HIGH beside --urdf, which says that of "
            "the others"
        )
    if of_all:
        found = dict.fromkeys(joints, of_all)
    elif options.urdf:
        asked = [joint for joint in joints if joint not in of_one]
        found = _of_robot(options, asked, poses) if asked else {}
    else:
        found = {}
    found |= of_one
    for joint, (low, high) in found.items():
        if not 0.0 < low <= high < math.inf:
            raise SettingError(
                f"the inertia of {joint!r} must be positive and finite, its least value not above "
                f"its largest, not {low:g} to {high:g} kg m^2"
            )
    return found


def _given(inertias: Sequence[Sequence[str]]) -> tuple[Range | None, dict[str, Range]]:
    """Return what ``--inertia`` says of all joints, and of single ones."""
    numbers: list[float] = []
    of_one: dict[str, Range] = {}
    for text in (each for texts in inertias for each in texts):
        joint, is_named, value = text.rpartition("=")
        try:
            found = [float(each) for each in (value.split(":") if is_named else [value])]
        except ValueError:
            found = []
        if len(found) not in (1, 2) or (is_named and not joint):
            raise SettingError(
                f"--inertia takes M, LOW HIGH, JOINT=M or JOINT=LOW:HIGH, not {text!r}"
            )
        if is_named:
            of_one[joint] = (found[0], found[-1])
        else:
            numbers += found
    if len(numbers) > 2:
        raise SettingError(
            f"--inertia takes one number, or the least and the largest, not {len(numbers)}"
        )
    return ((numbers[0], numbers[-1]) if numbers else None), of_one


def _of_robot(
    options: argparse.Namespace, joints: Sequence[str], poses: Sequence[Mapping[str, float]]
) -> dict[str, Range]:
    from hpid_ros.tuning.inertias import inertia_ranges

    wanted = _POSES if options.poses is None else options.poses
    try:
        robot = load_robot(options.urdf)
        if poses and options.poses is None:
            known = [{**robot.initial_positions, **pose} for pose in poses]
            return inertia_ranges(robot.description, joints, options.payload, known)
        return inertia_ranges(robot.description, joints, options.payload, wanted)
    except ExperimentError:  # names the file itself
        raise
    except HpidError as error:
        raise SettingError(f"{options.urdf}: {error}") from None

"""The options that say what a joint's motor has to accelerate, for every command that asks."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from hpid_ros.errors import HpidError, SettingError


def add_robot_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--inertia``, ``--urdf``, ``--payload`` and ``--poses``."""
    parser.add_argument(
        "--inertia", nargs="+", type=float, metavar="M", help="of the joint, or least and largest"
    )
    parser.add_argument("--urdf", help="compute inertias over the joints' ranges from this robot")
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
    from hpid_ros.resources import find_resource
    from hpid_ros.robot.description import RobotDescription
    from hpid_ros.tuning.inertias import inertia_ranges

    try:
        description = RobotDescription.load(find_resource(options.urdf))
        return inertia_ranges(description, joints, options.payload, options.poses)
    except HpidError as error:
        raise SettingError(f"{options.urdf}: {error}") from None

"""What needs Pinocchio, imported when it is called.

The import takes a tenth of a second and tens of megabytes; controllers without a model of the
robot, and references without a brick task, need none of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from hpid_ros.control.settings import LoopSettings

if TYPE_CHECKING:
    from hpid_ros.robot.compensation import LoopModel
    from hpid_ros.robot.description import RobotDescription
    from hpid_ros.robot.kinematics import Kinematics


def with_inertia(settings: LoopSettings, robot: str) -> LoopSettings:
    """Return settings with the inertia of their model, where they leave it to the model."""
    if not settings.model.is_on:
        return settings
    from hpid_ros.robot import coupling

    return coupling.with_inertia(settings, robot)


def loop_model(settings: LoopSettings, robot: str) -> LoopModel | None:
    """Return the model that settings ask for; None where they ask for none."""
    if not settings.model.is_on:
        return None
    from hpid_ros.robot import compensation

    return compensation.loop_model(settings, robot)


def kinematics(
    description: RobotDescription,
    link: str,
    joints: Sequence[str] | None,
    others: Mapping[str, float],
) -> Kinematics:
    """Return the kinematics of a link, moved by these joints or by all that can."""
    from hpid_ros.robot.kinematics import Kinematics

    return Kinematics(description, link, joints, others)

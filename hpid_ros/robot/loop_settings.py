"""From a controller's parameters and its robot to the settings that its loop runs with."""

from __future__ import annotations

from collections.abc import Mapping

from hpid_ros.control.settings import LoopSettings
from hpid_ros.robot.joint_description import JointDescription
from hpid_ros.robot.on_demand import with_inertia


def loop_settings(
    parameters: Mapping[str, object], limits: JointDescription, robot: str
) -> LoopSettings:
    """Return what a controller makes of its parameters, which it checks as a whole."""
    return on_robot(LoopSettings.from_parameters(parameters), limits, robot)


def on_robot(settings: LoopSettings, limits: JointDescription, robot: str) -> LoopSettings:
    """Return settings within a joint's limits, with what they leave to the robot filled in.

    ``robot`` is its description as the parameter ``robot_description`` has it: XML text, a path,
    or nothing.
    """
    return with_inertia(limits.within(settings), robot)

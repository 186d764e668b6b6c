"""What a controller takes from a model of its robot."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from rclpy.node import Node

from hpid_ros.control import LoopSettings
from hpid_ros.nodes.parameters import read_only
from hpid_ros.resources import find_resource
from hpid_ros.robot.description import RobotDescription


@dataclass(frozen=True)
class RobotLimits:
    """What the robot's description allows a joint; it holds beside the parameters.

    Attributes:
        effort: Largest absolute effort in [N m].
        lower: Lowest position in [rad].
        upper: Highest position in [rad].
        velocity: Largest absolute velocity in [rad/s].
        is_continuous: Whether the joint turns without end.
    """

    effort: float = math.inf
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf
    is_continuous: bool = False

    def within(self, settings: LoopSettings) -> LoopSettings:
        """Return the settings within these limits.

        Raises:
            SettingError: The positions that the settings allow are none that the robot allows.
        """
        wraps = self.is_continuous and settings.encoder_wrap < 0.0
        return replace(
            settings,
            encoder_wrap=math.tau if wraps else settings.encoder_wrap,
            u_clamp_max=max(min(settings.u_clamp_max, self.effort), -self.effort),
            u_clamp_min=min(max(settings.u_clamp_min, -self.effort), self.effort),
            position_max=min(settings.position_max, self.upper),
            position_min=max(settings.position_min, self.lower),
            velocity_max=min(settings.velocity_max, self.velocity),
        )


def robot_source(node: Node) -> str:
    """Declare ``robot_description`` and return it: XML text or a path, empty for none.

    Args:
        node: The controller.
    """
    return str(
        read_only(
            node,
            "robot_description",
            "",
            "URDF of the robot, XML text or path: limits effort, position and velocity",
        )
    )


def robot_limits(node: Node, source: str) -> RobotLimits:
    """Return what a robot's description allows a joint.

    Args:
        node: The controller, with the parameter ``joint``.
        source: From :func:`robot_source`.

    Returns:
        None of them where no robot is given. A velocity of 0 is none either, as many URDFs
        write it.

    Raises:
        HpidError: The robot cannot be found or read, or lacks the joint.
    """
    joint = node.get_parameter("joint").value
    if not source or not joint:  # a missing joint is refused with the other settings
        return RobotLimits()
    if not source.lstrip().startswith("<"):
        source = str(find_resource(source))
    (found,) = RobotDescription.load(source).select([joint])
    velocity = found.velocity if found.velocity > 0.0 else math.inf
    is_continuous = found.type == "continuous"
    return RobotLimits(found.effort, found.lower, found.upper, velocity, is_continuous)

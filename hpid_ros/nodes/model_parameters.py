"""What a controller takes from a model of its robot."""

from __future__ import annotations

import math

from rclpy.node import Node

from hpid_ros.errors import SettingError
from hpid_ros.nodes.parameters import read_only
from hpid_ros.resources import find_resource
from hpid_ros.robot.description import RobotDescription


def effort_limit(node: Node) -> float:
    """Declare ``robot_description`` and return the joint's effort limit in [N m].

    Args:
        node: The controller, with the parameter ``joint``.

    Returns:
        Infinite when no robot is given, or it gives no limit.

    Raises:
        HpidError: The robot cannot be found or read, or lacks the joint.
    """
    source = read_only(
        node, "robot_description", "", "URDF of the robot, XML text or path: limits the effort"
    )
    joint = node.get_parameter("joint").value
    if not source or not joint:  # a missing joint is refused with the other settings
        return math.inf
    if not source.lstrip().startswith("<"):
        source = str(find_resource(source))
    (description,) = RobotDescription.load(source).select([joint])
    return description.effort


def require_no_compensation(node: Node) -> None:
    """Declare ``compensation``, the model-based term that is added to the effort.

    Args:
        node: The controller.

    Raises:
        SettingError: A compensation is asked for that there is not.
    """
    wanted = read_only(node, "compensation", "none", "Model-based term added to the effort: none")
    if wanted != "none":
        raise SettingError(f"compensation must be none, there is no other so far, not {wanted!r}")

"""A controller's settings: declared, merged with changes, checked as a whole."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import HpidError
from hpid_ros.base.resources import find_resource
from hpid_ros.base.units import of_slide
from hpid_ros.control import LOOP_PARAMETERS, LoopSettings
from hpid_ros.control.settings.table import MODEL_PARAMETERS, PARAMETERS, Value
from hpid_ros.nodes.ros.parameters import declare, read_only
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
        is_slide: Whether it slides: "rad" reads "m" then, and "N m" reads "N".
    """

    effort: float = math.inf
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf
    is_continuous: bool = False
    is_slide: bool = False

    def within(self, settings: LoopSettings) -> LoopSettings:
        """Return the settings within these limits.

        Raises:
            SettingError: The positions that the settings allow are none that the robot allows.
        """
        effort, motion, encoder = settings.effort, settings.motion, settings.encoder
        wraps = self.is_continuous and encoder.wrap < 0.0
        return replace(
            settings,
            effort=replace(
                effort,
                u_clamp_max=max(min(effort.u_clamp_max, self.effort), -self.effort),
                u_clamp_min=min(max(effort.u_clamp_min, -self.effort), self.effort),
            ),
            motion=replace(
                motion,
                position_max=min(motion.position_max, self.upper),
                position_min=max(motion.position_min, self.lower),
                velocity_max=min(motion.velocity_max, self.velocity),
            ),
            encoder=replace(encoder, wrap=math.tau if wraps else encoder.wrap),
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
    return RobotLimits(
        found.effort,
        found.lower,
        found.upper,
        velocity,
        is_continuous=found.type == "continuous",
        is_slide=found.type == "prismatic",
    )


class ControllerSettings:
    """Makes of a controller's parameters the settings of its loop, within the robot's limits.

    Attributes:
        robot: The parameter ``robot_description``: XML text or a path, empty for none.
        is_slide: Whether it has the joint as prismatic.

    Args:
        node: The controller; it gets the parameters of its loop, of its model and of its robot.

    Raises:
        HpidError: The robot cannot be found or read, or lacks the joint.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        declare(node, [PARAMETERS["joint"]], read_only=["joint"])
        self.robot = robot_source(node)
        self._limits = robot_limits(node, self.robot)
        self.is_slide = self._limits.is_slide
        specs = [spec for name, spec in PARAMETERS.items() if name != "joint"]
        if self.is_slide:
            specs = [replace(spec, description=of_slide(spec.description)) for spec in specs]
        declare(node, specs, read_only=MODEL_PARAMETERS)
        self._last: tuple[Mapping[str, Value], LoopSettings] | None = None

    def with_changes(self, changes: Sequence[Parameter] = ()) -> LoopSettings:
        """Return the settings that would be in force after a change.

        Args:
            changes: What is about to be set.

        Raises:
            HpidError: The parameters cannot be used as a whole.
        """
        values = {name: self._node.get_parameter(name).value for name in PARAMETERS}
        values |= {each.name: each.value for each in changes if each.name in LOOP_PARAMETERS}
        if self._last is None or self._last[0] != values:  # checked first, put in force afterwards
            settings = self._limits.within(LoopSettings.from_parameters(values))
            if settings.model.is_on:
                # Pinocchio takes a moment to import; what needs it is fixed at the start.
                from hpid_ros.compensation.build import with_inertia

                settings = with_inertia(settings, self.robot)
            self._last = values, settings
        return self._last[1]

    def verdict(
        self, changes: Sequence[Parameter], require: Callable[[LoopSettings], None]
    ) -> SetParametersResult:
        """Say whether a change can be put in force.

        Args:
            changes: What is about to be set.
            require: Raises an :class:`.HpidError` for settings that are refused.
        """
        if concern_the_loop(changes):
            try:
                require(self.with_changes(changes))
            except HpidError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def concern_the_loop(changes: Sequence[Parameter]) -> bool:
    """Tell whether a change is about the loop at all."""
    return any(change.name in LOOP_PARAMETERS for change in changes)

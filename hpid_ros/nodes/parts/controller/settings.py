"""A controller's settings: declared, merged with changes, checked as a whole."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import HpidError
from hpid_ros.base.resources import find_resource
from hpid_ros.base.units import of_slide
from hpid_ros.control import LOOP_PARAMETERS, LoopSettings
from hpid_ros.control.settings.robot_limits import RobotLimits
from hpid_ros.control.settings.table import MODEL_PARAMETERS, PARAMETERS, Value
from hpid_ros.nodes.ros.parameters import declare, read_only
from hpid_ros.robot.description import RobotDescription


def robot_source(node: Node) -> str:
    """Declare ``robot_description`` and return it: XML text or a path, empty for none."""
    return str(
        read_only(
            node,
            "robot_description",
            "",
            "URDF of the robot, XML text or path: limits effort, position and velocity",
        )
    )


def robot_limits(node: Node, source: str) -> RobotLimits:
    """Return what a robot's description allows a joint."""
    joint = node.get_parameter("joint").value
    if not source or not joint:  # a missing joint is refused with the other settings
        return RobotLimits()
    if not source.lstrip().startswith("<"):
        source = str(find_resource(source))
    (found,) = RobotDescription.load(source).select([joint])
    return RobotLimits.of(found)


class ControllerSettings:
    """Makes of a controller's parameters the settings of its loop, within the robot's limits."""

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
        """Return the settings that would be in force after a change."""
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
        """Say whether a change can be put in force."""
        if concern_the_loop(changes):
            try:
                require(self.with_changes(changes))
            except HpidError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def concern_the_loop(changes: Sequence[Parameter]) -> bool:
    """Tell whether a change is about the loop at all."""
    return any(change.name in LOOP_PARAMETERS for change in changes)

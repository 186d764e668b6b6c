"""A controller's settings: declared, merged with changes, checked as a whole."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.control import LOOP_PARAMETERS, LoopSettings
from hpid_ros.control.parameters import Value
from hpid_ros.nodes.model_compensation import declare_model, model_values
from hpid_ros.nodes.model_parameters import robot_limits, robot_source
from hpid_ros.nodes.parameters import declare, merged, verdict
from hpid_ros.tuning.compensation import with_inertia


class ControllerSettings:
    """Makes of a controller's parameters the settings of its loop, within the robot's limits.

    Attributes:
        robot: The parameter ``robot_description``: XML text or a path, empty for none.

    Args:
        node: The controller; it gets the parameters of its loop, of its model and of its robot.

    Raises:
        HpidError: The robot cannot be found or read, or lacks the joint.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        declare(node, LOOP_PARAMETERS.values(), read_only=["joint"])
        declare_model(node)
        self.robot = robot_source(node)
        self._limits = robot_limits(node, self.robot)

    def with_changes(self, changes: Sequence[Parameter] = ()) -> LoopSettings:
        """Return the settings that would be in force after a change.

        Args:
            changes: What is about to be set.

        Raises:
            HpidError: The parameters cannot be used as a whole.
        """
        return self._checked(merged(self._node, LOOP_PARAMETERS, changes))

    def verdict(
        self, changes: Sequence[Parameter], require: Callable[[LoopSettings], None]
    ) -> SetParametersResult:
        """Say whether a change can be put in force.

        Args:
            changes: What is about to be set.
            require: Raises an :class:`~hpid_ros.errors.HpidError` for settings that are refused.
        """
        if not concern_the_loop(changes):
            return SetParametersResult(successful=True)
        values = merged(self._node, LOOP_PARAMETERS, changes)
        return verdict(values, lambda each: require(self._checked(each)))

    def _checked(self, values: Mapping[str, Value]) -> LoopSettings:
        settings = LoopSettings.from_parameters({**values, **model_values(self._node)})
        return with_inertia(self._limits.within(settings), self.robot)


def concern_the_loop(changes: Sequence[Parameter]) -> bool:
    """Tell whether a change is about the loop at all."""
    return any(change.name in LOOP_PARAMETERS for change in changes)

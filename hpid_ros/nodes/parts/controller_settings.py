"""A controller's settings from its parameters, and the model term of a state."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import HpidError, MessageError, SettingError
from hpid_ros.base.records import Record, quantity
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.settings import (
    LARGEST_EFFORT,
    LOOP_PARAMETERS,
    MODEL_PARAMETERS,
    PARAMETERS,
    LoopSettings,
    Value,
)
from hpid_ros.messages.joint_state import JointSample, RobotReader
from hpid_ros.nodes.core.parameters import declare, read
from hpid_ros.robot.description import robot_limits

if TYPE_CHECKING:
    from hpid_ros.robot.compensation import LoopModel


@dataclass(frozen=True)
class RobotParameters(Record):
    """The robot whose joint is controlled."""

    robot_description: str = quantity(
        "URDF of the robot, XML text or path: limits effort, position and velocity", default=""
    )


def _require_limits(settings: LoopSettings) -> None:
    """Refuse a joint that its description was to limit, and does not."""
    lacks = {
        "effort": settings.effort.largest == LARGEST_EFFORT and "u_clamp_max and u_clamp_min",
        "velocity": math.isinf(settings.motion.fastest) and "velocity_max",
    }
    for limit, parameters in lacks.items():
        if parameters:
            raise SettingError(
                f"robot_description has no {limit} limit for {settings.joint}: give it one, or "
                f"set {parameters}"
            )


class ControllerSettings:
    """Makes of a controller's parameters the settings of its loop, within the robot's limits."""

    def __init__(self, node: Node) -> None:
        self._node = node
        declare(node, [PARAMETERS["joint"]], read_only=["joint"])
        self.robot = read(node, RobotParameters).robot_description
        self._limits = robot_limits(self.robot, str(node.get_parameter("joint").value))
        self.is_slide = self._limits.is_slide
        specs = [spec for name, spec in PARAMETERS.items() if name != "joint"]
        declare(node, specs, read_only=MODEL_PARAMETERS, is_slide=self.is_slide)
        self._last: tuple[Mapping[str, Value], LoopSettings] | None = None

    def with_changes(self, changes: Sequence[Parameter] = ()) -> LoopSettings:
        """Return the settings that would be active after a change."""
        values = {name: self._node.get_parameter(name).value for name in PARAMETERS}
        values |= {each.name: each.value for each in changes if each.name in LOOP_PARAMETERS}
        if self._last is None or self._last[0] != values:  # checked first, applied afterwards
            settings = self._limits.within(LoopSettings.from_parameters(values))
            if self.robot:
                _require_limits(settings)
            if settings.model.is_on:
                # Pinocchio takes a moment to import; what needs it is fixed at the start.
                from hpid_ros.robot.compensation import with_inertia

                settings = with_inertia(settings, self.robot)
            self._last = values, settings
        return self._last[1]

    def verdict(
        self, changes: Sequence[Parameter], require: Callable[[LoopSettings], None]
    ) -> SetParametersResult:
        if concern_the_loop(changes):
            try:
                require(self.with_changes(changes))
            except HpidError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def concern_the_loop(changes: Sequence[Parameter]) -> bool:
    """Return whether a change is about the loop at all."""
    return any(change.name in LOOP_PARAMETERS for change in changes)


def model_compensation(node: Node, settings: LoopSettings, robot: str) -> ModelCompensation | None:
    """Build the model that a controller's settings ask for, and say in its log what it is."""
    if not settings.model.is_on:
        return None
    # Pinocchio takes a moment to import, and a controller without a model does without.
    from hpid_ros.robot.compensation import loop_model

    model = loop_model(settings, robot)
    if model is None:
        return None
    node.get_logger().info(model.text)
    return ModelCompensation(model, settings.model.compensation)


class ModelCompensation:
    """Lets a loop answer states with the model's term."""

    def __init__(self, model: LoopModel, kind: str) -> None:
        self._compensator, self._kind = model.compensator, kind
        self.states = model.compensator.states
        self._reader = RobotReader(self.states.joints)

    def answer(self, loop: JointLoop, sample: JointSample, raw: bytes) -> float:
        """Return the effort that answers a state, in [N m].

        A state that the model cannot use is answered with the term of the last one that it
        could, for at most ``state_timeout``; after that the loop gives ``fallback_effort``.
        """
        try:
            robot = self._reader.read(raw)
        except MessageError as error:
            term = self._compensator.hold(sample.stamp_ns, str(error))
        else:
            term = self._compensator.term(sample.stamp_ns, *robot)
        return self._compensator.answer(loop, *sample, term)

    def readings(self) -> Mapping[str, object]:
        """Return what ``/diagnostics`` tells of the model."""
        return {
            "compensation": self._kind,
            "model terms held": self.states.held,
            "states without a model term": self.states.lost,
            "last fault of the model": self.states.last_fault or "none",
        }

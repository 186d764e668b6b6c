"""Tolerances of a goal: defaults, what a goal says instead, and whether an error is within them.

A tolerance of zero is not enforced. Source: ``ros2_controllers``,
``joint_trajectory_controller/include/joint_trajectory_controller/tolerances.hpp``, and
``control_msgs/msg/JointTolerance`` for what 0 and -1 mean in a goal.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from hpid_ros.base.errors import unknown_name
from hpid_ros.goals.results import GoalError, ResultCode

_EPSILON = 1.2e-7  # of float32: what is called -1 may have been rounded on the way


class Tolerance(NamedTuple):
    """How far a joint may be from its reference; 0 is not enforced."""

    position: float = 0.0  # [rad] or [m]
    velocity: float = 0.0  # [rad/s] or [m/s]

    def violation(self, position: float, velocity: float, unit: str) -> str:
        """Return what is violated by an error, in words; nothing if it is within the tolerance."""
        if 0.0 < self.position < abs(position):
            return (
                f"{abs(position):.4g} {unit} from its reference, "
                f"its tolerance is {self.position:g} {unit}"
            )
        if 0.0 < self.velocity < abs(velocity):
            return (
                f"{abs(velocity):.4g} {unit}/s off the velocity of its reference, "
                f"its tolerance is {self.velocity:g} {unit}/s"
            )
        return ""


class AskedTolerance(NamedTuple):
    """What a goal asks of one joint: 0 is the default, -1 none."""

    joint: str  # name of the joint
    position: float = 0.0  # [rad] or [m]
    velocity: float = 0.0  # [rad/s] or [m/s]
    acceleration: float = 0.0  # [rad/s^2] or [m/s^2]


@dataclass(frozen=True)
class Tolerances:
    """All tolerances of a goal."""

    path: Mapping[str, Tolerance]  # while the trajectory lasts, by joint
    goal: Mapping[str, Tolerance]  # after its last point, by joint
    goal_time: float = 0.0  # [s] how much later than that they must be met; 0 waits for ever

    def asked(
        self, path: Iterable[AskedTolerance], goal: Iterable[AskedTolerance], goal_time: float
    ) -> Tolerances:
        """Return these with what a goal asks for instead."""
        return replace(
            self,
            path=_laid_over(self.path, path, "path_tolerance"),
            goal=_laid_over(self.goal, goal, "goal_tolerance"),
            goal_time=_resolved(self.goal_time, goal_time, "goal_time_tolerance", "s"),
        )


def _laid_over(
    defaults: Mapping[str, Tolerance], asked: Iterable[AskedTolerance], name: str
) -> Mapping[str, Tolerance]:
    merged = dict(defaults)
    for each in asked:
        if each.joint not in defaults:
            line = f"{name}: {unknown_name('joint', each.joint, defaults)}"
            raise GoalError(line, ResultCode.INVALID_JOINTS)
        where = f"{name} of {each.joint}"
        default = merged[each.joint]
        _resolved(0.0, each.acceleration, f"{where}: acceleration", "rad/s^2 or m/s^2")
        merged[each.joint] = Tolerance(
            _resolved(default.position, each.position, f"{where}: position", "rad or m"),
            _resolved(default.velocity, each.velocity, f"{where}: velocity", "rad/s or m/s"),
        )
    return merged


def _resolved(default: float, asked: float, where: str, unit: str) -> float:
    if asked == 0.0:
        return default
    if abs(asked + 1.0) <= _EPSILON:
        return 0.0
    if not (math.isfinite(asked) and asked > 0.0):
        raise GoalError(
            f"{where} must be positive, 0 for the default or -1 for none, not {asked:g} {unit}"
        )
    return asked

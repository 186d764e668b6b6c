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
    """How far a joint may be from its reference; 0 is not enforced.

    Attributes:
        position: In [rad] or [m].
        velocity: In [rad/s] or [m/s].
    """

    position: float = 0.0
    velocity: float = 0.0

    def violation(self, position: float, velocity: float, unit: str) -> str:
        """Return what is violated by an error, in words; nothing if it is within the tolerance.

        Args:
            position: Reference minus measured position in [rad] or [m].
            velocity: Reference minus measured velocity in [rad/s] or [m/s].
            unit: Of the position, for the words.
        """
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
    """What a goal asks of one joint: 0 is the default, -1 none.

    Attributes:
        joint: Name of the joint.
        position: In [rad] or [m].
        velocity: In [rad/s] or [m/s].
        acceleration: In [rad/s^2] or [m/s^2]; looked at for being a number, and no further, since
            nobody measures accelerations.
    """

    joint: str
    position: float = 0.0
    velocity: float = 0.0
    acceleration: float = 0.0


@dataclass(frozen=True)
class Tolerances:
    """All tolerances of a goal.

    Attributes:
        path: While the trajectory lasts, by joint.
        goal: After its last point, by joint.
        goal_time: How much later than that they must be met, in [s]; 0 waits for ever.
    """

    path: Mapping[str, Tolerance]
    goal: Mapping[str, Tolerance]
    goal_time: float = 0.0

    def asked(
        self, path: Iterable[AskedTolerance], goal: Iterable[AskedTolerance], goal_time: float
    ) -> Tolerances:
        """Return these with what a goal asks for instead.

        Args:
            path: Of single joints.
            goal: Of single joints.
            goal_time: In [s]; 0 is the default, -1 waits for ever.

        Raises:
            GoalError: A joint that is none of these, or a number that is no tolerance. (JTC takes
                its defaults then; here a goal is not run under others than it asks for.)
        """
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

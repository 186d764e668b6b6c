"""What a plan is made with: the robot, its speeds, its distances."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from hpid_ros.errors import TrajectoryError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive


@dataclass(frozen=True)
class TaskRobot:
    """The robot that does a task.

    Attributes:
        description: The robot.
        base: Its base; None where the root does not move.
        initial_positions: Positions at time 0 by joint, in [rad]; others start at 0. The root
            link starts at the origin of the frame ``odom``.
    """

    description: RobotDescription
    base: DifferentialDrive | None = None
    initial_positions: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class PlanOptions:
    """How a brick task is done.

    Attributes:
        standoff: Distance of the base's origin from a brick, or from its place, when the arm
            takes or puts it, in [m].
        back_off: How far the base drives backwards before it turns away, in [m].
        clearance: How far above a brick the straight line to it begins, in [m].
        release_gap: How far above its place a brick is let go, in [m].
        settle: Wait before the fingers close or open, for the errors to die out, in [s].
        grip_time: Wait after it, in [s].
        arm_speed: Largest joint speed, as a share of the joint's limit.
        line_speed: Largest speed of the hand on a straight line, in [m/s].
        drive_speed: Largest speed of the base, in [m/s].
        turn_speed: Largest turning speed of the base, in [rad/s].
        opening: Widest brick that the hand can take, in [m].

    Raises:
        TrajectoryError: A value is out of its range.
    """

    standoff: float = 0.42
    back_off: float = 0.2
    clearance: float = 0.12
    release_gap: float = 0.003
    settle: float = 1.5
    grip_time: float = 0.3
    arm_speed: float = 0.35
    line_speed: float = 0.1
    drive_speed: float = 0.25
    turn_speed: float = 0.6
    opening: float = math.inf

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            may_be_zero = each.name in ("back_off", "release_gap", "settle", "grip_time")
            is_finite = math.isfinite(value) or each.name == "opening"
            if not (is_finite and (value > 0.0 or (may_be_zero and value == 0.0))):
                bound = "at least 0" if may_be_zero else "positive"
                raise TrajectoryError(f"{each.name} must be {bound} and finite, not {value}")
        if self.arm_speed > 1.0:
            raise TrajectoryError(f"arm_speed is a share, at most 1, not {self.arm_speed}")

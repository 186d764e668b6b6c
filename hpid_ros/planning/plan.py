"""The options and the result of a plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import NamedTuple

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.kinematics import LinkPose
from hpid_ros.trajectory import JointTrajectory


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


class Placement(NamedTuple):
    """Where a brick is, in the frame ``odom``.

    Attributes:
        position: Its centre x, y, z, in [m].
        yaw: Its turn about z, in [rad].
        approach: Heading of the base before it, in [rad]; None: straight from where it is.
    """

    position: tuple[float, float, float]
    yaw: float = 0.0
    approach: float | None = None


@dataclass(frozen=True)
class BrickGoal:
    """A brick, where it is, and where it shall be.

    Attributes:
        name: Name of the brick.
        size: Edges along its own x, y, z, in [m].
        pick: Where it is.
        place: Where it shall be.
    """

    name: str
    size: tuple[float, float, float]
    pick: Placement
    place: Placement


class Grip(NamedTuple):
    """The gripper closes or opens.

    Attributes:
        time_ns: From the start, in [ns].
        is_closed: Whether it closes.
        brick: Name of the brick that it is for.
    """

    time_ns: int
    is_closed: bool
    brick: str


class TaskPose(NamedTuple):
    """Where the hand is to be, in the frame ``odom``.

    Attributes:
        time_ns: When, from the start, in [ns].
        phase: ``above pick``, ``pick``, ``lifted``, ``above place``, ``place`` or ``retreated``.
        brick: Name of the brick.
        pose: The hand.
    """

    time_ns: int
    phase: str
    brick: str
    pose: LinkPose


@dataclass(frozen=True)
class BrickPlan:
    """A whole brick task.

    Attributes:
        trajectory: Of all joints, the wheels first.
        grips: When the gripper closes and opens.
        poses: What the hand has to reach, in order.
        goals: The bricks, in order.
    """

    trajectory: JointTrajectory
    grips: tuple[Grip, ...]
    poses: tuple[TaskPose, ...]
    goals: tuple[BrickGoal, ...]

    @property
    def duration(self) -> float:
        """Time of the last point, in [s]."""
        return self.trajectory.points[-1].time_from_start_ns * 1e-9

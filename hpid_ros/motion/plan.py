"""The options and the result of a plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from hpid_ros.base.records import Record, quantity
from hpid_ros.motion.joint_trajectory import JointTrajectory
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive

if TYPE_CHECKING:
    from hpid_ros.robot.kinematics import LinkPose


@dataclass(frozen=True)
class TaskRobot:
    """The robot that does a task."""

    description: RobotDescription  # the robot
    base: DifferentialDrive | None = None  # its base; None where the root does not move
    initial_positions: Mapping[str, float] = field(default_factory=dict)
    opening: float = math.inf  # [m] widest brick that its hand can take


@dataclass(frozen=True)
class PlanOptions(Record):
    """How a brick task is done."""

    standoff: float = quantity(
        "Distance of the base's origin from a brick, or from its place, when the arm takes or "
        "puts it",
        "m",
        default=0.42,
        above=0.0,
    )
    back_off: float = quantity(
        "How far the base drives backwards before it turns away", "m", default=0.2, least=0.0
    )
    clearance: float = quantity(
        "How far above a brick the straight line to it begins", "m", default=0.12, above=0.0
    )
    release_gap: float = quantity(
        "How far above its place a brick is let go", "m", default=0.003, least=0.0
    )
    settle: float = quantity(
        "Wait before the fingers close or open, for the errors to die out",
        "s",
        default=1.5,
        least=0.0,
    )
    grip_time: float = quantity("Wait after it", "s", default=0.3, least=0.0)
    arm_speed: float = quantity(
        "Largest joint speed, as a share of the joint's limit", default=0.35, above=0.0, most=1.0
    )
    line_speed: float = quantity(
        "Largest speed of the hand on a straight line", "m/s", default=0.1, above=0.0
    )
    drive_speed: float = quantity("Largest speed of the base", "m/s", default=0.25, above=0.0)
    turn_speed: float = quantity(
        "Largest turning speed of the base", "rad/s", default=0.6, above=0.0
    )


class Placement(NamedTuple):
    """Where a brick is, in the frame ``odom``."""

    position: tuple[float, float, float]  # [m] its centre x, y, z
    yaw: float = 0.0  # [rad] its turn about z
    approach: float | None = None  # [rad] heading of the base before it


@dataclass(frozen=True)
class BrickGoal:
    """A brick, where it is, and where it shall be."""

    name: str  # name of the brick
    size: tuple[float, float, float]  # [m] edges along its own x, y, z
    pick: Placement  # where it is
    place: Placement  # where it shall be


class Grip(NamedTuple):
    """The gripper closes or opens."""

    time_ns: int  # [ns] from the start
    is_closed: bool  # whether it closes
    brick: str  # name of the brick that it is for


class TaskPose(NamedTuple):
    """Where the hand is to be, in the frame ``odom``."""

    time_ns: int  # [ns] when, from the start
    phase: str  # above pick, pick, lifted, above place, place or retreated
    brick: str  # name of the brick
    pose: LinkPose  # the hand


@dataclass(frozen=True)
class BrickPlan:
    """A whole brick task."""

    trajectory: JointTrajectory  # of all joints, the wheels first
    grips: tuple[Grip, ...]  # when the gripper closes and opens
    poses: tuple[TaskPose, ...]  # what the hand has to reach, in order
    goals: tuple[BrickGoal, ...]  # the bricks, in order

    @property
    def duration(self) -> float:
        """Time of the last point, in [s]."""
        return self.trajectory.points[-1].time_from_start_ns * 1e-9

"""What a brick task is, and what a plan of it says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from hpid_ros.robot.chain import LinkPose
from hpid_ros.trajectory import JointTrajectory


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

"""Workpieces: bricks to carry, supports to put them on, and the gripper."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.base.arrays import Vector
from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.documents.records import Record, quantity
from hpid_ros.simulation.world.disturbances import LONGEST

LARGEST = 100.0
"""Edge of a box and distance from the origin, in [m]."""


@dataclass(frozen=True)
class Support(Record):
    """A box that stays where it is: a table, a shelf."""

    name: str = quantity("Its name, for messages")
    size: Vector = quantity("Edges along its own x, y, z", "m", above=0.0, most=LARGEST)
    position: Vector = quantity("Its centre in the world", "m", least=-LARGEST, most=LARGEST)
    yaw: float = quantity("Its turn about the world's z", "rad", default=0.0)
    friction: float = quantity(
        "Coefficient of its surface; of two that touch the product counts", default=1.0, least=0.0
    )

    @property
    def orientation(self) -> tuple[float, float, float, float]:
        """Its turn as a quaternion x, y, z, w."""
        return 0.0, 0.0, math.sin(self.yaw / 2.0), math.cos(self.yaw / 2.0)


@dataclass(frozen=True)
class Brick(Support):
    """A solid, homogeneous box that can be carried."""

    mass: float = quantity("Of the brick", "kg", default=1.0, above=0.0)


@dataclass(frozen=True)
class GripperSettings(Record):
    """A gripper of two parallel fingers, without a motor of its own in the simulation.

    The grasp frame is its link's: its origin lies between the fingertips, its z points out of the
    hand, the fingers close along its y. A brick is held if its centre and its faces are near
    enough to it when the fingers close.
    """

    link: str = quantity("Link whose frame is the grasp frame", default="payload")
    opening: float = quantity(
        "Widest brick between the open fingers", "m", default=0.078, above=0.0
    )
    tolerance: float = quantity(
        "Largest distance of a brick from the grasp frame when it is taken",
        "m",
        default=0.015,
        above=0.0,
    )
    angle_tolerance: float = quantity(
        "Largest angle between its faces and the fingers; with more than pi/4 other faces would "
        "be meant",
        "rad",
        default=0.15,
        above=0.0,
        most=math.pi / 4.0,
    )
    grip_force: float = quantity("With which each finger presses", "N", default=50.0, above=0.0)
    friction: float = quantity("Coefficient between finger and brick", default=0.6, above=0.0)

    @property
    def holding_force(self) -> float:
        """Force at which a brick slips out: friction times grip force at both fingers, in [N]."""
        return 2.0 * self.friction * self.grip_force


@dataclass(frozen=True)
class GripCommand(Record):
    """The gripper closes or opens; between two control periods, with the later one."""

    time: float = quantity("When", "s", least=0.0, most=LONGEST)
    is_closed: bool = quantity("Whether it closes", key="closed")

    @property
    def time_ns(self) -> int:
        """When, in [ns]."""
        return round(self.time * NANOSECONDS)


@dataclass(frozen=True)
class Workplace(Record):
    """Everything of a brick task that is not the robot."""

    bricks: tuple[Brick, ...] = quantity("What can be carried", default=(), names=True)
    supports: tuple[Support, ...] = quantity("What stays", default=(), names=True)
    gripper: GripperSettings = quantity(
        "The robot's gripper; without a brick there is none", factory=GripperSettings
    )
    schedule: tuple[GripCommand, ...] = quantity(
        "When it closes and opens, where the reference is no brick task",
        key="grips",
        default=(),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [each.name for each in (*self.bricks, *self.supports)]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise SettingError(f"bricks and supports must differ in name, {name!r} is twice")

    def __bool__(self) -> bool:
        return bool(self.bricks or self.supports)

"""Workpieces: bricks to carry, supports to put them on, and the gripper."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from hpid_ros.base.errors import SettingError
from hpid_ros.simulation.world.disturbances import LATEST_NS, vector

LARGEST = 100.0
"""Edge of a box and distance from the origin, in [m]."""

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Support:
    """A box that stays where it is: a table, a shelf.

    Attributes:
        name: Its name, for messages.
        size: Edges along its own x, y, z, in [m].
        position: Its centre in the world, in [m].
        yaw: Its turn about the world's z, in [rad].
        friction: Coefficient of its surface; of two that touch the product counts.

    Raises:
        SettingError: A value is out of its range.
    """

    name: str
    size: Vector
    position: Vector
    yaw: float = 0.0
    friction: float = 1.0

    def __post_init__(self) -> None:
        if not self.name:
            raise SettingError("a brick or support must have a name, it is empty")
        if not all(0.0 < edge <= LARGEST for edge in vector(self._named("size"), self.size)):
            raise SettingError(
                f"{self._named('size')} {list(self.size)} must be in (0, {LARGEST:g}] m"
            )
        if max(map(abs, vector(self._named("position"), self.position))) > LARGEST:
            raise SettingError(
                f"{self._named('position')} {list(self.position)} must be within {LARGEST:g} m"
            )
        if not math.isfinite(self.yaw):
            raise SettingError(f"{self._named('yaw')} {self.yaw} must be finite [rad]")
        if not (math.isfinite(self.friction) and self.friction >= 0.0):
            raise SettingError(f"{self._named('friction')} {self.friction} must be >= 0")

    @property
    def orientation(self) -> tuple[float, float, float, float]:
        """Its turn as a quaternion x, y, z, w."""
        return 0.0, 0.0, math.sin(self.yaw / 2.0), math.cos(self.yaw / 2.0)

    def _named(self, what: str) -> str:
        return f"{what} of {self.name!r}"


@dataclass(frozen=True)
class Brick(Support):
    """A solid, homogeneous box that can be carried.

    Attributes:
        mass: In [kg].

    Raises:
        SettingError: A value is out of its range.
    """

    mass: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.mass) and self.mass > 0.0):
            raise SettingError(f"{self._named('mass')} {self.mass} must be positive [kg]")


@dataclass(frozen=True)
class GripperSettings:
    """A gripper of two parallel fingers, without a motor of its own in the simulation.

    Attributes:
        link: Link whose frame is the grasp frame: its origin lies between the fingertips, its z
            points out of the hand, the fingers close along its y.
        opening: Widest brick between the open fingers, in [m].
        tolerance: A brick is held if its centre is at most this far from the grasp frame when
            the fingers close, in [m].
        angle_tolerance: And if its faces are turned against the fingers by at most this, in
            [rad].
        grip_force: With which each finger presses, in [N].
        friction: Coefficient between finger and brick.

    Raises:
        SettingError: A value is out of its range.
    """

    link: str = "payload"
    opening: float = 0.078
    tolerance: float = 0.015
    angle_tolerance: float = 0.15
    grip_force: float = 50.0
    friction: float = 0.6

    def __post_init__(self) -> None:
        for name in ("opening", "tolerance", "angle_tolerance", "grip_force", "friction"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise SettingError(f"{name} {value} of the gripper must be positive and finite")
        if self.angle_tolerance > math.pi / 4.0:
            raise SettingError(
                f"angle_tolerance {self.angle_tolerance} of the gripper must be at most pi/4: a "
                "box turned further has other faces towards the fingers"
            )

    @property
    def holding_force(self) -> float:
        """Force at which a brick slips out: friction times grip force at both fingers, in [N]."""
        return 2.0 * self.friction * self.grip_force


@dataclass(frozen=True)
class GripCommand:
    """The gripper closes or opens.

    Attributes:
        time_ns: When, in [ns]; between two control periods it happens with the later one.
        is_closed: Whether it closes.

    Raises:
        SettingError: The time is out of its range.
    """

    time_ns: int
    is_closed: bool

    def __post_init__(self) -> None:
        if not 0 <= self.time_ns <= LATEST_NS:
            raise SettingError(
                f"time {self.time_ns * 1e-9:g} s of the gripper must be from 0 to "
                f"{LATEST_NS * 1e-9:g} s"
            )


@dataclass(frozen=True)
class Workplace:
    """Everything of a brick task that is not the robot.

    Attributes:
        bricks: What can be carried.
        supports: What stays.
        gripper: The robot's gripper; without a brick there is none.
        schedule: When it closes and opens.

    Raises:
        SettingError: Two things have one name.
    """

    bricks: tuple[Brick, ...] = ()
    supports: tuple[Support, ...] = ()
    gripper: GripperSettings = field(default_factory=GripperSettings)
    schedule: tuple[GripCommand, ...] = ()

    def __post_init__(self) -> None:
        names = [each.name for each in (*self.bricks, *self.supports)]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise SettingError(f"bricks and supports must differ in name, {name!r} is twice")

    def __bool__(self) -> bool:
        return bool(self.bricks or self.supports)

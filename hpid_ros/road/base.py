"""What a robot rolls on while it is recorded: wheels, whose motors then move the whole robot."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hpid_ros.bags.messages import odometry_topics, read_planar
from hpid_ros.bags.run.topics import is_below
from hpid_ros.base.errors import BagError
from hpid_ros.robot.given import GivenRobot

_STILL = 1e-3  # [m] and [rad]
_WHEEL = "wheel"


class BaseMotion(NamedTuple):
    """How far a base moved while it was recorded."""

    way: float  # [m] between its ends
    turn: float  # [rad] likewise

    @property
    def is_moving(self) -> bool:
        """Whether it did not stand still."""
        return self.way > _STILL or self.turn > _STILL

    def __str__(self) -> str:
        return f"{self.way:.2g} m and {self.turn:.2g} rad by its odometry"


def base_motion(bag: Path, namespace: str = "") -> BaseMotion | None:
    """Return how far a base moved by all odometry that a bag has; None if it has none."""
    found = []
    topics = [name for name in odometry_topics(bag) if is_below(name, f"/{namespace.strip('/')}")]
    for topic in topics:
        with suppress(BagError):  # without messages, or with damaged ones
            found.append(read_planar(bag, topic).poses)
    if not found:
        return None
    ways = [float(np.hypot(*np.ptp(poses[:, :2], axis=0))) for poses in found]
    return BaseMotion(max(ways), max(float(np.ptp(poses[:, 2])) for poses in found))


def is_wheel(joint: str, robot: GivenRobot | None, motion: BaseMotion | None) -> bool:
    """Tell whether a joint is a wheel of the base: the robot says so, or its name does."""
    is_fixed = robot is not None and robot.fixed_base and not (motion and motion.is_moving)
    if robot is not None and (robot.wheels or is_fixed):
        return joint in robot.wheels
    return _WHEEL in joint.lower()


def why_not_wheel(motion: BaseMotion | None, *, is_asked_for: bool) -> str:
    """Return why a wheel's numbers would be none of its own; nothing if they are."""
    if motion is None:
        if is_asked_for:
            return ""
        return (
            "a wheel by its name, and no odometry tells whether the robot rolled: what it moves "
            "would be the robot; if it turned freely, ask for it with --joint"
        )
    if not motion.is_moving:
        return ""
    return (
        f"the robot rolled on it ({motion}): what it moves is the robot, and changes with all "
        "that the robot does; turn it freely, off the ground"
    )


def remark_on_base(motion: BaseMotion) -> str:
    """Return what must be known of joints that a base carries that moved."""
    return (
        f"the base moved ({motion}), but the links are known on a base that stands still: what "
        "its motion needs is in these numbers, for whose intervals nothing stands"
    )

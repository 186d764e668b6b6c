"""Poses and twists of links in the world."""

from __future__ import annotations

from typing import NamedTuple


class Pose(NamedTuple):
    """A frame in the world.

    Attributes:
        position: Origin x, y, z, in [m].
        orientation: Unit quaternion x, y, z, w, as in ``geometry_msgs/Quaternion``.
    """

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


class Twist(NamedTuple):
    """Velocity of a frame, expressed in that frame, as ``nav_msgs/Odometry`` has it.

    Attributes:
        linear: Velocity of the frame's origin, in [m/s].
        angular: Angular velocity, in [rad/s].
    """

    linear: tuple[float, float, float]
    angular: tuple[float, float, float]

"""Poses and twists of links in the world."""

from __future__ import annotations

from typing import NamedTuple


class Pose(NamedTuple):
    """A frame in the world."""

    position: tuple[float, float, float]  # [m] origin x, y, z
    # unit quaternion x, y, z, w, as in geometry_msgs/Quaternion
    orientation: tuple[float, float, float, float]


class Twist(NamedTuple):
    """Velocity of a frame, expressed in that frame, as ``nav_msgs/Odometry`` has it."""

    linear: tuple[float, float, float]  # [m/s] velocity of the frame's origin
    angular: tuple[float, float, float]  # [rad/s] angular velocity

"""What ``nav_msgs/Odometry`` holds, as plain numbers: by the wheels, and in truth."""

from __future__ import annotations

import math
from typing import NamedTuple

from hpid_ros.simulation.base_monitor import BaseReport
from hpid_ros.simulation.poses import Pose, Twist
from hpid_ros.simulation.world import World

ODOM_FRAME = "odom"
UNMEASURED = 1e6
"""Variance of what wheels cannot tell: height, roll, pitch and their rates."""

_X, _Y, _YAW = 0, 1, 5
_ROW = 6


class OdometryValues(NamedTuple):
    """Pose of a base in its frame ``odom`` and twist in its own frame (REP 105).

    Attributes:
        pose: Of the base.
        pose_covariance: Of x, y, z and the rotations about them, row by row, 36 numbers, in
            [m^2], [m rad] and [rad^2].
        twist: Of the base.
        twist_covariance: Likewise, a second less.
    """

    pose: Pose
    pose_covariance: tuple[float, ...]
    twist: Twist
    twist_covariance: tuple[float, ...]


def wheel_odometry(report: BaseReport) -> OdometryValues:
    """Return what the wheels say."""
    x, y, heading = report.pose
    pose = _unmeasured()
    of_pose = report.covariance
    pose[_place(_X, _X)] = of_pose.xx
    pose[_place(_Y, _Y)] = of_pose.yy
    pose[_place(_YAW, _YAW)] = of_pose.hh
    for row, column, value in (
        (_X, _Y, of_pose.xy),
        (_X, _YAW, of_pose.xh),
        (_Y, _YAW, of_pose.yh),
    ):
        pose[_place(row, column)] = pose[_place(column, row)] = value
    twist = _unmeasured()
    linear, angular = report.twist_variance
    twist[_place(_X, _X)] = twist[_place(_Y, _Y)] = linear
    twist[_place(_YAW, _YAW)] = angular
    return OdometryValues(
        Pose((x, y, 0.0), (0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading))),
        tuple(pose),
        Twist((report.twist.linear, 0.0, 0.0), (0.0, 0.0, report.twist.angular)),
        tuple(twist),
    )


def true_odometry(world: World) -> OdometryValues:
    """Return how the root of a world's robot really is; it is certain."""
    certain = (0.0,) * _ROW**2
    return OdometryValues(world.base_pose(), certain, world.base_velocity(), certain)


def _place(row: int, column: int) -> int:
    return _ROW * row + column


def _unmeasured() -> list[float]:
    """Return a covariance of which nothing is measured."""
    covariance = [0.0] * _ROW**2
    for row in range(_ROW):
        covariance[_place(row, row)] = UNMEASURED
    return covariance

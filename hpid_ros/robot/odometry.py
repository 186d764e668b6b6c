r"""Odometry of a differential-drive base, from the turns of its wheels.

Between two readings both wheels are taken to turn at constant rates, so that the base moves on a
circular arc of length s that turns by theta; its chord is exact for every theta, also for 0,

.. math:: \Delta x = s \frac{\sin(\theta/2)}{\theta/2} \cos(\vartheta + \theta/2), \quad
    \Delta y = s \frac{\sin(\theta/2)}{\theta/2} \sin(\vartheta + \theta/2).

Source: R. Siegwart and I. Nourbakhsh, *Introduction to Autonomous Mobile Robots*, section 5.2.4;
``ros2_controllers``, ``diff_drive_controller/src/odometry.cpp``, which changes to another formula
below a turn of 1e-6 rad, since its difference of sines loses its digits there; this one does not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.robot.differential_drive import BaseTwist, DifferentialDrive

WHEEL_ERROR = 1e-4
"""Variance of a wheel's travel for each metre of it, in [m^2/m]: 1 cm after a metre."""


class PlanarPose(NamedTuple):
    """Where a base is in the plane."""

    x: float  # [m]
    y: float  # [m]
    heading: float  # [rad] counter-clockwise from x; not wrapped


class PlanarCovariance(NamedTuple):
    """Covariance of a pose: the upper triangle, in [m^2], [m rad] and [rad^2]."""

    xx: float
    xy: float
    xh: float
    yy: float
    yh: float
    hh: float


class Odometry:
    """Adds up arcs, and how uncertain they are; starts at the origin, certain of it."""

    def __init__(
        self,
        drive: DifferentialDrive,
        left: float,
        right: float,
        wheel_error: float = WHEEL_ERROR,
    ) -> None:
        self.drive = drive
        self._left, self._right = left, right
        self._wheel_error = wheel_error
        self.pose = PlanarPose(0.0, 0.0, 0.0)
        self.covariance = PlanarCovariance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.distance = self.turn = 0.0

    def update(self, left: float, right: float) -> PlanarPose:
        """Take the next reading of the wheels and return the pose."""
        drive = self.drive
        of_left = drive.radius * (left - self._left)
        of_right = drive.radius * (right - self._right)
        if of_left == 0.0 == of_right:
            return self.pose
        self._left, self._right = left, right
        distance = 0.5 * (of_left + of_right)
        turn = (of_right - of_left) / drive.separation
        x, y, heading = self.pose
        middle = heading + 0.5 * turn
        c, s = math.cos(middle), math.sin(middle)
        chord = distance * chord_share(turn)
        self.pose = PlanarPose(x + chord * c, y + chord * s, heading + turn)
        self.distance += distance
        self.turn += turn
        self._spread(abs(of_left), abs(of_right), distance, c, s)
        return self.pose

    def twist_between(self, distance: float, turn: float, seconds: float) -> BaseTwist:
        """Return the mean twist since a moment."""
        return BaseTwist((self.distance - distance) / seconds, (self.turn - turn) / seconds)

    def _spread(
        self, of_left: float, of_right: float, distance: float, c: float, s: float
    ) -> None:
        """Carry the covariance along an arc; Siegwart and Nourbakhsh, equation 5.9."""
        b, k = self.drive.separation, self._wheel_error
        both = k * (of_left + of_right)
        dd, hh = 0.25 * both, both / b**2
        dh = 0.5 * k * (of_right - of_left) / b
        was = self.covariance
        # The arc shifts x by -distance s and y by distance c for each radian of the heading.
        fx, fy = -distance * s, distance * c
        gx, gy = 0.5 * fx, 0.5 * fy
        self.covariance = PlanarCovariance(
            was.xx + 2.0 * fx * was.xh + fx * fx * was.hh + dd * c * c + 2.0 * dh * c * gx
            + hh * gx * gx,
            was.xy + fx * was.yh + fy * was.xh + fx * fy * was.hh + dd * c * s
            + dh * (c * gy + s * gx) + hh * gx * gy,
            was.xh + fx * was.hh + dh * c + hh * gx,
            was.yy + 2.0 * fy * was.yh + fy * fy * was.hh + dd * s * s + 2.0 * dh * s * gy
            + hh * gy * gy,
            was.yh + fy * was.hh + dh * s + hh * gy,
            was.hh + hh,
        )  # fmt: skip


def chord_share(turn: float) -> float:
    """Return the chord of an arc over its length."""
    half = 0.5 * turn
    return math.sin(half) / half if half else 1.0


def integrated(drive: DifferentialDrive, left: Numbers, right: Numbers) -> Numbers:
    """Return the poses of a whole recording, from the origin on, by the same arcs."""
    of_left, of_right = drive.radius * np.diff(left), drive.radius * np.diff(right)
    distances, turns = 0.5 * (of_left + of_right), (of_right - of_left) / drive.separation
    headings = np.concatenate(([0.0], np.cumsum(turns)))
    middles = headings[:-1] + 0.5 * turns
    chords = distances * np.sinc(turns / (2.0 * np.pi))
    poses = np.zeros((len(headings), 3))
    poses[1:, 0] = np.cumsum(chords * np.cos(middles))
    poses[1:, 1] = np.cumsum(chords * np.sin(middles))
    poses[:, 2] = headings
    return poses

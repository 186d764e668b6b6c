"""How far the wheels of a base slide over the ground instead of rolling on it."""

from __future__ import annotations

import math
from typing import NamedTuple

from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.odometry import PlanarPose, chord_share


class Slip(NamedTuple):
    """Distances that the contacts have slid, there and back both counted.

    Attributes:
        left: Of the left wheel along its track, in [m].
        right: Of the right wheel along its track, in [m].
        lateral: Of the axle, sideways, in [m].
    """

    left: float
    right: float
    lateral: float


class SlipMeter:
    """Compares what the wheels rolled with where the axle's ends truly went.

    In each period the base is taken to move on an arc. A wheel's slip is its travel less that of
    its end of the axle along the arc; the axle's lateral slip is what the arc does not explain.

    Attributes:
        slip: Up to now.

    Args:
        drive: The base.
        wheels: True positions of the left and the right wheel, in [rad].
        pose: True pose of the axle's centre, its heading in (-pi, pi].
    """

    def __init__(
        self, drive: DifferentialDrive, wheels: tuple[float, float], pose: PlanarPose
    ) -> None:
        self._drive, self._wheels, self._pose = drive, wheels, pose
        self.slip = Slip(0.0, 0.0, 0.0)

    def update(self, wheels: tuple[float, float], pose: PlanarPose) -> Slip:
        """Take where wheels and base are one period later, as in the constructor."""
        drive, before = self._drive, self._pose
        of_left, of_right = (
            drive.radius * (now - then) for now, then in zip(wheels, self._wheels, strict=True)
        )
        turn = math.remainder(pose.heading - before.heading, math.tau)
        middle = before.heading + 0.5 * turn
        dx, dy = pose.x - before.x, pose.y - before.y
        c, s = math.cos(middle), math.sin(middle)
        travel = (dx * c + dy * s) / chord_share(turn)
        side = 0.5 * drive.separation * turn
        left, right, lateral = self.slip
        self.slip = Slip(
            left + abs(of_left - (travel - side)),
            right + abs(of_right - (travel + side)),
            lateral + abs(dy * c - dx * s),
        )
        self._wheels, self._pose = wheels, pose
        return self.slip

"""A base's motion put together piece by piece: turns, straight drives, waits."""

from __future__ import annotations

import math

from hpid_ros.planning.arm_motion import PEAK
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.trajectory import JointTrajectory
from hpid_ros.trajectory.base_path import BACKWARD, FORWARD, base_path

_SHORTEST = 0.4  # [s]
_NEAR = 1e-6  # [m, rad]: nothing to do
_NANOSECONDS = 1_000_000_000

PlanePose = tuple[float, float, float]
"""x [m], y [m], heading [rad] in the frame ``odom``."""


class BaseMotion:
    """A path that begins at the origin of ``odom`` and rests at the end of every piece.

    Args:
        drive_speed: Largest speed, in [m/s].
        turn_speed: Largest turning speed, in [rad/s].

    Attributes:
        pose: Where the base stands at the end so far.
    """

    def __init__(self, drive_speed: float, turn_speed: float) -> None:
        self._drive_speed, self._turn_speed = drive_speed, turn_speed
        self.pose: PlanePose = (0.0, 0.0, 0.0)
        self._poses = [self.pose]
        self._times_ns = [0]
        self._directions: list[str] = []

    @property
    def time_ns(self) -> int:
        """Where the motion ends so far, in [ns]."""
        return self._times_ns[-1]

    def wait_until(self, time_ns: int) -> None:
        """Stay until a moment, in [ns]."""
        if time_ns > self.time_ns:
            self._add(self.pose, time_ns)

    def turn(self, heading: float) -> None:
        """Turn in place, the shorter way round.

        Args:
            heading: To where, in [rad].
        """
        x, y, before = self.pose
        angle = math.remainder(heading - before, math.tau)
        if abs(angle) > _NEAR:
            self._add((x, y, before + angle), self._after(abs(angle) / self._turn_speed))

    def drive(self, distance: float) -> None:
        """Drive straight on.

        Args:
            distance: How far, in [m]; backwards where it is negative.
        """
        x, y, heading = self.pose
        if abs(distance) > _NEAR:
            there = (x + distance * math.cos(heading), y + distance * math.sin(heading), heading)
            direction = FORWARD if distance > 0.0 else BACKWARD
            self._add(there, self._after(abs(distance) / self._drive_speed), direction)

    def trajectory(self, base: DifferentialDrive, velocity_limit: float) -> JointTrajectory:
        """Return the wheels' trajectories.

        Args:
            base: The base.
            velocity_limit: Of a wheel, in [rad/s].

        Raises:
            TrajectoryError: A piece asks for more than the limit.
        """
        if len(self._poses) == 1:
            self._add(self.pose, self.time_ns + _NANOSECONDS)
        return base_path(
            [time_ns / _NANOSECONDS for time_ns in self._times_ns],
            self._poses,
            base.left,
            base.right,
            base.radius,
            base.separation,
            directions=self._directions,
            velocity_limit=velocity_limit,
        )

    def _after(self, seconds: float) -> int:
        """Return when a piece of this mean duration ends, in [ns], at a whole millisecond."""
        milliseconds = math.ceil(round(max(_SHORTEST, PEAK * seconds) * 1e6) / 1e3)
        return self.time_ns + milliseconds * 1_000_000

    def _add(self, pose: PlanePose, time_ns: int, direction: str = FORWARD) -> None:
        self.pose = pose
        self._poses.append(pose)
        self._times_ns.append(time_ns)
        self._directions.append(direction)

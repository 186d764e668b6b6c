"""Motions of an arm and of a base, put together piece by piece."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import TrajectoryError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.kinematics import Kinematics, LinkPose
from hpid_ros.trajectory import JointTrajectory, TrajectoryPoint
from hpid_ros.trajectory.base_path import BACKWARD, FORWARD, base_path

PEAK = 1.875  # largest speed of a minimum-jerk motion over its mean speed
_SHORTEST_REACH = 0.2  # [s]
_TICK_NS = 1_000_000  # every piece ends at a whole millisecond
_PIECE = 0.05  # [s] of a straight line between two solutions of the inverse kinematics
_LARGEST_JUMP = 0.3  # [rad] between two neighbouring solutions on a line
_DIGITS = 10  # of a knot: what is beyond is rounding of the solver, and differs by machine


class MotionRow(NamedTuple):
    """All joints at one instant."""

    time_ns: int  # [ns] from the start
    positions: Numbers  # [rad]
    velocities: Numbers  # [rad/s]
    accelerations: Numbers  # [rad/s^2]


class ArmMotion:
    """A motion that begins and ends every piece at rest."""

    def __init__(self, arm: Kinematics, start: npt.ArrayLike, speed: float) -> None:
        self._arm = arm
        joints = arm.description.select(arm.joints)
        self._speeds = speed * np.array([joint.velocity for joint in joints])
        self.time_ns = 0
        self._rows = [self._at_rest(np.asarray(start, dtype=float))]

    @property
    def positions(self) -> Numbers:
        """Where the arm stands at the end, in [rad]."""
        return self._rows[-1].positions

    def wait(self, seconds: float) -> None:
        """Stay."""
        if seconds > 0.0:
            self.time_ns += _whole(seconds)
            self._rows.append(self._at_rest(self.positions))

    def move(self, target: Numbers) -> None:
        """Move every joint with least jerk."""
        distance = np.abs(target - self.positions)
        if not distance.any():
            return
        self.time_ns += _whole(max(_SHORTEST_REACH, float(np.max(PEAK * distance / self._speeds))))
        self._rows.append(self._at_rest(target))

    def line(self, target: LinkPose, speed: float) -> None:
        """Move the link along a straight line with least jerk, its axes unchanged."""
        start = self._arm.pose(self.positions).position
        length = float(np.linalg.norm(target.position - start))
        if length == 0.0:
            return
        duration_ns = _whole(max(_SHORTEST_REACH, PEAK * length / speed))
        count = max(4, math.ceil(duration_ns / NANOSECONDS / _PIECE))
        shares = np.linspace(0.0, 1.0, count + 1)
        times_ns = [round(share * duration_ns) for share in shares]
        solutions = [self.positions]
        for share in shares[1:]:
            way = share**3 * (10.0 + share * (-15.0 + 6.0 * share))
            point = LinkPose(start + way * (target.position - start), target.rotation)
            solutions.append(self._arm.solve(point, solutions[-1]).round(_DIGITS))
            if np.abs(solutions[-1] - solutions[-2]).max() > _LARGEST_JUMP:
                raise TrajectoryError(
                    f"{self._arm.link} cannot follow a straight line to "
                    f"{target.position.round(3).tolist()} m: the joints would have to jump"
                )
        self._add_spline(times_ns, solutions)

    def trajectory(self) -> JointTrajectory:
        """Return the motion."""
        points = tuple(
            TrajectoryPoint(
                row.time_ns,
                *(tuple(values.tolist()) for values in row[1:]),
            )
            for row in self._rows
        )
        return JointTrajectory(self._arm.joints, points)

    def _add_spline(self, times_ns: list[int], solutions: list[Numbers]) -> None:
        """Go smoothly through solutions, at rest at both ends.

        A spline of fifth degree with its knots at the solutions is, between two of them, the one
        polynomial that the trajectory's quintic segments make of both ends' derivatives.
        """
        still = np.zeros_like(solutions[0])
        ends = [(1, still), (2, still)]
        times = np.array(times_ns) / NANOSECONDS
        spline = make_interp_spline(times, np.array(solutions), k=5, bc_type=(ends, ends))
        values = [spline(times, nu=order).round(_DIGITS) for order in range(3)]
        for index in range(1, len(times_ns) - 1):
            row = MotionRow(self.time_ns + times_ns[index], *(each[index] for each in values))
            self._rows.append(row._replace(positions=solutions[index]))
        self.time_ns += times_ns[-1]
        self._rows.append(self._at_rest(solutions[-1]))

    def _at_rest(self, positions: Numbers) -> MotionRow:
        still = np.zeros_like(positions)
        return MotionRow(self.time_ns, positions, still, still)


def _whole(seconds: float) -> int:
    """Return a time in [ns], rounded up to a whole tick."""
    return math.ceil(round(seconds * NANOSECONDS) / _TICK_NS) * _TICK_NS


_SHORTEST_DRIVE = 0.4  # [s]
_NEAR = 1e-6  # [m, rad]: nothing to do

PlanePose = tuple[float, float, float]
"""x [m], y [m], heading [rad] in the frame ``odom``."""


class BaseMotion:
    """A path that begins at the origin of ``odom`` and rests at the end of every piece."""

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
        """Turn in place, the shorter way round."""
        x, y, before = self.pose
        angle = math.remainder(heading - before, math.tau)
        if abs(angle) > _NEAR:
            self._add((x, y, before + angle), self._after(abs(angle) / self._turn_speed))

    def drive(self, distance: float) -> None:
        """Drive straight on."""
        x, y, heading = self.pose
        if abs(distance) > _NEAR:
            there = (x + distance * math.cos(heading), y + distance * math.sin(heading), heading)
            direction = FORWARD if distance > 0.0 else BACKWARD
            self._add(there, self._after(abs(distance) / self._drive_speed), direction)

    def trajectory(self, base: DifferentialDrive, velocity_limit: float) -> JointTrajectory:
        """Return the wheels' trajectories."""
        if len(self._poses) == 1:
            self._add(self.pose, self.time_ns + NANOSECONDS)
        return base_path(
            [time_ns / NANOSECONDS for time_ns in self._times_ns],
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
        milliseconds = math.ceil(round(max(_SHORTEST_DRIVE, PEAK * seconds) * 1e6) / 1e3)
        return self.time_ns + milliseconds * 1_000_000

    def _add(self, pose: PlanePose, time_ns: int, direction: str = FORWARD) -> None:
        self.pose = pose
        self._poses.append(pose)
        self._times_ns.append(time_ns)
        self._directions.append(direction)

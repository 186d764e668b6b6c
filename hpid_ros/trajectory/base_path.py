"""A path of a differential-drive base as trajectories of its two wheels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import TrajectoryError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.trajectory.base_legs import DrivenLeg, Leg, PathPose, TimeLaw, Turn, leg_knots
from hpid_ros.trajectory.joint_trajectory import JointTrajectory, TrajectoryPoint
from hpid_ros.trajectory.spline import Knot

FORWARD, BACKWARD = "forward", "backward"
DIRECTIONS = (FORWARD, BACKWARD)

_SAME_PLACE = 1e-9  # [m]
_SHORTEST_NS = 1_000_000  # of a leg
_LOOKS = np.linspace(0.0, 1.0, 513)  # at a leg's limits
_SHARPEST = 50.0  # [1/m], a radius of 2 cm: what is sharper is better turned in place


class BasePath:
    """Poses of the axle's centre with their times, and the curves in between.

    A leg between two places is a smooth curve with the headings as its end tangents, driven
    forward or backward; between poses in one place it is a turn by the difference of the headings
    as they are written (0 to 6.28 is a whole turn), or a wait. The base rests at every pose;
    with ``passes`` it drives on through those between two legs of one direction.
    """

    def __init__(
        self,
        times: Sequence[float],
        poses: Sequence[Sequence[float]],
        *,
        directions: Sequence[str] | None = None,
        passes: bool = False,
        curvature_limit: float = _SHARPEST,
    ) -> None:
        self._times_ns = _checked_times(times, len(poses))
        self.poses = tuple(_checked_pose(k, pose) for k, pose in enumerate(poses))
        legs = len(self.poses) - 1
        given = (FORWARD,) * legs if directions is None else tuple(directions)
        if len(given) != legs or not set(given) <= set(DIRECTIONS):
            raise TrajectoryError(
                f"a path of {legs} legs must have {legs} directions of "
                f"{' or '.join(DIRECTIONS)}, not {list(given)}"
            )
        self._signs = tuple(1 if each == FORWARD else -1 for each in given)
        self._legs = self._make_legs(passes)
        self._check_curvature(min(curvature_limit, _SHARPEST))

    @property
    def times(self) -> tuple[float, ...]:
        """Times of the poses in [s]."""
        return tuple(time / NANOSECONDS for time in self._times_ns)

    def sample(self, times: Sequence[float] | Numbers) -> Numbers:
        """Return x [m], y [m] and the heading [rad], which does not wrap, at some times."""
        wanted = np.asarray(times, dtype=np.float64)
        found = np.empty((len(wanted), 3))
        heading = self.poses[0].heading
        for index, (leg, (begin, end)) in enumerate(
            zip(self._legs, pairwise(self.times), strict=True)
        ):
            is_last = index == len(self._legs) - 1
            inside = (wanted >= begin if index else wanted > -math.inf) & (
                wanted < math.inf if is_last else wanted < end
            )
            shares = np.clip((wanted[inside] - begin) / (end - begin), 0.0, 1.0)
            x, y, turn = leg.places(shares)
            found[inside] = np.column_stack([x, y, heading + turn])
            heading += float(leg.places(np.ones(1))[2][0])
        return found

    def wheels(
        self,
        left: str,
        right: str,
        radius: float,
        separation: float,
        *,
        velocity_limit: float = math.inf,
        start: tuple[float, float] = (0.0, 0.0),
    ) -> JointTrajectory:
        r"""Return the wheels' trajectories, exact at their knots and within 1e-8 rad between.

        .. math:: \varphi_{r,l} = (s \pm b \theta / 2) / r

        with the distance s (arc length, by quadrature), the turn theta, radius r and separation b.
        """
        for name, value in (("wheel_radius", radius), ("wheel_separation", separation)):
            if not (math.isfinite(value) and value > 0.0):
                raise TrajectoryError(f"{name} must be positive and finite, not {value} m")
        for index, leg in enumerate(self._legs):
            self._check_rates(index, leg, (left, right), radius, separation, velocity_limit)
        first = self._times_ns[0]
        knots = [(Knot(first, start[0], 0.0, 0.0), Knot(first, start[1], 0.0, 0.0))]
        for leg, (begin, end) in zip(self._legs, pairwise(self._times_ns), strict=True):
            knots += leg_knots(leg, begin, end, knots[-1], radius, separation)
        points = tuple(
            TrajectoryPoint(
                pair[0].time_ns,
                *(tuple(float(each[k] or 0.0) for each in pair) for k in (1, 2, 3)),
            )
            for pair in knots
        )
        return JointTrajectory((left, right), points)

    def _make_legs(self, passes: bool) -> tuple[Leg, ...]:
        pairs = list(pairwise(self.poses))
        durations = np.diff(self._times_ns) / NANOSECONDS
        chords = [math.hypot(b.x - a.x, b.y - a.y) for a, b in pairs]
        means = [chord / time for chord, time in zip(chords, durations, strict=True)]
        speeds = [0.0] * len(self.poses)
        for k in range(1, len(pairs)) if passes else ():
            is_one_way = self._signs[k - 1] == self._signs[k]
            if is_one_way and min(chords[k - 1], chords[k]) > _SAME_PLACE:
                speeds[k] = 2.0 * means[k - 1] * means[k] / (means[k - 1] + means[k])
        legs: list[Leg] = []
        for k, (a, b) in enumerate(pairs):
            duration = float(durations[k])
            if chords[k] <= _SAME_PLACE:
                legs.append(Turn(a, b.heading - a.heading, TimeLaw(duration)))
                continue
            law = TimeLaw(duration, speeds[k] / means[k], speeds[k + 1] / means[k])
            is_passed = bool(speeds[k] or speeds[k + 1])
            legs.append(DrivenLeg(a, b, law, self._signs[k], 4 if is_passed else 3))
        return tuple(legs)

    def _check_curvature(self, limit: float) -> None:
        for index, leg in enumerate(self._legs):
            sharpest = float(np.abs(leg.curvature(_LOOKS)).max())
            if sharpest > limit:
                raise TrajectoryError(
                    f"{self._named(index)} bends with {sharpest:.3g} 1/m, more than "
                    f"{limit:g} 1/m: turn in place first, or drive it the other way"
                )

    def _check_rates(
        self,
        index: int,
        leg: Leg,
        joints: tuple[str, str],
        radius: float,
        separation: float,
        limit: float,
    ) -> None:
        motion = leg.motion(_LOOKS)
        for joint, side in zip(joints, (-0.5, 0.5), strict=True):
            rates = (motion.speed + side * separation * motion.turn_rate) / radius
            fastest = float(np.abs(rates).max())
            if fastest > limit:
                raise TrajectoryError(
                    f"{self._named(index)} turns {joint!r} at {fastest:.4g} rad/s, faster than "
                    f"{limit:g} rad/s: give it more time"
                )

    def _named(self, index: int) -> str:
        return f"leg {index} of the path, {self.times[index]:g} s to {self.times[index + 1]:g} s,"


def base_path(
    times: Sequence[float],
    poses: Sequence[Sequence[float]],
    left: str,
    right: str,
    radius: float,
    separation: float,
    *,
    directions: Sequence[str] | None = None,
    passes: bool = False,
    velocity_limit: float = math.inf,
    curvature_limit: float = _SHARPEST,
) -> JointTrajectory:
    """Return the wheels' trajectories of a path; arguments as for :class:`BasePath`."""
    path = BasePath(
        times, poses, directions=directions, passes=passes, curvature_limit=curvature_limit
    )
    return path.wheels(left, right, radius, separation, velocity_limit=velocity_limit)


def _checked_times(times: Sequence[float], count: int) -> tuple[int, ...]:
    if len(times) != count or count < 2:
        raise TrajectoryError(
            f"a path must have at least two poses and a time for each, not {count} poses and "
            f"{len(times)} times"
        )
    if not all(math.isfinite(time * NANOSECONDS) for time in times):
        raise TrajectoryError(f"times of a path must be finite, not {list(times)} s")
    in_ns = tuple(round(time * NANOSECONDS) for time in times)
    if in_ns[0] < 0 or any(b - a < _SHORTEST_NS for a, b in pairwise(in_ns)):
        raise TrajectoryError(
            f"times of a path must increase from 0 or later by at least 1 ms, not {list(times)} s"
        )
    return in_ns


def _checked_pose(index: int, pose: Sequence[float]) -> PathPose:
    values = tuple(float(value) for value in pose)
    if len(values) != 3 or not all(math.isfinite(value) and abs(value) < 1e6 for value in values):
        raise TrajectoryError(
            f"pose {index} of a path must be x [m], y [m] and heading [rad], not {list(pose)}"
        )
    return PathPose(*values)

r"""A path of a differential-drive base as trajectories of its two wheels.

The centre of a differential drive's axle is a flat output: where it goes decides heading, speed
and turning rate, so any smooth curve whose tangents are the headings can be driven,

.. math:: \theta = \operatorname{atan2}(\dot y, \dot x), \quad v = \pm\sqrt{\dot x^2 + \dot y^2},
    \quad \omega = \dot\theta = (\dot x \ddot y - \dot y \ddot x) / v^2.

Source: R. Murray, M. Rathinam and W. Sluis, *Differential flatness of mechanical control systems:
a catalog of prototype systems*, ASME 1995.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.motion.joint_trajectory import JointTrajectory, Knot, TrajectoryPoint, segment
from hpid_ros.robot.differential_drive import PlanarPose

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_FINE = np.linspace(0.0, 1.0, 257)  # of a curve, to count its windings


class LegMotion(NamedTuple):
    """A leg at N instants."""

    distance: Numbers  # [m] travelled since the leg's start, forward positive, (N,)
    speed: Numbers  # [m/s] its rate
    acceleration: Numbers  # [m/s^2] its second rate
    turn: Numbers  # [rad] change of the heading since the leg's start, (N,)
    turn_rate: Numbers  # [rad/s]
    turn_acceleration: Numbers  # [rad/s^2]


@dataclass(frozen=True)
class TimeLaw:
    """How far along a leg is at which time: a quintic without acceleration at both ends."""

    duration: float  # [s] of the leg
    # rate at the start in shares of the leg per duration, in [0, 2]: then it never goes back
    first: float = 0.0
    last: float = 0.0  # rate at the end

    def at(self, shares: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        """Return the share of the leg, its rate in [1/s] and its second rate in [1/s^2]."""
        a, b, t = self.first, self.last, shares
        c3, c4, c5 = 10.0 - 6.0 * a - 4.0 * b, -15.0 + 8.0 * a + 7.0 * b, 6.0 - 3.0 * (a + b)
        u = t * (a + t * t * (c3 + t * (c4 + t * c5)))
        du = a + t * t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5))
        ddu = t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5))
        return u, du / self.duration, ddu / self.duration**2


@dataclass(frozen=True)
class Turn:
    """A turn in place; by 0 it is a wait."""

    pose: PlanarPose  # where it begins
    angle: float  # [rad] by how much
    law: TimeLaw  # when

    def motion(self, shares: Numbers) -> LegMotion:
        u, du, ddu = self.law.at(shares)
        still = np.zeros_like(shares)
        return LegMotion(still, still, still, self.angle * u, self.angle * du, self.angle * ddu)

    def places(self, shares: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        here = np.ones_like(shares)
        return self.pose.x * here, self.pose.y * here, self.angle * self.law.at(shares)[0]

    def curvature(self, shares: Numbers) -> Numbers:
        """Return 0: nothing is driven."""
        return np.zeros_like(shares)


class DrivenLeg:
    """A drive along a Bezier curve whose end tangents are the headings.

    With ``order`` 3 it is a quintic without second derivatives at its ends; with 4 a septic,
    whose third derivatives vanish there too: the curvature begins and ends at 0 and has no kink
    where two such curves meet, so that a base can pass without a jump of its acceleration.
    Between two poses on one line it is that line.
    """

    def __init__(
        self, start: PlanarPose, end: PlanarPose, law: TimeLaw, sign: int = 1, order: int = 3
    ) -> None:
        self._law, self._sign = law, sign
        chord = math.hypot(end.x - start.x, end.y - start.y)
        points = np.empty((2 * order, 2))
        stride = sign * chord / (2 * order - 1)
        for k in range(order):
            for row, pose, ahead in ((k, start, k), (-1 - k, end, -k)):
                points[row] = (
                    pose.x + ahead * stride * math.cos(pose.heading),
                    pose.y + ahead * stride * math.sin(pose.heading),
                )
        curves = [np.poly1d(_power_basis(points[:, axis])) for axis in (0, 1)]
        self._derivatives = [[curve.deriv(k) for curve in curves] for k in range(4)]
        tangents = self._value(1, _FINE)
        self._windings = np.concatenate(([0.0], np.cumsum(_angles(tangents[:-1], tangents[1:]))))
        self._first = tangents[0]

    def motion(self, shares: Numbers) -> LegMotion:
        """Return the motion at ascending shares of the leg's time, the first one 0, (N,)."""
        u, du, ddu = self._law.at(shares)
        tangent, bend, jerk = (self._value(order, u) for order in (1, 2, 3))
        length = np.hypot(*tangent.T)
        along, across = (tangent * bend).sum(axis=1), _cross(tangent, bend)
        stretch = along / length
        winding = across / length**2
        unwinding = (_cross(tangent, jerk) - 2.0 * across * along / length**2) / length**2
        sign = self._sign
        return LegMotion(
            sign * self._lengths(u),
            sign * length * du,
            sign * (stretch * du**2 + length * ddu),
            self._turns(u, tangent),
            winding * du,
            unwinding * du**2 + winding * ddu,
        )

    def places(self, shares: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        """Return x, y in [m] and the turn since the start in [rad] at any shares, (N,) each."""
        u = self._law.at(shares)[0]
        x, y = self._value(0, u).T
        return x, y, self._turns(u, self._value(1, u))

    def curvature(self, shares: Numbers) -> Numbers:
        """Return the path's curvature in [1/m]; infinite where the curve turns back."""
        u = self._law.at(shares)[0]
        tangent, bend = self._value(1, u), self._value(2, u)
        with np.errstate(divide="ignore", invalid="ignore"):
            curvature = _cross(tangent, bend) / np.hypot(*tangent.T) ** 3
        return np.where(np.isfinite(curvature), curvature, np.inf)

    def _value(self, order: int, u: Numbers) -> Numbers:
        """Return a derivative of the curve, (..., 2)."""
        return np.stack([each(u) for each in self._derivatives[order]], axis=-1)

    def _lengths(self, u: Numbers) -> Numbers:
        """Return the arc length from the first of ascending places, by Gauss and Legendre."""
        half = 0.5 * np.diff(u)[:, None]
        at = u[:-1, None] + half * (1.0 + _NODES)
        tangent = self._value(1, at)
        pieces = (np.hypot(tangent[..., 0], tangent[..., 1]) * _WEIGHTS * half).sum(axis=1)
        return np.concatenate(([0.0], np.cumsum(pieces)))

    def _turns(self, u: Numbers, tangent: Numbers) -> Numbers:
        """Return the heading's change since the start, with its windings."""
        raw = _angles(np.broadcast_to(self._first, tangent.shape), tangent)
        near = np.interp(u, _FINE, self._windings)
        turns: Numbers = raw + 2.0 * np.pi * np.round((near - raw) / (2.0 * np.pi))
        return turns


Leg = Turn | DrivenLeg
"""What a path is made of."""


def _power_basis(points: Numbers) -> Numbers:
    """Return the coefficients of a Bezier curve, highest power first.

    Relative to the first point, so that a curve far from the origin loses no digits.
    """
    degree = len(points) - 1
    shifted = points - points[0]
    coefficients = np.zeros(degree + 1)
    for k in range(degree + 1):
        differences = sum((-1) ** (k - j) * math.comb(k, j) * shifted[j] for j in range(k + 1))
        coefficients[degree - k] = math.comb(degree, k) * differences
    coefficients[-1] += points[0]
    return coefficients


def _cross(a: Numbers, b: Numbers) -> Numbers:
    product: Numbers = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def _angles(a: Numbers, b: Numbers) -> Numbers:
    """Return the angles from vectors to vectors, in [rad], within half a turn."""
    angles: Numbers = np.arctan2(_cross(a, b), (a * b).sum(axis=-1))
    return angles


_TOLERANCE = 1e-8  # [rad], of a wheel's spline against the path
_FEWEST, _MOST = 8, 1024  # pieces of one leg


def leg_knots(
    leg: Leg,
    begin_ns: int,
    end_ns: int,
    start: tuple[Knot, Knot],
    radius: float,
    separation: float,
) -> list[tuple[Knot, Knot]]:
    """Return the wheels' knots after a leg's start, as many as their splines need."""
    pieces = _FEWEST
    while True:
        times = [
            begin_ns + round(k * (end_ns - begin_ns) / (2 * pieces)) for k in range(2 * pieces + 1)
        ]
        shares = (np.array(times) - begin_ns) / (end_ns - begin_ns)
        motion = leg.motion(shares)
        wheels = []
        for before, side in zip(start, (-0.5, 0.5), strict=True):
            rows = [
                (along + side * separation * about) / radius
                for along, about in zip(motion[:3], motion[3:], strict=True)
            ]
            rows[0] += before.position
            wheels.append(
                [Knot(*row) for row in zip(times, *(each.tolist() for each in rows), strict=True)]
            )
        if pieces == _MOST or all(_is_close(knots) for knots in wheels):
            return list(zip(*(knots[2::2] for knots in wheels), strict=True))
        pieces *= 2


def _is_close(knots: Sequence[Knot]) -> bool:
    """Return whether splines through every other knot meet those in between."""
    for left, middle, right in zip(knots[:-2:2], knots[1::2], knots[2::2], strict=True):
        t = (middle.time_ns - left.time_ns) * SECONDS_PER_NANOSECOND
        position = 0.0
        for coefficient in reversed(segment(left, right)):
            position = position * t + coefficient
        if abs(position - middle.position) > _TOLERANCE:
            return False
    return True


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
        first = Knot(self._times_ns[0], 0.0, 0.0, 0.0)
        knots = [(first, first)]
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


def _checked_pose(index: int, pose: Sequence[float]) -> PlanarPose:
    values = tuple(float(value) for value in pose)
    if len(values) != 3 or not all(math.isfinite(value) and abs(value) < 1e6 for value in values):
        raise TrajectoryError(
            f"pose {index} of a path must be x [m], y [m] and heading [rad], not {list(pose)}"
        )
    return PlanarPose(*values)

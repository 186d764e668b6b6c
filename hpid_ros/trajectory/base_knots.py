"""One leg of a base's path as knots of two wheels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hpid_ros.trajectory.base_legs import Leg
from hpid_ros.trajectory.spline import SECONDS_PER_NANOSECOND, Knot, segment

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
    """Return the wheels' knots after a leg's start, as many as their splines need.

    Args:
        leg: The leg.
        begin_ns: When it begins, in [ns].
        end_ns: When it ends, in [ns].
        start: Knots of the left and of the right wheel at the leg's start.
        radius: Of the wheels, in [m].
        separation: Of the wheels, in [m].

    Returns:
        Pairs of a left and a right knot, the last ones at the leg's end.
    """
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
    """Tell whether splines through every other knot meet those in between."""
    for left, middle, right in zip(knots[:-2:2], knots[1::2], knots[2::2], strict=True):
        t = (middle.time_ns - left.time_ns) * SECONDS_PER_NANOSECOND
        position = 0.0
        for coefficient in reversed(segment(left, right)):
            position = position * t + coefficient
        if abs(position - middle.position) > _TOLERANCE:
            return False
    return True

"""The largest degree for the gains of a PID within what is certified and what sampling bears."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from hpid_ros.base.errors import NormError
from hpid_ros.control.norms import GOOD_SAMPLING_MARGIN
from hpid_ros.control.settings import LoopSettings
from hpid_ros.stability.gain_check import sampling_margin

_SHARE_OF_INTERVAL = 0.8
_STEP = 0.01
_STEPS = 49  # mu lies strictly inside (-0.5, 0.5)
_ROUNDING = 1e-9  # the floor is chosen for this very margin
_SLOWEST, _FASTEST = 0.5, 2.0  # multipliers of the bandwidth at the floor of the norm


class DegreeFound(NamedTuple):
    """The loop with the degree that was found."""

    settings: LoopSettings  # of degree 0 where no other one qualifies
    limit: str  # why its degree is not larger


def largest_degree(
    linear: LoopSettings, sign: float, interval: tuple[float, float], least_inertia: float
) -> DegreeFound:
    """Return the homogeneous loop of the largest degree of a sign that qualifies.

    The degree lies in the inner four fifths of the certified ``interval``, keeps the bandwidth at
    the floor of the norm within half and twice the PID's, and keeps T kd lam / m within what
    sampling bears, with ``least_inertia`` [kg m^2] for m.
    """
    best = linear
    for step in range(1, _STEPS + 1):
        degree = round(sign * step * _STEP, 6)
        try:
            candidate = replace(linear, mu=degree)
            objection = _objection(candidate, interval, least_inertia)
        except NormError as error:  # its floor has no room below the cap
            objection = f"is refused: {error}"
        if objection:
            which = "no other degree than 0 qualifies" if best is linear else "the next one"
            return DegreeFound(best, f"{which}: {degree:+.2f} {objection}")
        best = candidate
    return DegreeFound(best, "the largest degree that is tried")


def _objection(settings: LoopSettings, interval: tuple[float, float], inertia: float) -> str:
    """Say what speaks against a degree; nothing if it qualifies."""
    lower, upper = (_SHARE_OF_INTERVAL * end for end in interval)
    if not lower <= settings.mu <= upper:
        return "leaves the inner four fifths of the certified interval"
    floor = settings.norm_floor
    multiplier = floor**settings.mu if floor else math.inf if settings.mu < 0.0 else 0.0
    if not _SLOWEST <= multiplier <= _FASTEST:
        return f"multiplies the bandwidth by {multiplier:.2f} at the norm's floor"
    margin = sampling_margin(
        settings.gains, settings.timing.control_period, max(multiplier, 1.0), inertia
    )
    if margin > GOOD_SAMPLING_MARGIN * (1.0 + _ROUNDING) and settings.mu < 0.0:
        return f"brings T kd lam / m to {margin:.2f}, above {GOOD_SAMPLING_MARGIN}"
    return ""

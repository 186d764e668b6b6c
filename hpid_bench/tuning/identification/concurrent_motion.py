"""Which joints of a recording moved while another one did, or rested."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hpid_bench.tuning.identification.joint_record import JointRecord, Span
from hpid_ros.base.units import Numbers

_INTERVAL = 1.0  # [s] in which a joint moves, or does not
_LEAST_MOTION = 0.1  # of a joint's travel: less within an interval is no motion
_NOISE_DEVIATIONS = 10.0  # of a position's noise: less is no motion either
_THIRD_DIFFERENCE = 20.0  # of white noise, over the variance of the noise itself
_LEAST_POSITIONS = 5  # that tell a noise
_LEAST_OVERLAP = 0.1  # of the intervals in which a joint moves
_MOST_NAMES = 3  # in a remark


def remark_on_concurrent_motion(own: JointRecord, records: Sequence[JointRecord]) -> str:
    """Say who moves while a joint does, where nothing is known of how they are coupled."""
    begins = _intervals(own)
    is_moving = _is_moving(own, begins, own.travel)
    if not is_moving.any():
        return ""
    names = [
        each.joint
        for each in records
        if each is not own
        and np.mean(_is_moving(each, begins, own.travel)[is_moving]) > _LEAST_OVERLAP
    ]
    if not names:
        return ""
    others = len(names) - _MOST_NAMES
    listed = ", ".join(names[:_MOST_NAMES]) + (f" and {others} more" if others > 0 else "")
    return (
        f"{listed} moved at the same time: what they need and what couples them is in these "
        "numbers, for whose intervals nothing stands; give the robot, or move one joint at a time"
    )


def spans_of_others(own: JointRecord, records: Sequence[JointRecord]) -> list[Span]:
    """Return when others move and a joint does not, which tells of it no more than their pull."""
    begins = _intervals(own)
    is_theirs = np.zeros(len(begins), dtype=np.bool_)
    for each in records:
        is_theirs |= _is_moving(each, begins, each.travel)
    is_theirs &= ~_is_moving(own, begins, own.travel)
    return [Span(float(begin), float(begin) + _INTERVAL) for begin in begins[is_theirs]]


def _intervals(record: JointRecord) -> Numbers:
    """Return when the intervals begin in which a joint has samples, in [s].

    If a clock was set there may be years without any.
    """
    first = record.time[:1]
    numbers = np.unique(np.floor((record.time - first) / _INTERVAL))
    return np.asarray(first + _INTERVAL * numbers)


def _is_moving(record: JointRecord, begins: Numbers, travel: float) -> NDArray[np.bool_]:
    """Return for each interval whether a joint moves by a part of a travel."""
    first = np.searchsorted(record.time, begins)
    last = np.searchsorted(record.time, begins + _INTERVAL)
    positions = [record.position[a:b] for a, b in zip(first, last, strict=True)]
    moved = np.array([float(np.ptp(each)) if len(each) else 0.0 for each in positions])
    noise = _noise(record.position)
    return np.asarray(moved > max(_LEAST_MOTION * travel, _NOISE_DEVIATIONS * noise))


def _noise(position: Numbers) -> float:
    """Return the standard deviation of what third differences say is noise; steps count, too."""
    if len(position) < _LEAST_POSITIONS:
        return 0.0
    return math.sqrt(float(np.var(np.diff(position, 3))) / _THIRD_DIFFERENCE)

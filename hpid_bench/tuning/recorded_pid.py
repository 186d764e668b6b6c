"""What a recorded PID did: its reference, its first integral, how late its efforts are stamped."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.series import JointSeries
from hpid_ros.motion.joint_trajectory import Column, Knot

_JUMP = 10.0  # times as far as from one sample to the next before and after
_LEAST_JUMP = 1e-6  # [rad]
_BEYOND_NS = 1_000_000
_BEGINNING = 0.05  # [s] of a recording that tell the integral with which it begins
_AS_GOOD = 1e-3  # of the effort's standard deviation
_MOST_STATES = 20_000  # that are answered again to see how late efforts were stamped
_LATEST = 0.1  # [s]
_ALIKE = 0.3  # of the effort's standard deviation, by which answers may differ from it
_BETTER = 0.7  # of what differs without any lateness


def recorded_motion(joint: str, times_ns: NDArray[np.int64], reference: Numbers) -> Column:
    """Return what goes through the samples of a reference, smooth but where it jumps.

    A jump is one nanosecond wide, as those of :func:`~hpid_ros.motion.generators.step` are: a
    ramp from one sample to the next would have a velocity that nobody was asked to follow.
    """
    steps = np.abs(np.diff(reference))
    near = np.maximum(np.append(steps[1:], 0.0), np.append(0.0, steps[:-1]))
    jumps = np.flatnonzero(steps > np.maximum(_JUMP * near, _LEAST_JUMP)) + 1
    knots: list[Knot] = []
    for times, values in zip(np.split(times_ns, jumps), np.split(reference, jumps), strict=True):
        if knots:
            knots.append(_going_on(knots[-1], int(times[0]) - 1))
        rates = _rates(times / NANOSECONDS, values)
        knots += map(Knot, times.tolist(), values.tolist(), rates.tolist())
    # What was recorded may end while it moves.
    return Column(joint, (*knots, _going_on(knots[-1], knots[-1].time_ns + _BEYOND_NS)))


def _going_on(knot: Knot, time_ns: int) -> Knot:
    """Return where a reference is at a later time if its velocity stays what it is."""
    way = (knot.velocity or 0.0) * (time_ns - knot.time_ns) / NANOSECONDS
    return Knot(time_ns, knot.position + way, knot.velocity)


def _rates(times: Numbers, values: Numbers) -> Numbers:
    if len(values) < 2:
        return np.zeros(len(values))
    order: Literal[1, 2] = 2 if len(values) > 2 else 1
    return np.asarray(np.gradient(values, times, edge_order=order))


class RecordedAnswers(NamedTuple):
    """What answering the recorded states once more tells of a PID."""

    integral: float = 0.0  # [N m] with which the recording begins: the load, if it ran before
    late: float = 0.0  # [s] how long after the states that they answer efforts are stamped


def recorded_answers(
    settings: LoopSettings, series: JointSeries, velocities: Mapping[int, float]
) -> RecordedAnswers:
    """Return what a recorded PID began with, and how late its efforts are stamped.

    The PID answers the recorded states once more, from an integral of 0; its efforts are laid
    over the recorded ones. Where they are not alike it was not this PID, or not these positions:
    then nothing is late. Nobody knows what a model added.
    """
    if not (series.has_effort and series.has_reference) or settings.model.is_on:
        return RecordedAnswers()
    stamps = series.state_stamps_ns[:_MOST_STATES]
    loop, begin = JointLoop(settings), int(stamps[0])
    loop.follow(recorded_motion(settings.joint, stamps - begin, series.reference[: len(stamps)]))
    answers = np.array(
        [
            loop.step(stamp, position, velocities.get(stamp))
            for stamp, position in zip(stamps.tolist(), series.position.tolist(), strict=False)
        ]
    )

    def rest(late: int) -> Numbers:
        """Return what recorded efforts are besides the answers, if they are stamped so late."""
        places = np.searchsorted(series.command_stamps_ns, stamps + late, "right") - 1
        is_known = (places >= 0) & (stamps + late <= series.command_stamps_ns[-1])
        return np.asarray(series.effort[places[is_known]] - answers[is_known])

    step_ns = max(int(np.median(np.diff(stamps))) // 2, 1) if len(stamps) > 1 else 1
    off: dict[int, float] = {}
    for late in range(0, round(_LATEST * NANOSECONDS) + 1, step_ns):
        left = rest(late)
        if len(left) > len(stamps) // 2:
            off[late] = float(np.std(left))
    if not off:
        return RecordedAnswers()
    least = min(off.values())
    size = float(np.std(series.effort))
    best = next(late for late, each in off.items() if each <= least + _AS_GOOD * size)
    is_alike = least < _ALIKE * size
    if not is_alike or least > _BETTER * off[0]:
        best = 0
    first = rest(best)[: max(round(_BEGINNING * NANOSECONDS / (2 * step_ns)), 1)]
    integral = 0.0
    if settings.gains.i > 0.0:
        least, most = settings.integral.i_clamp_min, settings.integral.i_clamp_max
        integral = min(max(float(np.median(first)), least), most)
    return RecordedAnswers(integral, best * SECONDS_PER_NANOSECOND)

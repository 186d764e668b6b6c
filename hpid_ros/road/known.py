"""The robot as a recording has it: to be simulated, and to be certified for."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.identification.results import (
    COULOMB,
    DELAY,
    INERTIA,
    OFFSET,
    STRIBECK,
    VISCOUS,
    Estimate,
    JointIdentification,
)
from hpid_ros.recordings.series import JointSeries
from hpid_ros.robot.amendments import JointAmendment, amended
from hpid_ros.robot.given import GivenRobot
from hpid_ros.simulation.drives import LONGEST_DELAY
from hpid_ros.tuning.prediction import PHYSICS_STEPS, JointFacts
from hpid_ros.tuning.upgrade import position_resolution

_WINDOW = 200  # samples
_THIRD_DIFFERENCE = 20.0  # of white noise, over the variance of the noise itself: 1 + 9 + 9 + 1
_BELOW_A_COUNT = 0.2  # of a count: less noise than that cannot be told from rounding
_MUCH = 0.05  # of the largest effort: a constant load that is worth a word


@dataclass(frozen=True)
class KnownRobot:
    """A robot with what a recording tells of it."""

    robot: GivenRobot  # with the rotors and the friction that were found
    facts: Mapping[str, JointFacts]  # delays and noise, by joint
    assumptions: Mapping[str, Sequence[str]]  # what had to be assumed, by joint, a line each


def known_robot(
    robot: GivenRobot,
    found: Sequence[JointIdentification],
    recorded: Sequence[JointSeries],
) -> KnownRobot:
    """Return a robot with what was found of its joints.

    Estimates that the data do not tell are taken, too, where they can be true at all: together
    with the others they explain the recording, whichever share each of them has.
    """
    series = {each.joint: each for each in recorded}
    amendments = {
        each.joint: _amendment(each, robot.description.joints[each.joint].effort)
        for each in found
        if each.is_found
    }
    facts = {}
    for each in found:
        own = series[each.joint]
        resolution = position_resolution(own)
        noise = position_noise(own, resolution)
        facts[each.joint] = JointFacts(_delay(each, median_period(own)), noise, resolution)
    description = amended(robot.description, amendments, {}, {})
    return KnownRobot(
        replace(robot, source=description.xml, description=description),
        facts,
        {each.joint: tuple(_assumptions(each, series[each.joint])) for each in found},
    )


def position_noise(series: JointSeries, resolution: float) -> float:
    """Return the standard deviation of a position's noise before it is rounded, in [rad].

    From third differences, in which smooth motion leaves no trace; the median over windows, so
    that jumps and gaps do not count.
    """
    differences = np.diff(series.position, 3)
    windows = max(1, len(differences) // _WINDOW)
    if len(differences) < 2:
        return 0.0
    each = [float(np.var(window)) for window in np.array_split(differences, windows)]
    whole = float(np.median(each)) / _THIRD_DIFFERENCE
    noise = math.sqrt(max(0.0, whole - resolution**2 / 12.0))
    return 0.0 if noise < _BELOW_A_COUNT * resolution else noise


def median_period(series: JointSeries) -> float:
    return float(np.median(np.diff(series.state_stamps_ns))) * SECONDS_PER_NANOSECOND


def _amendment(found: JointIdentification, limit: float) -> JointAmendment:
    """Return a joint's rotor, friction and limit; what is not known stays as the robot has it."""
    rotor = _possible(found.estimates.get(INERTIA))
    return JointAmendment(
        rotor_inertia=rotor,
        gear_ratio=None if rotor is None else 1.0,
        damping=_possible(found.estimates.get(VISCOUS)),
        friction=_possible(found.estimates.get(COULOMB)),
        effort=found.effort_limit if found.effort_limit < (limit or math.inf) else None,
    )


def _possible(estimate: Estimate | None) -> float | None:
    """Return a number that is not negative; None where there is none."""
    if estimate is None or not math.isfinite(estimate.value):
        return None
    return max(estimate.value, 0.0)


def _delay(found: JointIdentification, period: float) -> int:
    """Return the delay in control periods.

    A simulated position is half a physics step ahead of time, by semi-implicit integration.
    """
    estimate = found.estimates.get(DELAY)
    if estimate is None or period <= 0.0:
        return 0
    periods = estimate.value / period + 0.5 / PHYSICS_STEPS
    return min(max(round(periods), 0), LONGEST_DELAY)


_WORDS = {INERTIA: "rotor", VISCOUS: "viscous friction", COULOMB: "Coulomb friction"}


def _assumptions(found: JointIdentification, series: JointSeries) -> Iterator[str]:
    if not found.is_found:
        reason = found.untold.get(found.joint, "nothing was found")
        yield f"its rotor and friction are those of the robot's description: {reason}"
        return
    for name, words in _WORDS.items():
        estimate = found.estimates.get(name)
        if estimate is None:
            yield f"{words}: as the robot's description says"
        elif not estimate.is_told:
            yield f"{words} {max(estimate.value, 0.0):.3g} is a guess: {estimate.reason}"
    offset, largest = found.told(OFFSET), float(np.max(np.abs(series.effort), initial=0.0))
    if offset is not None and abs(offset.value) > _MUCH * largest:
        load = f"a constant load of {offset.value:.3g} N m"
        yield f"{load} is not simulated: the integral carries it"
    if found.effort_limit < math.inf:
        yield f"its drive gives at most {found.effort_limit:.3g} N m, whatever is commanded"
    if found.told(STRIBECK) is not None:
        yield "friction that grows when creeping (Stribeck) is not simulated"
    yield from found.remarks

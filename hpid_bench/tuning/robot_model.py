"""The robot that is simulated: its description, and what a recording told of its joints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from hpid_bench.tuning.driver_velocity import DriverVelocity, driver_velocity
from hpid_bench.tuning.identification.joint_identification import JointIdentification
from hpid_bench.tuning.identification.regression import (
    COULOMB,
    DELAY,
    INERTIA,
    OFFSET,
    STRIBECK,
    VISCOUS,
    Estimate,
)
from hpid_bench.tuning.loop_simulation import PHYSICS_STEPS, DriveFacts
from hpid_bench.tuning.loop_statistics import median_period, position_noise, position_resolution
from hpid_bench.tuning.recorded_pid import RecordedAnswers
from hpid_ros.messages.series import JointSeries
from hpid_ros.robot.amendments import JointAmendment, amended
from hpid_ros.robot.description import GivenRobot
from hpid_ros.simulation.drives import LONGEST_DELAY

_ROUNDED = math.sqrt(12.0)  # a step over the standard deviation of what rounding to it adds
_AS_DIFFERENCES = (
    "how the velocity that is reported comes about cannot be told: it is simulated as the "
    "differences of the positions"
)
_MUCH = 0.05  # of the largest effort: a constant load that is worth a word


@dataclass(frozen=True)
class RobotModel:
    """A robot with what was identified of it."""

    robot: GivenRobot  # with the rotors and the friction that were found
    facts: Mapping[str, DriveFacts]  # delays and noise, by joint
    assumptions: Mapping[str, Sequence[str]]  # what had to be assumed, by joint, a line each

    def with_facts(self, facts: Mapping[str, DriveFacts]) -> RobotModel:
        """Return the model with other facts of some joints."""
        return replace(self, facts={**self.facts, **facts})


def robot_model(
    robot: GivenRobot,
    found: Sequence[JointIdentification],
    recorded: Sequence[JointSeries],
    velocities: Mapping[str, Mapping[int, float]] = MappingProxyType({}),
    answers: Mapping[str, RecordedAnswers] = MappingProxyType({}),
) -> RobotModel:
    """Return a robot with what was found of its joints, and of their controllers.

    ``velocities`` [rad/s] are those that are reported, by joint and stamp.

    Unreliable estimates are taken, too, where they can be true at all: together
    with the others they explain the recording, whichever share each of them has.
    """
    series = {each.joint: each for each in recorded}
    amendments = {
        each.joint: _amendment(each, robot.description.joints[each.joint].effort)
        for each in found
        if each.is_found
    }
    facts: dict[str, DriveFacts] = {}
    assumptions: dict[str, Sequence[str]] = {}
    for each in found:
        own = series[each.joint]
        resolution = position_resolution(own)
        noise = position_noise(own, resolution)
        integral, late = answers.get(each.joint, RecordedAnswers())
        known = DriveFacts(
            _delay(each, median_period(own), late), noise, resolution, integral=integral
        )
        lines = [*_assumptions(each, own, late)]
        if reported := velocities.get(each.joint):
            driver = reported_velocity(own, reported, math.hypot(noise, resolution / _ROUNDED))
            if driver is None:
                lines.append(_AS_DIFFERENCES)
            else:
                known = known._replace(velocity=driver.filter)
                lines.append(f"the velocity that is reported: {driver.words}")
        facts[each.joint] = known
        assumptions[each.joint] = lines
    description = amended(robot.description, amendments, {}, {})
    known_robot = replace(robot, source=description.xml, description=description)
    return RobotModel(known_robot, facts, assumptions)


def reported_velocity(
    series: JointSeries, velocities: Mapping[int, float], noise: float
) -> DriverVelocity | None:
    """Return how a driver makes the velocities of a joint; None where nothing can be said."""
    stamps = series.state_stamps_ns.tolist()
    has_one = np.array([stamp in velocities for stamp in stamps])
    told = np.array([velocities[stamp] for stamp in stamps if stamp in velocities])
    return driver_velocity(series.time[has_one], series.position[has_one], told, noise)


def _amendment(found: JointIdentification, limit: float) -> JointAmendment:
    rotor = _possible(found.estimates.get(INERTIA))
    return JointAmendment(
        rotor_inertia=rotor,
        gear_ratio=None if rotor is None else 1.0,
        damping=_possible(found.estimates.get(VISCOUS)),
        friction=_possible(found.estimates.get(COULOMB)),
        effort=found.effort_limit if found.effort_limit < limit else None,
    )


def _possible(estimate: Estimate | None) -> float | None:
    """Return a number that is not negative; None where there is none."""
    if estimate is None or not math.isfinite(estimate.value):
        return None
    return max(estimate.value, 0.0)


def _delay(found: JointIdentification, period: float, late: float) -> int:
    """Return the delay from a state to what answers it, in control periods.

    A simulated position is half a physics step ahead of time, by semi-implicit integration.
    """
    estimate = found.estimates.get(DELAY)
    if estimate is None or period <= 0.0:
        return 0
    periods = (estimate.value + late) / period + 0.5 / PHYSICS_STEPS
    return min(max(round(periods), 0), LONGEST_DELAY)


_WORDS = {INERTIA: "rotor", VISCOUS: "viscous friction", COULOMB: "Coulomb friction"}


def _assumptions(found: JointIdentification, series: JointSeries, late: float) -> Iterator[str]:
    if not found.is_found:
        reason = found.unreliable.get(found.joint, "nothing was found")
        yield f"its rotor and friction are those of the robot's description: {reason}"
        return
    for name, words in _WORDS.items():
        estimate = found.estimates.get(name)
        if estimate is None:
            yield f"{words}: as the robot's description says"
        elif not estimate.is_reliable:
            yield f"{words} {max(estimate.value, 0.0):.3g} is a guess: {estimate.reason}"
    if late:
        yield (
            f"its efforts are stamped {late * 1e3:.3g} ms after the states that they answer, "
            "as the PID answers them: what acts is that much later than the delay"
        )
    elif (delay := found.estimates.get(DELAY)) is not None and delay.high < 0.0 and delay.reason:
        yield f"the delay is a guess, none: {delay.reason}"
    offset, largest = found.reliable(OFFSET), float(np.max(np.abs(series.effort), initial=0.0))
    if offset is not None and abs(offset.value) > _MUCH * largest:
        load = f"a constant load of {offset.value:.3g} N m"
        yield f"{load} is not simulated: the integral carries it"
    if found.effort_limit < math.inf:
        yield f"its drive gives at most {found.effort_limit:.3g} N m, whatever is commanded"
    if found.reliable(STRIBECK) is not None:
        yield "friction that grows when creeping (Stribeck) is not simulated"
    yield from found.remarks

"""What is known of a joint that was identified: estimates, their intervals, and their doubts.

From the solution of a joint's equation to numbers that can be relied on, or a reason why not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_bench.tuning.identification.joint_record import JointRecord
from hpid_bench.tuning.identification.regression import (
    COULOMB,
    DELAY,
    EFFORT_SCALE,
    ESTIMATED_PARAMETERS,
    GRAVITY_COS,
    GRAVITY_SIN,
    INERTIA,
    OFFSET,
    SPIN,
    SPRING,
    STRIBECK,
    VISCOUS,
    Equation,
    Estimate,
    Solution,
)
from hpid_ros.base.units import Numbers


class Fit(NamedTuple):
    """How a joint's efforts are explained, row by row; NaN between spans."""

    time: Numbers  # [s] (R,)
    measured: Numbers  # [N m] effort at the joint's motion, smoothed and freed of the delay, (R,)
    predicted: Numbers  # [N m] what the estimates say of it, (R,)
    # whether the row counted; where the direction is in doubt it does not, (R,)
    is_used: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class JointIdentification:
    """What was found of one joint."""

    joint: str  # its name
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    unreliable: Mapping[str, str] = field(default_factory=dict)  # reasons, by parameter or joint
    remarks: tuple[str, ...] = ()  # what to know of all the numbers
    method: str = ""  # how, in a few words
    why: str = ""  # the reason for the method, in a few words
    cutoff: float = 0.0  # [Hz] of the low pass
    rows: int = 0  # rows that counted
    time: float = 0.0  # [s] time that they stand for
    stribeck_speed: float = 0.0  # [rad/s] speed at which Stribeck friction has fallen to 1/e
    residual: float = 0.0  # [N m] root mean square of what is not explained
    explained: float = 0.0  # share of the effort's variance that is explained
    condition: float = 0.0  # condition number of the scaled regressors
    travel: float = 0.0  # [rad] how far the joint moved between its ends
    speed: float = 0.0  # [rad/s] largest speed
    acceleration: float = 0.0  # [rad/s^2] largest acceleration
    effort_limit: float = math.inf  # [N m] largest that the drive gives; inf if not seen
    is_rigid: bool = True  # whether nothing shows that the joint gives
    fit: Fit | None = None  # to draw

    @property
    def is_found(self) -> bool:
        return bool(self.estimates)

    def reliable(self, name: str) -> Estimate | None:
        """Return an estimate that can be relied on; None if there is none."""
        found = self.estimates.get(name)
        return found if found is not None and found.is_reliable else None


def not_identified(record: JointRecord, reason: str) -> JointIdentification:
    """Return that nothing could be found of a joint."""
    unreliable = {record.joint: reason}
    return JointIdentification(record.joint, unreliable=unreliable, travel=record.travel)


# Shares of the effort's variance that the model explains (the coefficient of determination).
_LEAST_EXPLAINED = 0.5  # below, the efforts are not those of this motion
_WELL_EXPLAINED = 0.9  # below, the residual is what the model lacks rather than noise

_LEAST_EFFECT = 0.01  # of the effort's standard deviation: what changes it less is not felt
_COLLINEAR = 100.0  # variance inflation of a regressor that others nearly replace
_SAMPLING_PERIODS = 1.0  # by which sampling alone may have an effort ahead of its cause
_USEFUL_SCALE = 0.2  # half-width over value; an effort scale that is known worse is of no use
_OTHER_UNIT = 0.05  # by which the effort's scale differs from 1 before the unit is doubted
_TINY = 1e-300  # instead of zero, where something is divided by it

_REVERSED = (
    "the effort's scale is negative, what was recorded pushes against the motion that it causes: "
    "motor, encoder or recording has the other sign; under a controller the joint would run away"
)
_NOT_IN_N_M = (
    "it is not 1: the masses differ from the URDF's, a load is carried, or the efforts have "
    "another unit (--effort-unit any)"
)
_ON_DOUBTED_SCALE = (
    "it stands on the efforts' scale, which is doubted; --effort-unit any takes the scale as found"
)
_INSTRUMENTS = {True: "answer to the reference", False: "samples between"}
_REGRESSOR_NAMES = {
    INERTIA: "inertia",
    VISCOUS: "viscous friction",
    COULOMB: "Coulomb friction",
    STRIBECK: "Stribeck friction",
    GRAVITY_SIN: "gravity",
    GRAVITY_COS: "gravity",
    OFFSET: "a constant load",
    EFFORT_SCALE: "the effort's scale",
    DELAY: "the delay",
    SPIN: "the rotors' spin",
    SPRING: "a spring",
}
# The motion that tells a parameter.
_EXCITATION = {
    INERTIA: "reverse faster: a sine of 1 to 3 Hz, or a multisine",
    VISCOUS: "move at several speeds up to the joint's limit, also for long",
    COULOMB: "move both ways, well above creeping, with a few reversals a second",
    STRIBECK: "creep, both ways",
    GRAVITY_SIN: "move through a larger angle, more than a radian",
    GRAVITY_COS: "move through a larger angle, more than a radian",
    OFFSET: "move both ways",
    EFFORT_SCALE: "move links with mass, through poses with different gravity",
    DELAY: "reverse faster: a sine of 1 to 3 Hz, or a multisine",
}
_LINKS_NOT_FELT = f"the links are hardly felt: {_EXCITATION[EFFORT_SCALE]}"


def joint_identification(
    equation: Equation, solution: Solution, not_rigid: str = ""
) -> JointIdentification:
    """Return what the solution of an equation says of its joint.

    ``not_rigid`` is why the joint is not one rigid mass, empty if it may be: then no estimate can
    be relied on.
    """
    joint = equation.rows.record.joint
    used = equation.weight > 0.0
    variance = max(float(np.var(equation.effort(solution.delay)[used])), _TINY)
    explained = 1.0 - solution.fit.rms**2 / variance
    identified = _without_estimates(equation, solution, explained, is_rigid=not not_rigid)
    if explained < _LEAST_EXPLAINED:
        reason = (
            f"its motion explains only {max(explained, 0.0):.0%} of its efforts: other joints "
            "move it, it touches something, or these are not its efforts"
        )
        return replace(identified, unreliable={joint: reason})
    estimates = _estimates(equation, solution)
    is_in_n_m = all(each.reason != _NOT_IN_N_M for each in estimates.values())
    if explained < _WELL_EXPLAINED and is_in_n_m and not not_rigid:
        not_rigid = (
            f"its motion explains only {explained:.0%} of its efforts: the intervals are of "
            "noise, not of what the model lacks"
        )
    if not_rigid:
        estimates = {
            name: replace(each, reason=each.reason or not_rigid)
            for name, each in estimates.items()
        }
    remarks = identified.remarks
    scale = estimates.get(EFFORT_SCALE)
    if scale is not None and scale.is_reliable and scale.high < 0.0:
        remarks = (*remarks, _REVERSED)
    unreliable = {name: each.reason for name, each in estimates.items() if each.reason}
    unreliable |= _missing_terms(equation, solution, identified.travel)
    return replace(identified, estimates=estimates, unreliable=unreliable, remarks=remarks)


def _without_estimates(
    equation: Equation, solution: Solution, explained: float, *, is_rigid: bool
) -> JointIdentification:
    """Return how a joint was identified and how it moved."""
    rows, used = equation.rows, equation.weight > 0.0
    position, velocity, acceleration = equation.halves.mean(axis=0)
    return JointIdentification(
        rows.record.joint,
        method="instrumental variables",
        why=_why(equation, solution),
        remarks=_remarks_on_spin(solution),
        is_rigid=is_rigid,
        cutoff=rows.kernel.cutoff,
        rows=equation.used_rows,
        time=equation.used_rows * float(np.median(np.diff(rows.times))),
        stribeck_speed=solution.model.stribeck_speed,
        residual=solution.fit.rms,
        explained=max(explained, 0.0),
        condition=solution.fit.condition,
        travel=float(np.ptp(position[used])),
        speed=float(np.abs(velocity[used]).max()),
        acceleration=float(np.abs(acceleration[used]).max()),
        effort_limit=equation.limit,
        fit=_fit_to_draw(equation, solution),
    )


def _why(equation: Equation, solution: Solution) -> str:
    # Either half has noise of its own, so that of their mean is half of their difference.
    accelerations = equation.halves[:, 2]
    noise = float(np.var(accelerations[0] - accelerations[1])) / 4.0
    share = noise / max(float(np.var(accelerations.mean(axis=0))), _TINY)
    used = _INSTRUMENTS[equation.uses_reference(solution.model, solution.delay)]
    return f"noise {share:.1g} of the acceleration's variance, instruments: {used}"


def _remarks_on_spin(solution: Solution) -> tuple[str, ...]:
    if not solution.model.has_spin:
        return ()
    share = f"{solution.value(SPIN):.2f} ±{solution.half_width(SPIN):.2f}"
    return (
        f"rotors spin on links that move: what they pull at this joint is {share} of what their "
        "gears' ratios say",
    )


def _fit_to_draw(equation: Equation, solution: Solution) -> Fit:
    times = equation.rows.times
    is_between_spans = times == 0.0  # no row is at the first sample
    blank = np.where(is_between_spans, np.nan, 1.0)
    return Fit(
        np.where(is_between_spans, np.nan, times),
        equation.effort(solution.delay) * blank,
        equation.predicted(solution) * blank,
        equation.weight > 0.0,
    )


def _missing_terms(equation: Equation, solution: Solution, travel: float) -> dict[str, str]:
    """Return why parameters have no estimate: their terms are not in the model."""
    missing = {}
    if not solution.model.has_coulomb:
        missing[COULOMB] = (
            "it moved in one direction only, in which friction is a constant load: "
            f"{_EXCITATION[COULOMB]}"
        )
    if equation.rigid is None and not solution.model.has_gravity:
        missing[GRAVITY_SIN] = (
            f"over {travel:.2g} rad it is no other than a constant load, or there is none: "
            f"{_EXCITATION[GRAVITY_SIN]}"
        )
    return missing


def _estimates(equation: Equation, solution: Solution) -> dict[str, Estimate]:
    """Return the estimates of all parameters, in the order of ``ESTIMATED_PARAMETERS``."""
    found = {
        name: _estimate(equation, solution, name)
        for name in solution.model.names
        if name not in (SPIN, SPRING)
    }
    if solution.model.has_scale:
        found = _in_unit_of_rigid_bodies(found)
    elif equation.rigid is not None:
        found[EFFORT_SCALE] = _separate_scale(equation, solution)
        if found[EFFORT_SCALE].reason == _NOT_IN_N_M:
            found |= {
                name: replace(each, reason=each.reason or _ON_DOUBTED_SCALE)
                for name, each in found.items()
                if name != DELAY
            }
    return {name: found[name] for name in ESTIMATED_PARAMETERS if name in found}


def _estimate(equation: Equation, solution: Solution, name: str) -> Estimate:
    value = solution.delay if name == DELAY else solution.value(name)
    half_width = solution.half_width(name)
    reason = _why_unreliable(equation, solution, name, value, half_width)
    return Estimate(value, half_width, reason)


def _separate_scale(equation: Equation, solution: Solution) -> Estimate:
    """Return the effort's scale, by a second fit that leaves it free.

    The other estimates take the efforts to be in N m; this one says whether they are.
    """
    free = equation.solve(solution.model._replace(has_scale=True), solution.delay)
    coefficient = _estimate(equation, free, EFFORT_SCALE)
    scale = _in_unit_of_rigid_bodies({EFFORT_SCALE: coefficient})[EFFORT_SCALE]
    if scale.is_reliable and (scale.low > 1.0 + _OTHER_UNIT or scale.high < 1.0 - _OTHER_UNIT):
        used = equation.weight > 0.0
        deviation = float(np.std(equation.effort(solution.delay)[used]))
        gain = solution.fit.rms**2 - free.fit.rms**2
        is_felt = gain > (_LEAST_EFFECT * deviation) ** 2
        return replace(scale, reason=_NOT_IN_N_M if is_felt else _LINKS_NOT_FELT)
    return scale


def _in_unit_of_rigid_bodies(found: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return estimates in the unit of the rigid bodies, from those in the efforts' own.

    With a free scale the equation is in the recorded unit: the coefficient of the rigid bodies'
    effort is one over the scale, and every other coefficient is to be multiplied by the scale.
    Relative half-widths of a product add as if they were independent.
    """
    coefficient = found[EFFORT_SCALE]
    scale = 1.0 / coefficient.value if coefficient.value else np.inf
    relative = coefficient.half_width * abs(scale)
    result = {}
    for name, each in found.items():
        if name == EFFORT_SCALE:
            result[name] = Estimate(scale, relative * abs(scale), each.reason)
        elif name == DELAY:
            result[name] = each
        else:
            half_width = float(np.hypot(each.half_width, each.value * relative)) * abs(scale)
            result[name] = Estimate(each.value * scale, half_width, each.reason)
    return result


def _why_unreliable(
    equation: Equation, solution: Solution, name: str, value: float, half_width: float
) -> str:
    """Return why a number should not be relied on; empty if it may."""
    if not np.isfinite(half_width):
        return f"nothing can be said of its interval: {_EXCITATION[name]}"
    if name == DELAY:
        return _why_delay_unreliable(equation, solution, value, half_width)
    if name in (OFFSET, GRAVITY_SIN, GRAVITY_COS):  # of either sign, and zero is as good
        return ""
    if name == EFFORT_SCALE:
        relative = half_width / max(abs(value), _TINY)
        if relative < _USEFUL_SCALE:
            return ""
        return f"known to {relative:.0%} only: {_EXCITATION[name]}"
    if value - half_width > 0.0:
        return ""
    is_negative = value + half_width < 0.0
    about = "its interval is below zero" if is_negative else "its interval contains zero"
    return f"{about}{_confused_with(solution, name)}: {_EXCITATION[name]}"


def _why_delay_unreliable(
    equation: Equation, solution: Solution, value: float, half_width: float
) -> str:
    if value + half_width < -_SAMPLING_PERIODS * equation.rows.record.period:
        return (
            f"{value * 1e3:.3g} ms cannot be, nothing moves before its cause: efforts are "
            "stamped late or filtered, or positions are stamped early"
        )
    if not equation.is_inside(value):
        return f"the best is at the end of what was looked through, {value * 1e3:.3g} ms"
    if half_width < equation.resolution:
        return ""
    confused = _confused_with(solution, DELAY)
    return f"known to {half_width * 1e3:.2g} ms only{confused}: {_EXCITATION[DELAY]}"


def _confused_with(solution: Solution, name: str) -> str:
    """Name the parameter with the most correlated estimate, where collinearity is what widens."""
    names, covariance = solution.model.names, solution.fit.covariance
    place = names.index(name)
    if solution.fit.variance_inflation[place] < _COLLINEAR:
        return ""
    deviations = np.maximum(solution.fit.deviations, _TINY)
    correlation = np.abs(covariance[place]) / (deviations * deviations[place])
    correlation[place] = 0.0
    other = _REGRESSOR_NAMES[names[int(np.argmax(correlation))]]
    return f", as its motion does not tell it from {other}"

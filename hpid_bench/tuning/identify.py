"""Inertia, friction, gravity, load and delay of joints from their recorded motion and efforts.

From a joint's equation to numbers: which terms the data carry, and what they cannot tell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_bench.tuning.joint_record import JointRecord, Kernel, Rows, Span
from hpid_bench.tuning.regression import (
    COULOMB,
    DELAY,
    EFFORT_SCALE,
    GIVE,
    GRAVITY_COS,
    GRAVITY_SIN,
    INERTIA,
    OFFSET,
    PARAMETERS,
    SPIN,
    STRIBECK,
    VISCOUS,
    Equation,
    Estimate,
    Model,
    RigidBody,
    Solution,
)
from hpid_ros.base.records import Record, quantity
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
    unreliable: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  # what to know of all the numbers
    method: str = ""  # how, in a few words
    why: str = ""  # the reason for the method, in a few words
    cutoff: float = 0.0  # [Hz] of the low pass
    rows: int = 0  # rows that counted
    time: float = 0.0  # [s] time that they stand for
    stribeck_speed: float = 0.0  # [rad/s] speed at which Stribeck friction has fallen to 1/e
    residual: float = 0.0  # [N m] root mean square of what is not explained
    explained: float = 0.0  # share of the effort's variance that is explained
    condition: float = 0.0  # condition number of the scaled columns
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


_CHANCE = 0.01  # of seeing a term that is not there
_ONE_WAY = 0.05  # of the rows: fewer are no motion in the other direction
_STRIBECK_SPEEDS = (0.05, 0.1, 0.2, 0.35)  # of the largest speed
_CREEPING = 0.1  # of the rows
_LEAST_EXPLAINED = 0.5
_WELL_EXPLAINED = 0.9
_SURELY = 1e-3  # chance of seeing a spring that is not there
_GIVES = 0.008  # of the effort's standard deviation, by what a spring has the effort change
_BETTER_WITH_SPRING = 0.9  # of the residual
_OWN_LAG = 0.7  # of the lag that a drive would have whose low pass looks like a spring
_RINGS = 0.1  # of the effort's standard deviation: what is less is no ringing that matters
_RINGING, _LOUD = 0.35, 0.5  # share of the residual near one frequency, and over the effort there
_LOWEST = 3.0  # [Hz] of what is called ringing: friction that is none of the model's is slower
_NEAR_PEAK, _SMOOTHED = 1.25, 9  # width of a peak, as a ratio; lines over which it is sought
_AHEAD = 1.0  # periods by which sampling alone may have an effort ahead of its cause
_FELT = 0.01  # of the effort's standard deviation
_SHARED = 100.0
_MOST_SPIN = 2.0  # of what the gears' ratios say; more is something else
_USEFUL_SCALE = 0.2
_OTHER_UNIT = 0.05
_REVERSED = (
    "the effort's scale is negative, what was recorded pushes against the motion that it causes: "
    "motor, encoder or recording has the other sign; under a controller the joint would run away"
)
_NO_UNIT = (
    "it is not 1: the masses differ from the URDF's, a load is carried, or the efforts have "
    "another unit (--effort-unit any)"
)
_ON_DOUBTED_SCALE = (
    "it stands on the efforts' scale, which is doubted; --effort-unit any takes the scale as found"
)
_INSTRUMENTS = {True: "answer to the reference", False: "samples between"}
_ALIKE = {
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
    GIVE: "a spring",
}
_HELP = {
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
_UNFELT = f"the links are hardly felt: {_HELP[EFFORT_SCALE]}"


def nothing(record: JointRecord, reason: str) -> JointIdentification:
    """Return that nothing could be found."""
    unreliable = {record.joint: reason}
    return JointIdentification(record.joint, unreliable=unreliable, travel=record.travel)


def findings(
    equation: Equation, choice: Solution, *, looks_for_spring: bool = True
) -> JointIdentification:
    """Return what an equation with its chosen terms says of its joint."""
    rows, not_rigid = equation.rows, ""
    if looks_for_spring:
        choice, not_rigid = _with_give(equation, choice)
    joint = rows.record.joint
    used = equation.weight > 0.0
    position, velocity, acceleration = equation.halves.mean(axis=0)
    effort = equation.effort(choice.delay)
    level = max(float(np.var(effort[used])), 1e-300)
    explained = 1.0 - choice.fit.rms**2 / level
    facts = JointIdentification(
        joint,
        method="instrumental variables",
        why=_why(equation, choice),
        remarks=_remarks(choice),
        is_rigid=not not_rigid,
        cutoff=rows.kernel.cutoff,
        rows=equation.used_rows,
        time=equation.used_rows * float(np.median(np.diff(rows.times))),
        stribeck_speed=choice.model.stribeck_speed,
        residual=choice.fit.rms,
        explained=max(explained, 0.0),
        condition=choice.fit.condition,
        travel=float(np.ptp(position[used])),
        speed=float(np.abs(velocity[used]).max()),
        acceleration=float(np.abs(acceleration[used]).max()),
        effort_limit=equation.limit,
        fit=_drawn(equation, choice, effort),
    )
    if explained < _LEAST_EXPLAINED:
        reason = (
            f"its motion explains only {max(explained, 0.0):.0%} of its efforts: other joints "
            "move it, it touches something, or these are not its efforts"
        )
        return replace(facts, unreliable={joint: reason})
    estimates = _estimates(equation, choice)
    has_unit = all(each.reason != _NO_UNIT for each in estimates.values())
    if explained < _WELL_EXPLAINED and has_unit:
        not_rigid = not_rigid or (
            f"its motion explains only {explained:.0%} of its efforts: the intervals are of "
            "noise, not of what the model lacks"
        )
    if not_rigid:
        estimates = {
            name: replace(each, reason=each.reason or not_rigid)
            for name, each in estimates.items()
        }
    scale = estimates.get(EFFORT_SCALE)
    if scale is not None and scale.is_reliable and scale.high < 0.0:
        facts = replace(facts, remarks=(*facts.remarks, _REVERSED))
    unreliable = {name: each.reason for name, each in estimates.items() if each.reason}
    if not choice.model.has_coulomb:
        unreliable[COULOMB] = (
            "it moved in one direction only, in which friction is a constant load: "
            f"{_HELP[COULOMB]}"
        )
    if equation.rigid is None and not choice.model.has_gravity:
        unreliable[GRAVITY_SIN] = (
            f"over {facts.travel:.2g} rad it is no other than a constant load, or there is none: "
            f"{_HELP[GRAVITY_SIN]}"
        )
    return replace(facts, estimates=estimates, unreliable=unreliable)


def _why(equation: Equation, choice: Solution) -> str:
    halves = equation.halves[:, 2]
    noise = float(np.var(halves[0] - halves[1])) / 4.0
    share = noise / max(float(np.var(halves.mean(axis=0))), 1e-300)
    used = _INSTRUMENTS[equation.uses_reference(choice.model, choice.delay)]
    return f"noise {share:.1g} of the acceleration's variance, instruments: {used}"


def chosen(equation: Equation, has_scale: bool) -> Solution:
    """Choose the terms, one after the other, by whether the data carry them."""
    used = equation.weight > 0.0
    backward = float(np.mean(equation.sign[used] < 0.0))
    is_free = equation.rigid is None
    model = Model(
        has_coulomb=_ONE_WAY <= backward <= 1.0 - _ONE_WAY,
        has_gravity=is_free,
        has_scale=has_scale and not is_free,
    )
    delay = equation.coarse_delay(model)
    equation.choose_instruments(model, delay)
    choice = equation.solve(model, delay)
    if is_free and not _is_gravity(equation, choice):
        model = model._replace(has_gravity=False)
        choice = equation.solve(model, choice.delay)
    if equation.spin is not None:
        choice = _with_spin(equation, choice)
    return _with_stribeck(equation, choice) if model.has_coulomb else choice


def _is_gravity(equation: Equation, choice: Solution) -> bool:
    """Return whether a part of the effort changes with the position, and not by chance."""
    used = equation.weight > 0.0
    position = equation.halves.mean(axis=0)[0][used]
    a, b = choice.value(GRAVITY_SIN), choice.value(GRAVITY_COS)
    part = np.std(a * np.sin(position) + b * np.cos(position))
    is_felt = bool(part > _FELT * np.std(equation.effort(choice.delay)[used]))
    return is_felt and choice.probability_of_none(GRAVITY_SIN, GRAVITY_COS) < _CHANCE


def _with_spin(equation: Equation, plain: Solution) -> Solution:
    """Add what rotors need beside their inertia if the data carry it, either way they may turn."""
    choice = equation.solve(plain.model._replace(has_spin=True), plain.delay)
    is_likely = abs(choice.value(SPIN)) < _MOST_SPIN
    return choice if is_likely and choice.probability_of_none(SPIN) < _CHANCE else plain


def _with_give(equation: Equation, plain: Solution) -> tuple[Solution, str]:
    r"""Add a spring between motor and load if the data show one; return why the joint gives.

    With inertias :math:`J_m` and :math:`J_l` on a stiffness k the effort is, up to the square of
    the frequency, :math:`J \ddot q - (J_l^2 / k J) \ddot \tau`. A drive's low pass has such a
    term, too, but a delay with it. Near the resonance it is more, and the residual rings.
    """
    used = equation.weight > 0.0
    effort, _, curvature = equation.rows.effort(plain.delay, equation.limit)
    level = max(float(np.std(effort[used])), 1e-300)
    model = plain.model._replace(has_scale=equation.rigid is not None)
    free = equation.solve(model, plain.delay) if model.has_scale else plain
    given = equation.solve(model._replace(has_give=True), free.delay)
    factor = given.value(GIVE)
    # Measured efforts have noise, of which a second derivative has as much as a spring would.
    is_exact = equation.rows.record.is_held or equation.uses_reference(given.model, given.delay)
    is_felt = -factor * float(np.std(curvature[used])) > _GIVES * level
    is_better = given.fit.rms < _BETTER_WITH_SPRING * free.fit.rms
    if is_exact and is_felt and is_better and given.probability_of_none(GIVE) < _SURELY:
        slow = math.sqrt(-2.0 * factor)  # the lag of a drive that looks like this
        if given.delay < _OWN_LAG * slow:
            found = equation.solve(plain.model._replace(has_give=True), plain.delay)
            frequency = 1.0 / (math.tau * math.sqrt(-factor))
            return found, (
                "the joint is not one rigid mass: it gives like a spring with a load that swings "
                f"at {frequency:.2g} Hz or less (flexible, or coupled to others)"
            )
    rings = _ringing(equation, plain, level)
    if rings:
        return plain, (
            f"the residual rings at {rings:.2g} Hz: the joint is not one rigid mass (flexible, "
            "loose, or coupled to others)"
        )
    return plain, ""


def _ringing(equation: Equation, choice: Solution, level: float) -> float:
    """Return the frequency at which the residual rings, in [Hz]; 0 where it does not."""
    if choice.fit.rms < _RINGS * level:
        return 0.0
    residual = choice.fit.residual
    taper = np.hanning(len(residual))
    power, whole = (
        np.abs(np.fft.rfft(each * taper)) ** 2
        for each in (residual, equation.effort(choice.delay))
    )
    frequency = np.fft.rfftfreq(len(residual), float(np.median(np.diff(equation.rows.times))))
    peak = float(frequency[np.argmax(np.convolve(power, np.ones(_SMOOTHED), "same"))])
    near = (frequency > peak / _NEAR_PEAK) & (frequency < peak * _NEAR_PEAK)
    there = float(power[near].sum())
    is_peak = there > _RINGING * float(power.sum()) and there > _LOUD * float(whole[near].sum())
    return peak if is_peak and peak > _LOWEST else 0.0


def _remarks(choice: Solution) -> tuple[str, ...]:
    if not choice.model.has_spin:
        return ()
    share = f"{choice.value(SPIN):.2f} ±{choice.half_width(SPIN):.2f}"
    return (
        f"rotors spin on links that move: what they pull at this joint is {share} of what their "
        "gears' ratios say",
    )


def _with_stribeck(equation: Equation, plain: Solution) -> Solution:
    """Add Stribeck friction if the data carry it: less friction at speed than at creep."""
    velocity = equation.halves.mean(axis=0)[1]
    speeds = np.abs(velocity[equation.weight > 0.0])
    fastest, slowest = float(speeds.max()), float(np.quantile(speeds, _CREEPING))
    best = plain
    for share in _STRIBECK_SPEEDS:
        if share * fastest < slowest:  # nobody has seen it
            continue
        choice = equation.solve(plain.model._replace(stribeck_speed=share * fastest), plain.delay)
        is_better = choice.value(STRIBECK) > 0.0 and choice.fit.rms < best.fit.rms
        if is_better and choice.probability_of_none(STRIBECK) < _CHANCE:
            best = choice
    return best


def _estimates(equation: Equation, choice: Solution) -> dict[str, Estimate]:
    found = {
        name: _estimate(equation, choice, name)
        for name in choice.model.names
        if name not in (SPIN, GIVE)
    }
    if choice.model.has_scale:
        found = _scaled(found)
    elif equation.rigid is not None:
        found[EFFORT_SCALE] = _scale_beside(equation, choice)
        if found[EFFORT_SCALE].reason == _NO_UNIT:
            found |= {
                name: replace(each, reason=each.reason or _ON_DOUBTED_SCALE)
                for name, each in found.items()
                if name != DELAY
            }
    return {name: found[name] for name in PARAMETERS if name in found}


def _estimate(equation: Equation, choice: Solution, name: str) -> Estimate:
    value = choice.delay if name == DELAY else choice.value(name)
    width = choice.half_width(name)
    return Estimate(value, width, _doubt(equation, choice, name, value, width))


def _scale_beside(equation: Equation, choice: Solution) -> Estimate:
    """Return the effort's scale, which a fit finds that leaves it free."""
    free = equation.solve(choice.model._replace(has_scale=True), choice.delay)
    inverse = _estimate(equation, free, EFFORT_SCALE)
    scale = _scaled({EFFORT_SCALE: inverse})[EFFORT_SCALE]
    if scale.is_reliable and (scale.low > 1.0 + _OTHER_UNIT or scale.high < 1.0 - _OTHER_UNIT):
        level = float(np.std(equation.effort(choice.delay)[equation.weight > 0.0]))
        is_felt = choice.fit.rms**2 - free.fit.rms**2 > (_FELT * level) ** 2
        return replace(scale, reason=_NO_UNIT if is_felt else _UNFELT)
    return scale


def _scaled(found: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return estimates in the unit of the rigid bodies, from those in the efforts' own."""
    inverse = found[EFFORT_SCALE]
    scale = 1.0 / inverse.value if inverse.value else np.inf
    share = inverse.half_width * abs(scale)
    result = {}
    for name, each in found.items():
        if name == EFFORT_SCALE:
            result[name] = Estimate(scale, share * abs(scale), each.reason)
        elif name == DELAY:
            result[name] = each
        else:
            width = float(np.hypot(each.half_width, each.value * share)) * abs(scale)
            result[name] = Estimate(each.value * scale, width, each.reason)
    return result


def _doubt(equation: Equation, choice: Solution, name: str, value: float, width: float) -> str:
    """Return why a number should not be relied on; empty if it may."""
    if not np.isfinite(width):
        return f"nothing can be said of its interval: {_HELP[name]}"
    if name == DELAY:
        if value + width < -_AHEAD * equation.rows.record.period:
            return (
                f"{value * 1e3:.3g} ms cannot be, nothing moves before its cause: efforts are "
                "stamped late or filtered, or positions are stamped early"
            )
        if not equation.is_inside(value):
            return f"the best is at the end of what was looked through, {value * 1e3:.3g} ms"
        if width < equation.resolution:
            return ""
        return f"known to {width * 1e3:.2g} ms only{_like(choice, name)}: {_HELP[name]}"
    if name in (OFFSET, GRAVITY_SIN, GRAVITY_COS):
        return ""
    if name == EFFORT_SCALE:
        share = width / max(abs(value), 1e-300)
        return "" if share < _USEFUL_SCALE else f"known to {share:.0%} only: {_HELP[name]}"
    if value - width > 0.0:
        return ""
    about = "its interval is below zero" if value + width < 0.0 else "its interval contains zero"
    return f"{about}{_like(choice, name)}: {_HELP[name]}"


def _like(choice: Solution, name: str) -> str:
    """Name the column that is most like another one, where that is what widens its interval."""
    names, covariance = choice.model.names, choice.fit.covariance
    place = names.index(name)
    if choice.fit.sharing[place] < _SHARED:
        return ""
    deviation = np.maximum(choice.fit.deviations, 1e-300)
    likeness = np.abs(covariance[place]) / (deviation * deviation[place])
    likeness[place] = 0.0
    return f", as its motion does not tell it from {_ALIKE[names[int(np.argmax(likeness))]]}"


def _drawn(equation: Equation, choice: Solution, effort: Numbers) -> Fit:
    times = equation.rows.times
    is_between = times == 0.0  # no row is at the first sample
    hole = np.where(is_between, np.nan, 1.0)
    return Fit(
        np.where(is_between, np.nan, times),
        effort * hole,
        equation.predicted(choice) * hole,
        equation.weight > 0.0,
    )


_LEAST = 0.05  # of the largest command; less is no drive
_LEVELS = 25
_REFINED = 3  # times, each between the neighbours of the best
_BEYOND = 0.002  # of the commands at least
_LEAST_MISFIT = 1e-4  # of the effort's variance: below it a model is right as it is
_BETTER = 0.2  # of the misfit without a limit at most: ripple and gear losses gain a third


def _saturation(equation: Equation) -> float:
    """Return the effort that acts of a larger command, in [N m]; infinite if none shows one."""
    sizes = np.abs(equation.rows.record.effort)
    largest = float(sizes.max(initial=0.0))
    if largest == 0.0:
        return math.inf
    plain = _misfit(equation)
    if plain < _LEAST_MISFIT:
        return math.inf
    low, high, best, least = _LEAST * largest, largest, math.inf, plain
    for _ in range(_REFINED):
        levels = np.geomspace(low, high, _LEVELS)
        misfits = [_misfit(equation.limited(float(each))) for each in levels]
        place = int(np.argmin(misfits))
        if misfits[place] >= least and best == math.inf:
            return math.inf
        best, least = float(levels[place]), misfits[place]
        low = float(levels[max(place - 1, 0)])
        high = float(levels[min(place + 1, _LEVELS - 1)])
    is_there = least < _BETTER * plain and float(np.mean(sizes > best)) >= _BEYOND
    return best if is_there else math.inf


def _misfit(equation: Equation) -> float:
    """Return the share of the effort's variance that an equation leaves unexplained."""
    model = Model(has_gravity=equation.rigid is None)
    found = equation.solve(model, equation.coarse_delay(model))
    effort = equation.effort(found.delay)[equation.weight > 0.0]
    return found.fit.rms**2 / max(float(np.var(effort)), 1e-300)


Spin = Callable[[Numbers, Numbers, Numbers, Numbers], Numbers]
"""Efforts that rotors need besides their reflected inertia, because they spin on links that move,
(K, R), in [N m]: for the same motion, and the reflected inertias of K rotors, (K,)."""

_CUTOFFS = (20.0, 16.0, 12.5, 10.0, 8.0, 6.3, 5.0, 4.0, 3.15, 2.5, 2.0, 1.6, 1.25, 1.0)
_HIGHEST = 0.1  # of the sampling frequency
_NOISE = 1e-3  # of the acceleration's variance
_LEAST_ROWS = 40
_BIN = 1.0  # [s]
_BUSY = 0.1  # of what the joint in question travels
_JITTER = 10.0  # standard deviations of a position's noise, which is no motion
_THIRD_DIFFERENCE = 20.0  # of white noise, over the variance of the noise itself
_FEW = 5
_TOGETHER = 0.1  # of the time in which it moves
_STILL = 0.02  # of the joint that moves most
_TOO_SLOW = "its direction is hardly ever known: it should move faster, or reverse less often"


@dataclass(frozen=True)
class Method(Record):
    """How joints are identified."""

    cutoff: float | None = quantity(
        "Low pass; chosen by the noise of each joint if None", "Hz", default=None, above=0.0
    )
    longest_delay: float = quantity("From effort to motion", "s", default=0.1, above=0.0, most=1.0)
    has_scale: bool = quantity("Efforts are in a unit of their own", default=False)


def identify(
    records: Sequence[JointRecord],
    rigid_body: RigidBody | None = None,
    method: Method | None = None,
    wanted: Sequence[str] | None = None,
    spin: Spin | None = None,
) -> tuple[JointIdentification, ...]:
    """Identify joints.

    Without rigid bodies each joint is taken for itself: what it moves is what it would with the
    other joints at rest.
    """
    how = method or Method()
    places = [k for k, each in enumerate(records) if wanted is None or each.joint in wanted]
    counted = [records[k] for k in places] if rigid_body is None else records
    moving = max((each.travel for each in counted if len(each.effort)), default=0.0)
    if rigid_body is not None:
        equations = {k: _equation(records, k, rigid_body, how, moving) for k in places}
        choices = {
            k: chosen(each, how.has_scale)
            for k, each in equations.items()
            if not isinstance(each, str)
        }
        if spin is not None:
            choices |= _with_spinning_rotors(spin, equations, choices, len(records), how)
        return tuple(
            nothing(records[k], each) if isinstance(each, str) else findings(each, choices[k])
            for k, each in equations.items()
        )
    alone = []
    for each in (records[k] for k in places):
        own = _equation([each], 0, None, how, moving, _others_turn(each, records))
        if isinstance(own, str):
            alone.append(nothing(each, own))
            continue
        result = findings(own, chosen(own, how.has_scale))
        company = _company(each, records) if result.is_found else ()
        alone.append(replace(result, remarks=(*result.remarks, *company)))
    return tuple(alone)


def _with_spinning_rotors(
    spin: Spin,
    equations: Mapping[int, Equation | str],
    choices: Mapping[int, Solution],
    count: int,
    how: Method,
) -> dict[int, Solution]:
    """Choose terms once more where rotors that are known now may pull at joints."""
    rotors = np.zeros(count)
    for place, choice in choices.items():
        own = equations[place]
        assert not isinstance(own, str)
        estimate = findings(own, choice, looks_for_spring=False).reliable(INERTIA)
        rotors[place] = estimate.value if estimate is not None else 0.0
    again = {}
    for place, equation in equations.items():
        if isinstance(equation, str) or not rotors.any():
            continue
        position, velocity, acceleration = equation.rows.motion.mean(axis=0)
        efforts = spin(position, velocity, acceleration, rotors)[place]
        if efforts.any():
            equation.spin = efforts
            again[place] = chosen(equation, how.has_scale)
    return again


def _company(own: JointRecord, records: Sequence[JointRecord]) -> tuple[str, ...]:
    """Return who moves while a joint does, whose coupling nobody knows."""
    edges = _bins(own)
    busy = _is_busy(own, edges, own.travel)
    if not busy.any():
        return ()
    names = [
        each.joint
        for each in records
        if each is not own and np.mean(_is_busy(each, edges, own.travel)[busy]) > _TOGETHER
    ]
    if not names:
        return ()
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return (
        f"{shown} moved at the same time: what they need and what couples them is in these "
        "numbers, for whose intervals nothing stands; give the robot, or move one joint at a time",
    )


def _others_turn(own: JointRecord, records: Sequence[JointRecord]) -> list[Span]:
    """Return when others move and a joint does not, which tells of it no more than their pull."""
    edges = _bins(own)
    is_theirs = np.zeros(len(edges), dtype=np.bool_)
    for each in records:
        is_theirs |= _is_busy(each, edges, each.travel)
    is_theirs &= ~_is_busy(own, edges, own.travel)
    return [Span(float(at), float(at) + _BIN) for at in edges[is_theirs]]


def _bins(record: JointRecord) -> Numbers:
    """Return when the pieces of time begin in which a joint has samples, in [s].

    Of a clock that was set there may be years without any.
    """
    begin = record.time[:1]
    return np.asarray(begin + _BIN * np.unique(np.floor((record.time - begin) / _BIN)))


def _is_busy(record: JointRecord, edges: Numbers, travel: float) -> NDArray[np.bool_]:
    """Tell for each piece of time whether a joint moves by a part of a travel."""
    begins, ends = (np.searchsorted(record.time, each) for each in (edges, edges + _BIN))
    pieces = [record.position[a:b] for a, b in zip(begins, ends, strict=True)]
    moved = np.array([float(np.ptp(each)) if len(each) else 0.0 for each in pieces])
    return np.asarray(moved > max(_BUSY * travel, _JITTER * _jitter(record.position)))


def _jitter(position: Numbers) -> float:
    """Return the standard deviation of what third differences say is noise; steps count, too."""
    if len(position) < _FEW:
        return 0.0
    return math.sqrt(float(np.var(np.diff(position, 3))) / _THIRD_DIFFERENCE)


def _equation(
    records: Sequence[JointRecord],
    place: int,
    rigid_body: RigidBody | None,
    how: Method,
    moving: float,
    left_out: Sequence[Span] = (),
) -> Equation | str:
    """Return a joint's equation, or why there is none."""
    own = records[place]
    if len(own.time) < 2 or len(own.effort_time) < 2:
        return "there are no positions, or no efforts, to look at"
    if own.travel == 0.0 or own.travel < _STILL * moving:
        return f"it did not move (by {own.travel:.2g}): it needs a motion of its own"
    if not np.any(own.effort):
        return "its efforts are zero throughout"
    kernel = _kernel(own, how)
    rows = Rows(records, place, kernel, how.longest_delay)
    if rows.count < _LEAST_ROWS:
        return (
            f"no stretch without a gap is longer than {6.0 * kernel.half_width:.2g} s, which a "
            f"low pass of {kernel.cutoff:g} Hz needs at samples every {own.period:.2g} s"
        )
    equation = Equation(rows, rigid_body, left_out)
    if equation.used_rows < _LEAST_ROWS:
        return _TOO_SLOW
    return equation.limited(_saturation(equation)) if own.is_held else equation


def _kernel(record: JointRecord, how: Method) -> Kernel:
    """Return the low pass asked for, or the highest in which the acceleration has little noise."""
    highest = _HIGHEST / record.period
    if how.cutoff is not None:
        return Kernel(min(how.cutoff, highest))
    best, least = None, math.inf
    for cutoff in _CUTOFFS:
        if cutoff > highest and cutoff > _CUTOFFS[-1]:
            continue
        kernel = Kernel(min(cutoff, highest))
        rows = Rows([record], 0, kernel, how.longest_delay)
        if not rows.count:
            continue
        accelerations = [part[:, 2, 0] for part in rows.parts]
        acceleration = np.concatenate([each.mean(axis=0) for each in accelerations])
        # By how far the halves differ.
        noise = math.sqrt(np.mean([(np.std(a - b) / 2.0) ** 2 for a, b in accelerations]))
        share = noise**2 / max(float(np.var(acceleration)), 1e-300)
        if share <= _NOISE:
            return kernel
        if share < least:
            best, least = kernel, share
    return best or Kernel(min(_CUTOFFS[0], highest))

"""Which terms a joint's equation needs: decided by tests on what was recorded.

Each term beyond inertia, viscous friction and a constant load is tried, and is kept where its
coefficients are unlikely to be zero and matter for the effort.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hpid_bench.tuning.identification.regression import (
    GRAVITY_COS,
    GRAVITY_SIN,
    SPIN,
    SPRING,
    STRIBECK,
    Equation,
    Model,
    Solution,
)
from hpid_ros.base.units import Numbers

_TINY = 1e-300  # instead of zero, where something is divided by it
_SIGNIFICANCE = 0.01  # level of the test that a coefficient is zero
_LEAST_EFFECT = 0.01  # of the effort's standard deviation: what changes it less is not felt
_LEAST_PER_DIRECTION = 0.05  # of the rows; with fewer, Coulomb friction is a constant load
_STRIBECK_SPEEDS = (0.05, 0.1, 0.2, 0.35)  # that are tried, over the largest speed
_CREEP_QUANTILE = 0.1  # of the speeds: below it there are too few rows to tell friction at creep
_MOST_SPIN = 2.0  # times what the gears' ratios say; more is something else


def select_terms(equation: Equation, has_scale: bool) -> Solution:
    """Choose the terms, one after the other, by whether the data carry them."""
    used = equation.weight > 0.0
    backward = float(np.mean(equation.sign[used] < 0.0))
    is_free = equation.rigid is None  # no rigid bodies are known: gravity is a term of its own
    model = Model(
        has_coulomb=_LEAST_PER_DIRECTION <= backward <= 1.0 - _LEAST_PER_DIRECTION,
        has_gravity=is_free,
        has_scale=has_scale and not is_free,
    )
    delay = equation.coarse_delay(model)
    equation.choose_instruments(model, delay)
    solution = equation.solve(model, delay)
    if is_free and not _is_gravity_significant(equation, solution):
        model = model._replace(has_gravity=False)
        solution = equation.solve(model, solution.delay)
    if equation.spin is not None:
        solution = _with_spin(equation, solution)
    return _with_stribeck(equation, solution) if model.has_coulomb else solution


def _is_gravity_significant(equation: Equation, solution: Solution) -> bool:
    """Return whether a part of the effort changes with the position, and not by chance."""
    used = equation.weight > 0.0
    position = equation.halves.mean(axis=0)[0][used]
    a, b = solution.value(GRAVITY_SIN), solution.value(GRAVITY_COS)
    gravity = a * np.sin(position) + b * np.cos(position)
    effort = equation.effort(solution.delay)[used]
    is_felt = bool(np.std(gravity) > _LEAST_EFFECT * np.std(effort))
    return is_felt and solution.probability_of_none(GRAVITY_SIN, GRAVITY_COS) < _SIGNIFICANCE


def _with_spin(equation: Equation, plain: Solution) -> Solution:
    """Add what rotors need besides their inertia if the data carry it.

    Of either sign, as rotors may turn either way.
    """
    solution = equation.solve(plain.model._replace(has_spin=True), plain.delay)
    is_likely = abs(solution.value(SPIN)) < _MOST_SPIN
    is_significant = solution.probability_of_none(SPIN) < _SIGNIFICANCE
    return solution if is_likely and is_significant else plain


def _with_stribeck(equation: Equation, plain: Solution) -> Solution:
    """Add Stribeck friction if the data carry it: less friction at speed than at creep.

    It is not linear in its speed, so that a few speeds are tried.
    """
    velocity = equation.halves.mean(axis=0)[1]
    speeds = np.abs(velocity[equation.weight > 0.0])
    fastest, slowest = float(speeds.max()), float(np.quantile(speeds, _CREEP_QUANTILE))
    best = plain
    for share in _STRIBECK_SPEEDS:
        speed = share * fastest
        if speed < slowest:  # it never moved so slowly
            continue
        solution = equation.solve(plain.model._replace(stribeck_speed=speed), plain.delay)
        is_better = solution.value(STRIBECK) > 0.0 and solution.fit.rms < best.fit.rms
        if is_better and solution.probability_of_none(STRIBECK) < _SIGNIFICANCE:
            best = solution
    return best


_SPRING_SIGNIFICANCE = 1e-3
_LEAST_SPRING_EFFECT = 0.008  # of the effort's standard deviation
_MOST_RESIDUAL_WITH_SPRING = 0.9  # of the residual without it
_DELAY_OF_LOW_PASS = 0.7  # of the lag of a drive's low pass that looks like the spring


class Flexibility(NamedTuple):
    """Whether a joint is one rigid mass."""

    solution: Solution  # with a spring between motor and load, where the data show one
    reason: str  # why the joint is not rigid; empty if nothing shows that


def with_flexibility(equation: Equation, plain: Solution) -> Flexibility:
    r"""Add a spring between motor and load if the data show one.

    With inertias :math:`J_m` and :math:`J_l` on a stiffness k the effort is, up to the square of
    the frequency, :math:`J \ddot q - (J_l^2 / k J) \ddot \tau`: the coefficient of
    :math:`\ddot\tau` is negative. A drive's low pass has such a term, too, but a delay with it.
    Near the resonance the effort has more than that term, and the residual rings.
    """
    used = equation.weight > 0.0
    effort, _, effort_curvature = equation.rows.effort(plain.delay, equation.limit)
    deviation = max(float(np.std(effort[used])), _TINY)
    # Masses that are wrong in the URDF are no spring: the scale is left free while it is sought.
    model = plain.model._replace(has_scale=equation.rigid is not None)
    rigid = equation.solve(model, plain.delay) if model.has_scale else plain
    flexible = equation.solve(model._replace(has_spring=True), rigid.delay)
    coefficient = flexible.value(SPRING)
    # Measured efforts have noise, of which a second derivative has as much as a spring would.
    is_exact = equation.rows.record.is_held or equation.uses_reference(
        flexible.model, flexible.delay
    )
    is_felt = -coefficient * float(np.std(effort_curvature[used])) > (
        _LEAST_SPRING_EFFECT * deviation
    )
    is_better = flexible.fit.rms < _MOST_RESIDUAL_WITH_SPRING * rigid.fit.rms
    is_spring = is_exact and is_felt and is_better
    if is_spring and flexible.probability_of_none(SPRING) < _SPRING_SIGNIFICANCE:
        low_pass_lag = math.sqrt(-2.0 * coefficient)
        if flexible.delay < _DELAY_OF_LOW_PASS * low_pass_lag:
            solution = equation.solve(plain.model._replace(has_spring=True), plain.delay)
            frequency = 1.0 / (math.tau * math.sqrt(-coefficient))
            return Flexibility(
                solution,
                "the joint is not one rigid mass: it gives like a spring with a load that swings "
                f"at {frequency:.2g} Hz or less (flexible, or coupled to others)",
            )
    resonance = _resonance(equation, plain, deviation)
    if resonance is not None:
        return Flexibility(
            plain,
            f"the residual rings at {resonance:.2g} Hz: the joint is not one rigid mass "
            "(flexible, loose, or coupled to others)",
        )
    return Flexibility(plain, "")


_LEAST_RESIDUAL = 0.1  # of the effort's standard deviation: a smaller one may ring
_LEAST_OF_RESIDUAL = 0.35  # share of the residual's power that is near the peak
_LEAST_OVER_EFFORT = 0.5  # power of the residual over that of the effort, near the peak
_LOWEST_RESONANCE = 3.0  # [Hz]; friction that is not in the model varies more slowly
_PEAK_WIDTH = 1.25  # ratio of the frequencies from the peak to either side
_SMOOTHED_LINES = 9  # of the periodogram, over which its peak is sought


def _resonance(equation: Equation, solution: Solution, deviation: float) -> float | None:
    """Return the frequency at which the residual rings, in [Hz]; None where it does not.

    By the periodogram: most of the residual is near one frequency, and there it is not small
    against the effort.
    """
    if solution.fit.rms < _LEAST_RESIDUAL * deviation:
        return None
    residual = solution.fit.residual
    taper = np.hanning(len(residual))
    residual_power = _periodogram(residual * taper)
    effort_power = _periodogram(equation.effort(solution.delay) * taper)
    spacing = float(np.median(np.diff(equation.rows.times)))
    frequency = np.fft.rfftfreq(len(residual), spacing)
    smoothed = np.convolve(residual_power, np.ones(_SMOOTHED_LINES), "same")
    peak = float(frequency[np.argmax(smoothed)])
    near = (frequency > peak / _PEAK_WIDTH) & (frequency < peak * _PEAK_WIDTH)
    power = float(residual_power[near].sum())
    is_peak = power > _LEAST_OF_RESIDUAL * float(residual_power.sum())
    is_loud = power > _LEAST_OVER_EFFORT * float(effort_power[near].sum())
    return peak if is_peak and is_loud and peak > _LOWEST_RESONANCE else None


def _periodogram(values: Numbers) -> Numbers:
    return np.asarray(np.abs(np.fft.rfft(values)) ** 2)


_LOWEST_LIMIT = 0.05  # of the largest command; less is no drive
_LEVELS = 25  # of one pass of the search
_PASSES = 3  # each between the neighbours of the best level
_LEAST_BEYOND = 0.002  # of the commands have to be larger than the limit
_LEAST_UNEXPLAINED = 1e-4  # of the effort's variance: below it a model is right without a limit
_MOST_WITH_LIMIT = 0.2  # of what was unexplained without: ripple and gear losses gain a third


def effort_limit(equation: Equation) -> float:
    """Return the effort at which a drive saturates, in [N m]; infinite if none shows.

    The level that explains most when commands are clipped to it, where it explains far more than
    no limit does.
    """
    sizes = np.abs(equation.rows.record.effort)
    largest = float(sizes.max(initial=0.0))
    if largest == 0.0:
        return math.inf
    without = _unexplained(equation)
    if without < _LEAST_UNEXPLAINED:
        return math.inf
    low, high = _LOWEST_LIMIT * largest, largest
    best, least = math.inf, without
    for _ in range(_PASSES):
        levels = np.geomspace(low, high, _LEVELS)
        unexplained = [_unexplained(equation.limited(float(each))) for each in levels]
        place = int(np.argmin(unexplained))
        if unexplained[place] >= least and best == math.inf:
            return math.inf
        best, least = float(levels[place]), unexplained[place]
        low = float(levels[max(place - 1, 0)])
        high = float(levels[min(place + 1, _LEVELS - 1)])
    is_there = least < _MOST_WITH_LIMIT * without
    is_reached = float(np.mean(sizes > best)) >= _LEAST_BEYOND
    return best if is_there and is_reached else math.inf


def _unexplained(equation: Equation) -> float:
    """Return the share of the effort's variance that an equation leaves unexplained."""
    model = Model(has_gravity=equation.rigid is None)
    solution = equation.solve(model, equation.coarse_delay(model))
    effort = equation.effort(solution.delay)[equation.weight > 0.0]
    return solution.fit.rms**2 / max(float(np.var(effort)), _TINY)

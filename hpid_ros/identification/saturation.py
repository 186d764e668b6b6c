"""Where a drive saturates: commands beyond that explain a motion worse than the limit does."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from hpid_ros.identification.equation import Equation, Model
from hpid_ros.identification.records import JointRecord

_LEAST = 0.05  # of the largest command; less is no drive
_LEVELS = 25
_REFINED = 3  # times, each between the neighbours of the best
_BEYOND = 0.002  # of the commands at least
_LEAST_MISFIT = 1e-4  # of the effort's variance: below it a model is right as it is
_BETTER = 0.2  # of the misfit without a limit at most: ripple and gear losses gain a third


def saturation(record: JointRecord, equation: Callable[[float], Equation]) -> float:
    """Return the effort that acts of a larger command, in [N m]; infinite if none shows one."""
    sizes = np.abs(record.effort)
    largest = float(sizes.max(initial=0.0))
    if largest == 0.0:
        return math.inf
    plain = _misfit(equation(math.inf))
    if plain < _LEAST_MISFIT:
        return math.inf
    low, high, best, least = _LEAST * largest, largest, math.inf, plain
    for _ in range(_REFINED):
        levels = np.geomspace(low, high, _LEVELS)
        misfits = [_misfit(equation(float(each))) for each in levels]
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
    is_free = equation.terms.rigid is None
    model = Model(has_gravity=is_free)
    fit, delay = equation.solve(model, equation.coarse_delay(model))
    effort = equation.effort(delay)[equation.weight > 0.0]
    return fit.rms**2 / max(float(np.var(effort)), 1e-300)

"""The loops that one joint's settings stand for: every inertia, and every frozen multiplier.

The homogeneous law is, at each instant, the PID of gains that its multiplier has scaled. The
margins of those PIDs, each with its multiplier frozen, are a band in place of a line. They prove
nothing about a multiplier that moves, which certificates do
(:mod:`hpid_ros.stability`); at rest, where the norm is at its floor, the law is linear and
its margins are its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.control import LoopSettings
from hpid_ros.control.settings.table import LARGEST_NORM as NO_CAP
from hpid_ros.frequency.loop import FrozenLoop
from hpid_ros.frequency.margins import Margins, margins_of
from hpid_ros.frequency.plant import SampledJoint
from hpid_ros.stability.gain_check import LARGEST_NORM

MOST_PERIODS_LATE = 200
"""A delay of more control periods than this is refused: the loop's state would be as long."""

_LEAST_NORM = 1e-6  # where the floor is 0; the least floor that is ever computed
_INERTIAS, _MULTIPLIERS = 5, 17


@dataclass(frozen=True)
class LoopFamily:
    """The frozen loops of one joint."""

    settings: LoopSettings  # of the loop
    inertia: tuple[float, float]  # [kg m^2] least and largest inertia
    friction: float  # [N m s/rad] viscous friction
    delay: float  # [s] from state to effort, beyond the hold
    norms: tuple[float, float]  # least and largest norm that the loop reaches

    @property
    def is_homogeneous(self) -> bool:
        """Whether the multiplier moves."""
        return self.settings.degree != 0.0

    @cached_property
    def inertias(self) -> tuple[float, ...]:
        """The inertias that are looked at, from the least on, even in their logarithm."""
        return _even(*self.inertia, _INERTIAS)

    @cached_property
    def multipliers(self) -> tuple[float, ...]:
        """The multipliers that are looked at, increasing, 1 among them if it is reached."""
        least, largest = sorted(norm**self.settings.degree for norm in self.norms)
        found = set(_even(least, largest, _MULTIPLIERS))
        if least <= 1.0 <= largest:
            found.add(1.0)
        return tuple(sorted(found))

    @property
    def at_rest(self) -> float:
        """The multiplier where the norm is least: at its floor, near the target."""
        return float(self.norms[0] ** self.settings.degree)

    def norm_of(self, multiplier: float) -> float:
        """Return the norm that has a multiplier."""
        degree = self.settings.degree
        return float(multiplier ** (1.0 / degree)) if degree else 1.0

    def loop(self, inertia: float, multiplier: float = 1.0) -> FrozenLoop:
        """Return one of the loops."""
        period = self.settings.timing.control_period
        joint = SampledJoint(inertia, period, self.friction, self.delay)
        return FrozenLoop(self.settings, joint, multiplier)


def loop_family(
    settings: LoopSettings,
    inertia: tuple[float, float],
    friction: float = 0.0,
    delay: float = 0.0,
    largest_norm: float | None = None,
) -> LoopFamily:
    """Return the frozen loops of one joint."""
    period = settings.timing.control_period
    if not 0.0 <= delay <= MOST_PERIODS_LATE * period:
        raise SettingError(
            f"the delay must lie in [0, {MOST_PERIODS_LATE * period:g}] s, {MOST_PERIODS_LATE} "
            f"control periods, not {delay:g} s"
        )
    if largest_norm is not None and not 0.0 < largest_norm < math.inf:
        raise SettingError(f"the largest norm must be positive and finite, not {largest_norm:g}")
    if settings.model.is_decoupling:
        friction = 0.0
    for each in inertia:
        SampledJoint(each, period, friction, delay)
    norms = (1.0, 1.0)
    if settings.degree != 0.0:
        cap = settings.norm.cap
        default = cap if cap < NO_CAP else LARGEST_NORM
        highest = min(cap, default if largest_norm is None else largest_norm)
        least = min(max(settings.norm_floor, _LEAST_NORM), highest)
        norms = (least, highest)
    return LoopFamily(settings, inertia, friction, delay, norms)


class Case(NamedTuple):
    """One of the loops and its margins."""

    inertia: float  # [kg m^2]
    multiplier: float  # lam
    margins: Margins | None  # None where it is unstable


@dataclass(frozen=True)
class FamilyMargins:
    """The margins of several loops of a family."""

    cases: tuple[Case, ...]  # at least one

    @property
    def is_stable(self) -> bool:
        """Whether every loop is stable."""
        return not self.unstable

    @property
    def unstable(self) -> tuple[Case, ...]:
        """The loops that are not."""
        return tuple(each for each in self.cases if each.margins is None)

    @cached_property
    def where(self) -> dict[str, Case]:
        """The loop in which each margin is worst, by the name of the margin.

        Empty where a loop is unstable: there is no margin then.
        """
        if self.unstable:
            return {}
        return {
            name: choose(self.cases, key=lambda case: getattr(case.margins, name))
            for name, choose in _WORST.items()
        }

    @property
    def worst(self) -> Margins | None:
        """The worst of each margin; None where a loop is unstable."""
        if self.unstable:
            return None
        values = {name: getattr(at.margins, name) for name, at in self.where.items()}
        for name in _PEAKS:  # where the worst peak is, not a worst place
            values[f"{name}_at"] = getattr(self.where[name].margins, f"{name}_at")
        return Margins(**values)

    def of(self, multipliers: tuple[float, ...]) -> FamilyMargins:
        """Return those of some multipliers alone."""
        return FamilyMargins(tuple(each for each in self.cases if each.multiplier in multipliers))


_PEAKS = ("sensitivity", "complementary")
_WORST: dict[str, Callable[..., Case]] = {
    each.name: max if each.name in (*_PEAKS, "gain_reduction") else min for each in fields(Margins)
}


def family_margins(family: LoopFamily) -> FamilyMargins:
    """Return the margins over all inertias and multipliers of a family, and of its plain PID.

    The multiplier 1 is among the cases even where the loop does not reach it: there stands the
    linear PID.
    """
    wanted = sorted({*family.multipliers, 1.0})
    return FamilyMargins(
        tuple(
            _case(family, inertia, multiplier)
            for multiplier in wanted
            for inertia in family.inertias
        )
    )


def _case(family: LoopFamily, inertia: float, multiplier: float) -> Case:
    try:
        margins = margins_of(family.loop(inertia, multiplier))
    except GainError:
        margins = None
    return Case(inertia, multiplier, margins)


def _even(low: float, high: float, count: int) -> tuple[float, ...]:
    """Return numbers from one to another, both among them exactly."""
    if low == high:
        return (low,)
    inside: Iterator[float] = map(float, np.geomspace(low, high, count)[1:-1])
    return (low, *inside, high)

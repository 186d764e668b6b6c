"""What two runs must share before their numbers can be compared, and what they do not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hpid_ros.base.rounding import significant
from hpid_ros.messages.series import JointSeries
from hpid_ros.metrics.alignment import (
    DURATION_WITHIN,
    REFERENCE_AT_LEAST,
    REFERENCE_WITHIN,
    Outline,
)
from hpid_ros.metrics.quantities import CHATTER, QUANTITIES, Data

KNOTS = 33  # points at which each reference is kept
KNOT_DIGITS = 9
RATE_WITHIN = 0.05  # by a larger share: rates of other loops, and not of lost states alone
UNLIKE_KNOTS = 2  # so many points must differ: one may lie in a jump


EVERYTHING = frozenset(QUANTITIES)
NO_QUANTITY: frozenset[str] = frozenset()
EFFORTS = frozenset(key for key, each in QUANTITIES.items() if each.needs is Data.EFFORT)


class ConditionDifference(NamedTuple):
    """One thing that two runs do not share."""

    text: str  # in words
    # keys of the quantities that say nothing beside each other for that reason
    spoils: frozenset[str]


@dataclass(frozen=True)
class Conditions:
    """What two runs must share before their numbers can be compared."""

    duration: float  # [s] from the first to the last state
    period: float  # [s] mean time between two states
    cutoff: float  # [Hz] frequency above which effort counts as chatter
    clock: str = "header"  # whose time the states have: "header" or "receive"
    # [rad] for each joint that has one, its reference at KNOTS even times
    references: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    # by what the run is laid over others; not in saved numbers
    outline: Outline | None = field(default=None, compare=False)
    # of each joint that has efforts: from the first to the last, and their mean period, in [s]
    efforts: Mapping[str, tuple[float, float]] = field(default_factory=dict, compare=False)

    @property
    def odd_efforts(self) -> dict[str, tuple[float, float]]:
        """Those efforts that cover another time than the states, or have another rate."""
        usual = self.duration, self.period
        return {k: v for k, v in self.efforts.items() if any(_unlike_efforts(v, usual).values())}


def condition_differences(one: Conditions, other: Conditions) -> Iterator[ConditionDifference]:
    """Yield what differs between two runs' conditions."""
    if _differ(one.duration, other.duration):
        text = f"durations differ: {one.duration:g} s and {other.duration:g} s"
        yield ConditionDifference(text, EVERYTHING)
    is_other_rate = _differ(one.period, other.period, RATE_WITHIN)
    if _differ(one.period, other.period):
        rates = (f"{1 / each:.4g} Hz" if each else "none" for each in (one.period, other.period))
        text = f"state rates differ: {' and '.join(rates)}"
        yield ConditionDifference(text, EVERYTHING if is_other_rate else NO_QUANTITY)
    if one.clock != other.clock:
        yield ConditionDifference(f"clocks differ: {one.clock} and {other.clock}", NO_QUANTITY)
    if one.cutoff != other.cutoff:
        text = f"chatter cut-offs differ: {one.cutoff:g} Hz and {other.cutoff:g} Hz"
        yield ConditionDifference(text, frozenset({CHATTER.key}))
    unlike = {
        name: _unlike_efforts(one.efforts[name], other.efforts[name])
        for name in one.efforts
        if name in other.efforts
    }
    is_other_time = _differ(one.duration, other.duration)
    for what, is_said in (("times", is_other_time), ("rates", is_other_rate)):
        names = [name for name, are_unlike in unlike.items() if are_unlike[what]]
        if names and not is_said:
            yield ConditionDifference(f"{what} of the efforts differ: {', '.join(names)}", EFFORTS)
    names = [
        name
        for name, knots in one.references.items()
        if name in other.references
        and _unlike(knots, one.duration, other.references[name], other.duration)
    ]
    if names:
        yield ConditionDifference(f"references differ: {', '.join(names)}", EVERYTHING)


def knots_of(series: JointSeries) -> tuple[float, ...]:
    at = np.linspace(0.0, float(series.time[-1]), KNOTS)
    values = np.interp(at, series.time, series.reference)
    return tuple(significant(value, KNOT_DIGITS) for value in values)


def _differ(one: float, other: float, within: float = DURATION_WITHIN) -> bool:
    return abs(one - other) > within * max(one, other)


def _unlike_efforts(one: tuple[float, float], other: tuple[float, float]) -> dict[str, bool]:
    """Say whether efforts cover other times, by more than a sample at each end, or rates."""
    (one_time, one_period), (other_time, other_period) = one, other
    is_more = abs(one_time - other_time) > 2.5 * max(one_period, other_period)
    return {
        "times": is_more and _differ(one_time, other_time),
        "rates": _differ(one_period, other_period, RATE_WITHIN),
    }


def _unlike(
    one: tuple[float, ...], one_duration: float, other: tuple[float, ...], other_duration: float
) -> bool:
    """Say whether two references differ over the time that both have."""
    at = np.linspace(0.0, one_duration, len(one))
    of_other = np.interp(at, np.linspace(0.0, other_duration, len(other)), other)
    shared = at <= other_duration
    values = np.array([*one, *other])
    within = max(REFERENCE_AT_LEAST, REFERENCE_WITHIN * float(values.max() - values.min()))
    if _differ(one_duration, other_duration):
        within *= 5.0  # compared between the points of one of them
    unlike = np.abs(np.array(one) - of_other)[shared] > within
    return int(np.count_nonzero(unlike)) >= UNLIKE_KNOTS

"""Conditions of a run, as far as two runs must share them to be compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hpid_ros.analysis.quantities import CHATTER, QUANTITIES
from hpid_ros.recordings.series import JointSeries, RunSeries

KNOTS = 33
"""Points at which each reference is kept."""
KNOT_DIGITS = 9
DURATION_WITHIN = 0.01
"""Durations, and rates of states, that differ by less than this share are the same."""
RATE_WITHIN = 0.05
"""Rates that differ by more than this share are of other loops, and not of lost states alone."""
REFERENCE_WITHIN = 0.02
"""References that differ by less than this share of their range are the same ..."""
REFERENCE_AT_LEAST = 1e-3
"""... or by less than this, in [rad]."""
UNLIKE_KNOTS = 2
"""So many points must differ: one may lie in a jump."""


EVERYTHING = frozenset(QUANTITIES)
NOTHING: frozenset[str] = frozenset()


class Difference(NamedTuple):
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
    # [rad] for each joint that has one, its reference at KNOTS even times
    references: Mapping[str, tuple[float, ...]]
    clock: str = "header"  # whose time the states have: "header" or "receive"
    reference_from: float | None = field(default=None, compare=False)

    def as_mapping(self) -> dict[str, object]:
        """Return the conditions as plain values, ready for JSON."""
        return {
            "duration": self.duration,
            "period": self.period,
            "cutoff": self.cutoff,
            "clock": self.clock,
            "references": {name: list(knots) for name, knots in self.references.items()},
        }


def conditions_of(run: RunSeries, cutoff: float) -> Conditions:
    """Return the conditions of a recorded run."""
    states = max(series.state_stamps_ns.size for series in run.joints)
    began = [each.reference_from for each in run.quality.joints.values()]
    return Conditions(
        duration=run.duration,
        period=run.duration / max(1, states - 1),
        cutoff=cutoff,
        references={each.joint: _knots(each) for each in run.joints if each.has_reference},
        clock=next((each.state_clock for each in run.quality.joints.values()), "header"),
        reference_from=min((each for each in began if each is not None), default=None),
    )


def differences(one: Conditions, other: Conditions) -> Iterator[Difference]:
    """Yield what differs between two runs' conditions."""
    if _differ(one.duration, other.duration):
        text = f"durations differ: {one.duration:g} s and {other.duration:g} s"
        yield Difference(text, EVERYTHING)
    if _differ(one.period, other.period):
        rates = (f"{1 / each:.4g} Hz" if each else "none" for each in (one.period, other.period))
        is_other_rate = _differ(one.period, other.period, RATE_WITHIN)
        text = f"state rates differ: {' and '.join(rates)}"
        yield Difference(text, EVERYTHING if is_other_rate else NOTHING)
    if one.clock != other.clock:
        yield Difference(f"clocks differ: {one.clock} and {other.clock}", NOTHING)
    if one.cutoff != other.cutoff:
        text = f"chatter cut-offs differ: {one.cutoff:g} Hz and {other.cutoff:g} Hz"
        yield Difference(text, frozenset({CHATTER.key}))
    names = [
        name
        for name, knots in one.references.items()
        if name in other.references
        and _unlike(knots, one.duration, other.references[name], other.duration)
    ]
    if names:
        yield Difference(f"references differ: {', '.join(names)}", EVERYTHING)


def _knots(series: JointSeries) -> tuple[float, ...]:
    at = np.linspace(0.0, float(series.time[-1]), KNOTS)
    values = np.interp(at, series.time, series.reference)
    return tuple(float(f"{value:.{KNOT_DIGITS}g}") for value in values)


def _differ(one: float, other: float, within: float = DURATION_WITHIN) -> bool:
    return abs(one - other) > within * max(one, other)


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

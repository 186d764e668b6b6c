"""The same numbers with angles in degrees, or in radians again; what slides has none."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from hpid_ros.analysis.quantities import (
    ANGLE_UNITS,
    DEGREES_PER_RADIAN,
    ERROR_L2,
    ITAE,
    QUANTITIES,
    Quantity,
    folded,
)
from hpid_ros.analysis.results import JointIndices, RunIndices, Spread
from hpid_ros.base.errors import unknown_name
from hpid_ros.recordings.series import SeriesError


def in_units(runs: Sequence[RunIndices], angle_unit: str) -> list[RunIndices]:
    """Return the numbers of runs as they stand side by side: each joint in one unit.

    A joint that one of the runs knows to slide slides in all of them.
    """
    slides = frozenset[str]().union(*(run.slides for run in runs))
    return [with_angles_in(_knowing(run, slides), angle_unit) for run in runs]


def _knowing(run: RunIndices, slides: frozenset[str]) -> RunIndices:
    own = slides.intersection(run.joints)
    # What was taken for degrees becomes metres by way of what was recorded.
    return run if own == run.slides else replace(with_angles_in(run, "rad"), slides=own)


def with_angles_in(run: RunIndices, angle_unit: str) -> RunIndices:
    """Return a run's numbers with angles in another unit; its conditions stay in rad."""
    if angle_unit not in ANGLE_UNITS:
        raise SeriesError(unknown_name("unit of angles", angle_unit, ANGLE_UNITS))
    if angle_unit == run.angle_unit:
        return run
    scale = DEGREES_PER_RADIAN if angle_unit == "deg" else 1.0 / DEGREES_PER_RADIAN
    if run.slides:
        return _beside_slides(run, angle_unit, scale)
    return replace(
        run,
        joints={name: _scaled(indices, scale) for name, indices in run.joints.items()},
        totals=_scaled(run.totals, scale),
        error_l2=run.error_l2 * _factor(ERROR_L2, scale),
        spread=None if run.spread is None else _scaled_spread(run.spread, scale),
        angle_unit=angle_unit,
    )


def _beside_slides(run: RunIndices, angle_unit: str, scale: float) -> RunIndices:
    """Return the numbers where some or all joints slide: these are left, totals folded anew."""
    if run.slides.issuperset(run.joints):
        return replace(run, angle_unit=angle_unit)
    if run.spread is not None:
        raise SeriesError(
            f"run {run.label!r} is medians over joints that turn and slide: its totals cannot be "
            f"given in {angle_unit}; give the single runs"
        )
    joints = {
        name: indices if name in run.slides else _scaled(indices, scale)
        for name, indices in run.joints.items()
    }

    def over_all(quantity: Quantity, before: float) -> float:
        if not quantity.angle_power or math.isnan(before):
            return before
        values = (joint.value(quantity) for joint in joints.values())
        total = folded(quantity.fold, [value for value in values if not math.isnan(value)])
        return math.nan if total is None else total

    further = {k: over_all(QUANTITIES[k], value) for k, value in run.totals.further.items()}
    totals = replace(run.totals, itae=over_all(ITAE, run.totals.itae), further=further)
    return replace(
        run,
        joints=joints,
        totals=totals,
        error_l2=over_all(ERROR_L2, run.error_l2),
        angle_unit=angle_unit,
    )


def _factor(quantity: Quantity, scale: float) -> float:
    # A product and no power: the same factor on every machine.
    factor = 1.0
    for _ in range(quantity.angle_power):
        factor *= scale
    return factor


def _scaled(indices: JointIndices, scale: float) -> JointIndices:
    further = {
        key: value * _factor(QUANTITIES[key], scale) for key, value in indices.further.items()
    }
    return replace(indices, itae=indices.itae * _factor(ITAE, scale), further=further)


def _scaled_spread(spread: Spread, scale: float) -> Spread:
    def scaled(quartiles: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        factors = {key: _factor(QUANTITIES[key], scale) for key in quartiles}
        return {k: (low * factors[k], high * factors[k]) for k, (low, high) in quartiles.items()}

    quartiles = {joint: scaled(values) for joint, values in spread.quartiles.items()}
    return replace(spread, quartiles=quartiles)

"""The same numbers with angles in degrees, or in radians again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from hpid_ros.analysis.quantities import (
    ANGLE_UNITS,
    DEGREES_PER_RADIAN,
    ERROR_L2,
    ITAE,
    QUANTITIES,
    Quantity,
)
from hpid_ros.analysis.results import JointIndices, RunIndices, Spread
from hpid_ros.base.errors import unknown_name
from hpid_ros.recordings.series import SeriesError


def with_angles_in(run: RunIndices, angle_unit: str) -> RunIndices:
    """Return a run's numbers with angles in another unit; its conditions stay in rad.

    Args:
        run: The numbers.
        angle_unit: ``"rad"`` or ``"deg"``.

    Raises:
        SeriesError: It is another unit.
    """
    if angle_unit not in ANGLE_UNITS:
        raise SeriesError(unknown_name("unit of angles", angle_unit, ANGLE_UNITS))
    if angle_unit == run.angle_unit:
        return run
    scale = DEGREES_PER_RADIAN if angle_unit == "deg" else 1.0 / DEGREES_PER_RADIAN
    return replace(
        run,
        joints={name: _scaled(indices, scale) for name, indices in run.joints.items()},
        totals=_scaled(run.totals, scale),
        error_l2=run.error_l2 * _factor(ERROR_L2, scale),
        spread=None if run.spread is None else _scaled_spread(run.spread, scale),
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

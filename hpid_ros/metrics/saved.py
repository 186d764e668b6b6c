"""Saved numbers read again, and numbers in other units."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hpid_ros.base.errors import unknown_name
from hpid_ros.messages.series import SeriesError
from hpid_ros.metrics.quantities import (
    ANGLE_UNITS,
    DEGREES_PER_RADIAN,
    ERROR_L2,
    INDICES,
    ITAE,
    NORMS,
    QUANTITIES,
    Data,
    Quantity,
    folded,
)
from hpid_ros.metrics.results import Conditions, JointIndices, RunIndices, Spread


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
    """Return the numbers where some or all joints slide: these are left, totals folded again."""
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


def runs_from_mapping(document: object, where: str) -> tuple[RunIndices, ...]:
    """Return the runs of a saved comparison, the baseline first."""
    content = document.get("indices", document) if isinstance(document, Mapping) else None
    runs = content.get("runs") if isinstance(content, Mapping) else None
    if not isinstance(runs, Mapping) or not runs:
        raise SeriesError(
            f"{where} holds no saved indices: it is neither a result.json nor made by --save"
        )
    try:
        return tuple(_run(str(label), run) for label, run in runs.items())
    except SeriesError as error:
        raise SeriesError(f"{where}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SeriesError(f"{where} is damaged: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    return f"no entry {error}" if isinstance(error, KeyError) else str(error)


def _run(label: str, entry: Mapping[str, Any]) -> RunIndices:
    units = entry["units"]
    slides = _slides(label, entry)
    are_slides = [name in slides for name in entry["joints"]]
    angle_unit = _angle_unit(label, units, are_slides)
    quantities = tuple(QUANTITIES[key] for key in QUANTITIES if key in units)
    for quantity in quantities:
        unit = quantity.unit_in(angle_unit, are_slides)
        if units[quantity.key] != unit:
            raise SeriesError(
                f"run {label!r}: {quantity.key} is in {units[quantity.key]}, but must be in {unit}"
            )
    lacking = {
        str(joint): {Data(name): str(reason) for name, reason in reasons.items()}
        for joint, reasons in entry.get("lacking", {}).items()
    }
    joints = {
        str(name): _indices(values, lacking.get(name, {}))
        for name, values in entry["joints"].items()
    }
    if not joints:
        raise SeriesError(f"run {label!r} has no joint")
    missing = {data for reasons in lacking.values() for data in reasons}
    return RunIndices(
        label=label,
        joints=joints,
        totals=_indices(entry["totals"], missing),
        **{quantity.key: _entry(entry, quantity, missing) for quantity in NORMS},
        quantities=quantities,
        conditions=_conditions(entry.get("conditions")),
        spread=_spread(entry),
        angle_unit=angle_unit,
        lacking=lacking,
        assumed={Data(name): str(text) for name, text in entry.get("assumed", {}).items()},
        cut=str(entry.get("cut", "")),
        slides=slides,
    )


def _slides(label: str, entry: Mapping[str, Any]) -> frozenset[str]:
    slides = frozenset(map(str, entry.get("slides", ())))
    for name in sorted(slides):
        if name not in entry["joints"]:
            raise SeriesError(f"run {label!r}: {unknown_name('joint', name, entry['joints'])}")
    return slides


def _angle_unit(label: str, units: Mapping[str, str], are_slides: Sequence[bool]) -> str:
    known = {ITAE.unit_in(angle_unit, are_slides): angle_unit for angle_unit in ANGLE_UNITS[::-1]}
    if units["itae"] in known:
        return known[units["itae"]]
    raise SeriesError(
        f"run {label!r}: itae is in {units['itae']!r}, but must be in "
        f"{' or '.join(reversed(known))}"
    )


def _number(value: object) -> float:
    """Return a saved number: None was an infinite one."""
    if value is None:
        return math.inf
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} is no number")
    return float(value)


def _entry(values: Mapping[str, object], quantity: Quantity, missing: Collection[Data]) -> float:
    """Return a number that must be there unless the run lacks what it needs."""
    if quantity.needs in missing and quantity.key not in values:
        return math.nan
    return _number(values[quantity.key])


def _indices(values: Mapping[str, object], missing: Collection[Data]) -> JointIndices:
    core = {quantity.key: _entry(values, quantity, missing) for quantity in INDICES}
    further = {k: _number(v) for k, v in values.items() if k in QUANTITIES and k not in core}
    return JointIndices(**core, further=further)


def _conditions(entry: Mapping[str, Any] | None) -> Conditions | None:
    if entry is None:
        return None
    references = {
        str(name): tuple(_number(knot) for knot in knots)
        for name, knots in entry["references"].items()
    }
    return Conditions(
        duration=_number(entry["duration"]),
        period=_number(entry["period"]),
        cutoff=_number(entry["cutoff"]),
        references=references,
        clock=str(entry.get("clock", "header")),
    )


def _spread(entry: Mapping[str, Any]) -> Spread | None:
    if "repeats" not in entry:
        return None
    quartiles = {
        None if scope == "totals" else scope.removeprefix("joints."): {
            key: (_number(low), _number(high)) for key, (low, high) in values.items()
        }
        for scope, values in entry["quartiles"].items()
    }
    return Spread(int(entry["repeats"]), quartiles)

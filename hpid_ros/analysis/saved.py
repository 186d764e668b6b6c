"""Numbers that were saved, read again: the inverse of the mappings that results give."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from hpid_ros.analysis.conditions import Conditions
from hpid_ros.analysis.quantities import (
    ANGLE_UNITS,
    INDICES,
    ITAE,
    NORMS,
    QUANTITIES,
    Data,
    Quantity,
)
from hpid_ros.analysis.results import JointIndices, RunIndices, Spread
from hpid_ros.base.errors import unknown_name
from hpid_ros.recordings.series import SeriesError


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

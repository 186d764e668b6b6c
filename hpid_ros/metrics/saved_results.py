"""Saved numbers of runs, read again."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from hpid_ros.base.errors import unknown_name
from hpid_ros.messages.series import SeriesError
from hpid_ros.metrics.conditions import Conditions
from hpid_ros.metrics.quantities import (
    ANGLE_UNITS,
    INDICES,
    ITAE,
    L2_NORMS,
    QUANTITIES,
    Data,
    Quantity,
)
from hpid_ros.metrics.results import RunIndices, Spread


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
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)
        raise SeriesError(f"{where} is damaged: {reason}") from None


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
        totals=_indices(entry["totals"], missing) | _numbers(entry, L2_NORMS, missing),
        quantities=quantities,
        conditions=_conditions(
            entry.get("conditions"),
            [name for name in joints if Data.EFFORT not in lacking.get(name, {})],
        ),
        spread=_spread(entry),
        angle_unit=angle_unit,
        lacking=lacking,
        assumed={Data(name): str(text) for name, text in entry.get("assumed", {}).items()},
        against={str(k): str(v) for k, v in entry.get("against", {}).items()},
        cut=str(entry.get("cut", "")),
        shift=None if entry.get("shift") is None else _number(entry["shift"]),
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


def _numbers(
    values: Mapping[str, object], quantities: Iterable[Quantity], missing: Collection[Data]
) -> dict[str, float]:
    """Return numbers that must be there unless the run lacks what they need."""
    return {
        each.key: _number(values[each.key])
        for each in quantities
        if each.needs not in missing or each.key in values
    }


def _indices(values: Mapping[str, object], missing: Collection[Data]) -> dict[str, float]:
    further = {k: _number(v) for k, v in values.items() if k in QUANTITIES}
    return _numbers(values, INDICES, missing) | further


def _conditions(entry: Mapping[str, Any] | None, with_efforts: Sequence[str]) -> Conditions | None:
    if entry is None:
        return None
    usual, odd = (entry["duration"], entry["period"]), entry.get("efforts", {})
    efforts = {name: odd.get(name, usual) for name in with_efforts}
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
        efforts={k: (_number(time), _number(period)) for k, (time, period) in efforts.items()},
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

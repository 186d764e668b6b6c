"""The table of two engines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hpid_bench.report.table import NOTHING, Grid
from hpid_ros.base.text import csv_text
from hpid_ros.metrics.comparison import EngineTotal, median
from hpid_ros.metrics.quantities import (
    PAPER,
)
from hpid_ros.metrics.texts import format_ratio, format_values

NAMES: Mapping[str, str] = {"pybullet": "PyBullet", "mujoco": "MuJoCo"}  # engines

_PLAIN = 10.0  # percent; above it decimals say nothing


def engine_grids(totals: Sequence[EngineTotal], note: str) -> list[Grid]:
    """Return the distances of the paper's indices, then of each experiment all numbers."""
    experiments = dict.fromkeys(total.experiment for total in totals)
    return [
        _summary(totals, note),
        *(_details([t for t in totals if t.experiment == each], note) for each in experiments),
    ]


def engines_csv(totals: Sequence[EngineTotal]) -> str:
    """Return every number of every seed in both engines, at full precision."""
    engines = tuple(totals[0].values)
    names = ("experiment", "controller", "seed", "quantity", "unit")
    rows: list[list[object]] = [[*names, *engines, "distance"]]
    for total in totals:
        columns = (*total.values.values(), total.distances)
        for seed in sorted({seed for each in columns for seed in each}):
            run = (total.experiment, total.controller, seed)
            cells = (each.get(seed, "") for each in columns)
            rows.append([*run, total.quantity.key, total.unit, *cells])
    return csv_text(rows)


def format_distance(distance: float | None) -> str:
    """Return a distance in percent, with its sign: +0.120 %."""
    if distance is None:
        return NOTHING
    percent = 100.0 * distance
    if not math.isfinite(percent):
        return "inf"
    return f"{percent:+.3f} %" if abs(percent) < _PLAIN else f"{percent:+.1f} %"


def _summary(totals: Sequence[EngineTotal], note: str) -> Grid:
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for total in totals:
        cells = rows.setdefault((total.experiment, total.controller), {})
        cells[total.quantity.key] = format_distance(total.distance)
    first, second = _names(totals)
    return Grid(
        "engines",
        f"How far {second}'s totals lie from {first}'s",
        ("experiment", "controller", *(q.symbol for q in PAPER)),
        tuple(
            (*names, *(cells.get(quantity.key, NOTHING) for quantity in PAPER))
            for names, cells in rows.items()
        ),
        f"{second} / {first} with the same seed, less 1; medians over the seeds. {note}",
    )


def _details(totals: Sequence[EngineTotal], note: str) -> Grid:
    first, second = _names(totals)
    name = totals[0].experiment
    is_repeated = any(len(total.distances) > 1 for total in totals)
    largest = ", its median and the largest of any seed" if is_repeated else ""
    return Grid(
        f"engines {name}",
        f"{name}: both engines",
        (
            *("index", "controller", first, second, "distance"),
            *(("largest",) if is_repeated else ()),
            *(f"ratio, {each}" for each in (first, second)),
        ),
        tuple(_row(total, is_repeated=is_repeated) for total in totals),
        f"{'Medians; d' if is_repeated else 'D'}istance: {second} / {first} with the same seed, "
        f"less 1{largest}; ratio: to the first controller in the same engine. {note}",
    )


def _row(total: EngineTotal, *, is_repeated: bool) -> tuple[str, ...]:
    medians = [median(list(each.values())) for each in total.values.values()]
    texts = iter(format_values([each for each in medians if each is not None]))
    values = [NOTHING if each is None else next(texts) for each in medians]
    ratios = [median(list(total.ratios.get(engine, {}).values())) for engine in total.values]
    return (
        f"{total.quantity.symbol} [{total.unit}]",
        total.controller,
        *values,
        format_distance(total.distance),
        *((format_distance(total.largest_distance),) if is_repeated else ()),
        *(NOTHING if each is None else format_ratio(each) for each in ratios),
    )


def _names(totals: Sequence[EngineTotal]) -> tuple[str, ...]:
    return tuple(NAMES.get(engine, engine) for engine in totals[0].values)

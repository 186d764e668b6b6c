"""A sweep: run, result and table."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from rich.box import SIMPLE
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from hpid_ros.base.console import plain_console
from hpid_ros.base.text import csv_text
from hpid_ros.base.units import unit_over
from hpid_ros.experiment.batch import Outcome, Runner
from hpid_ros.experiment.result_folder import EXPERIMENT, ResultFolder, versions
from hpid_ros.experiment.sweep import Row, Sweep, shown
from hpid_ros.metrics.comparison import ratio, verdict
from hpid_ros.metrics.quantities import EFFORT_L2, ERROR_L2, IAVC, ITAE, IVC, Quantity
from hpid_ros.report.table import (
    ASCII_MARKS,
    MARKS,
    STYLES,
    UNLIMITED_WIDTH,
    TableColumn,
    WideTable,
    format_ratio,
    format_values,
    slides_note,
)

QUANTITIES = (IVC, IAVC, ITAE, EFFORT_L2, ERROR_L2)
"""What a sweep shows of a run."""


class Quartiles(NamedTuple):
    """Where the runs of several seeds lie."""

    first: float  # a quarter of them is below
    median: float  # half of them is below
    third: float  # three quarters are below

    @classmethod
    def of(cls, values: Sequence[float]) -> Quartiles | None:
        """Return those of some numbers, linear between neighbours; None of none."""
        if not values:
            return None
        if not all(math.isfinite(value) for value in values):
            return cls(math.inf, math.inf, math.inf)  # a ratio to a baseline of zero
        return cls(*(float(each) for each in np.quantile(values, (0.25, 0.5, 0.75))))


@dataclass(frozen=True)
class SweepResult:
    """What a sweep gave."""

    sweep: Sweep  # what was run
    outcomes: Mapping[tuple[int, int], Outcome]  # of each run, by place of the row and seed

    def numbers(self, place: int, quantity: Quantity) -> dict[int, float]:
        """Return one number of a row's runs by seed; failed runs have none."""
        found = ((seed, self.outcomes.get((place, seed))) for seed in self.sweep.seeds)
        return {
            seed: outcome.indices.value(quantity)
            for seed, outcome in found
            if outcome is not None and outcome.indices is not None
        }

    def quartiles(self, place: int, quantity: Quantity) -> Quartiles | None:
        """Return one number of a row over its seeds; None if no run gave it."""
        return Quartiles.of(list(self.numbers(place, quantity).values()))

    def ratios(self, place: int, quantity: Quantity) -> Quartiles | None:
        """Return a row's ratio to its baseline over the seeds; None for a baseline.

        Each run is divided by the baseline's run with the same seed, before the median.
        """
        baseline = self.sweep.rows[place].baseline
        if baseline is None:
            return None
        against = self.numbers(baseline, quantity)
        own = self.numbers(place, quantity)
        return Quartiles.of([ratio(own[seed], against[seed]) for seed in own if seed in against])

    def note(self, place: int) -> str:
        """Return in one line what did not run of a row; empty if everything did."""
        row = self.sweep.rows[place]
        if row.refusal:
            return f"refused: {row.refusal}"
        seeds = self.sweep.seeds
        found = [o for seed in seeds if (o := self.outcomes.get((place, seed))) is not None]
        reasons = [outcome.failure for outcome in found if outcome.failure]
        notes = []
        if reasons:
            notes.append(f"{len(reasons)} of {len(seeds)} runs failed: {reasons[0]}")
        if len(found) < len(seeds):
            notes.append(f"{len(seeds) - len(found)} of {len(seeds)} runs were not made")
        return "; ".join(notes)

    @property
    def failures(self) -> int:
        """Number of runs that failed."""
        return sum(bool(outcome.failure) for outcome in self.outcomes.values())

    def runs_csv(self) -> str:
        """Return every run, one a row: row's place, controller, parameters, seed, numbers."""
        names = [axis.name for axis in self.sweep.axes]
        keys = [q.key for q in QUANTITIES]
        rows: list[list[object]] = [["row", "controller", *names, "seed", *keys, "failure"]]
        for place, row in enumerate(self.sweep.rows):
            lead: list[object] = [place, row.label, *(row.values.get(name, "") for name in names)]
            if row.refusal:
                rows.append([*lead, "", *[""] * len(QUANTITIES), f"refused: {row.refusal}"])
            for seed in () if row.refusal else self.sweep.seeds:
                outcome = self.outcomes.get((place, seed))
                if outcome is not None:
                    rows.append([*lead, seed, *_numbers(outcome), outcome.failure])
        return csv_text(rows)

    def summary_csv(self) -> str:
        """Return every row with medians, quartiles and ratios, at full precision."""
        names = [axis.name for axis in self.sweep.axes]
        parts = ("median", "first_quartile", "third_quartile", "ratio")
        numbers = [f"{q.key}_{part}" for q in QUANTITIES for part in parts]
        rows: list[list[object]] = [["controller", *names, *numbers, "note"]]
        for place, row in enumerate(self.sweep.rows):
            cells: list[object] = [row.label, *(row.values.get(name, "") for name in names)]
            for quantity in QUANTITIES:
                own, ratios = self.quartiles(place, quantity), self.ratios(place, quantity)
                cells += ["", "", ""] if own is None else [own.median, own.first, own.third]
                cells.append("" if ratios is None else ratios.median)
            rows.append([*cells, self.note(place)])
        return csv_text(rows)

    def as_mapping(self) -> dict[str, object]:
        """Return everything that the experiment and the grid determine, ready for JSON."""
        sweep, experiment = self.sweep, self.sweep.experiment
        return {
            "experiment": experiment.name,
            "sha256": experiment.digest,
            "duration": experiment.duration,
            "control_period": experiment.world.control_period_ns * 1e-9,
            "versions": versions(),
            "baseline": sweep.baseline,
            "controller": sweep.controller,
            "joints": list(sweep.joints or experiment.world.joints),
            "seeds": list(sweep.seeds),
            "vary": {axis.name: list(axis.values) for axis in sweep.axes},
            "runs": {"planned": len(sweep.tasks()), "made": len(self.outcomes)},
            "units": {q.key: unit_over(q.unit, sweep.are_slides) for q in QUANTITIES},
            "rows": [self._row(place, row) for place, row in enumerate(sweep.rows)],
            "parameters": {
                label: {each.joint: dict(each.to_parameters()) for each in settings}
                for label, settings in experiment.controllers.items()
                if label in (sweep.baseline, sweep.controller)
            },
        }

    def _row(self, place: int, row: Row) -> dict[str, object]:
        return {
            "controller": row.label,
            "values": dict(row.values),
            "baseline": row.baseline,
            "note": self.note(place),
            "indices": {q.key: plain_quartiles(self.quartiles(place, q)) for q in QUANTITIES},
            "ratios": {q.key: plain_quartiles(self.ratios(place, q)) for q in QUANTITIES},
        }

    def json(self) -> str:
        """Return :meth:`as_mapping` as JSON text."""
        return json.dumps(self.as_mapping(), indent=2) + "\n"


def _numbers(outcome: Outcome) -> list[object]:
    if outcome.indices is None:
        return [""] * len(QUANTITIES)
    return [outcome.indices.value(quantity) for quantity in QUANTITIES]


def plain_quartiles(quartiles: Quartiles | None) -> dict[str, float | None] | None:
    """Return quartiles for JSON, which knows no infinity."""
    if quartiles is None:
        return None
    return {k: v if math.isfinite(v) else None for k, v in quartiles._asdict().items()}


_NOTHING = "-"


class SweepTable:
    """Rows are points; columns are parameters, then median, quartiles and ratio of each index.

    Indices stand side by side as far as the width allows.
    """

    def __init__(self, result: SweepResult) -> None:
        self.result = result

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        sweep, is_ascii = self.result.sweep, options.ascii_only
        names = [TableColumn("controller", [_label(row) for row in sweep.rows], is_text=True)]
        for axis in sweep.axes:
            values = [row.values.get(axis.name) for row in sweep.rows]
            texts = [Text(_NOTHING if each is None else shown(each)) for each in values]
            names.append(TableColumn(axis.name, texts))
        columns = [
            TableColumn(*each)
            for quantity in QUANTITIES
            for each in self._columns(quantity, is_ascii)
        ]
        notes = [Text(self.result.note(place)) for place in range(len(sweep.rows))]
        if any(notes):
            columns.append(TableColumn("note", notes, is_text=True))
        yield WideTable(names, columns, box=SIMPLE)
        yield self._legend()

    def _columns(self, quantity: Quantity, is_ascii: bool) -> list[tuple[str, list[Text]]]:
        places = range(len(self.result.sweep.rows))
        own = [self.result.quartiles(place, quantity) for place in places]
        ratios = [self.result.ratios(place, quantity) for place in places]
        numbers = iter(format_values([x for each in own if each for x in each]))
        texts = [None if each is None else [next(numbers) for _ in each] for each in own]
        dash = "-" if is_ascii else "–"
        return [
            (self._heading(quantity), _cells(t[1] if t else None for t in texts)),
            ("quartiles", _cells(f"{t[0]}{dash}{t[2]}" if t else None for t in texts)),
            ("ratio", [_ratio(each, is_ascii) for each in ratios]),
        ]

    def _heading(self, quantity: Quantity) -> str:
        return f"{quantity.symbol} [{unit_over(quantity.unit, self.result.sweep.are_slides)}]"

    def _legend(self) -> Text:
        sweep = self.result.sweep
        count = len(sweep.seeds)
        joints = ", ".join(sweep.joints) or f"all {len(sweep.experiment.world.joints)} joints"
        note = slides_note(sweep.judged, sweep.experiment.slides)
        lines = [
            f"Medians and quartiles over {count} seed{'s' * (count > 1)}, totals over {joints}.",
            f"Ratio: run / {sweep.baseline} with the same seed on the same robot; median.",
            note,
        ]
        return Text("\n".join(filter(None, lines)), style="dim")


def sweep_text(result: SweepResult) -> str:
    """Return the table as plain text, one line a row however long it is."""
    console = plain_console(UNLIMITED_WIDTH)
    with console.capture() as capture:
        console.print(SweepTable(result))
    lines = (line.rstrip() for line in capture.get().splitlines())
    return "\n".join(lines).strip("\n") + "\n"


def _label(row: Row) -> Text:
    return Text(row.label if row.baseline is not None else f"{row.label} (baseline)")


def _cells(texts: Iterable[str | None]) -> list[Text]:
    return [Text(_NOTHING if each is None else each) for each in texts]


def _ratio(ratios: Quartiles | None, is_ascii: bool) -> Text:
    if ratios is None:
        return Text(_NOTHING)
    kind = verdict(ratios.median)
    marks = ASCII_MARKS if is_ascii else MARKS
    return Text(f"{format_ratio(ratios.median)}{marks[kind]}", style=STYLES[kind])


def run_sweep(
    sweep: Sweep, folder: ResultFolder, run: Runner, advanced: Callable[[Outcome], None]
) -> SweepResult:
    """Run every row with every seed, and save what was run, also when interrupted."""
    folder.write(EXPERIMENT, sweep.experiment.text)
    tasks = sweep.tasks()
    keys = tuple(tasks)
    outcomes: dict[tuple[int, int], Outcome] = {}
    result = SweepResult(sweep, outcomes)
    try:
        with closing(run(tuple(tasks.values()))) as batch:
            for outcome in batch:
                outcomes[keys[outcome.place]] = outcome
                advanced(outcome)
    finally:
        save(result, folder)
    return result


def save(result: SweepResult, folder: ResultFolder) -> None:
    """Write every run, the summary and the table."""
    folder.write("sweep.csv", result.runs_csv())
    folder.write("sweep.json", result.json())
    folder.write("table.txt", sweep_text(result))

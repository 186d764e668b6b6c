"""A grid over a controller's parameters and over seeds: axes, rows, runs, result and table."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

from rich.box import SIMPLE
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from hpid_bench.experiment.batch import TOTAL, Runner, RunRecord, RunTable, RunTask
from hpid_bench.experiment.description import Experiment, with_robot
from hpid_bench.experiment.result_folder import EXPERIMENT, ResultFolder, versions
from hpid_bench.report.table import (
    ASCII_MARKS,
    NO_NUMBER,
    TableColumn,
    WideTable,
    styled,
    tables_text,
)
from hpid_ros.base.errors import HpidError, SettingError, require_known
from hpid_ros.base.text import csv_text
from hpid_ros.base.units import unit_over
from hpid_ros.control.settings import PARAMETERS, LoopSettings
from hpid_ros.metrics.quantities import PAPER
from hpid_ros.metrics.texts import MARKS, format_values, ratio_cell, slides_note
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.settings import WorldSettings

AxisValue = float | str

WORLD_SETTINGS = {
    "payload": "payload_mass",
    "physics_steps": "physics_steps",
    "encoder_counts": "encoder_counts",
}
"""Settings of the simulated robot that can be varied, and their names in ``WorldSettings``."""

LARGEST_COUNT = 10_000
_FORMS = "NAME=START:STOP:COUNT or NAME=VALUE,VALUE,..."


@dataclass(frozen=True)
class Axis:
    name: str  # a loop's parameter or one of WORLD_SETTINGS
    values: tuple[AxisValue, ...]  # its values, each once, in the order given

    @classmethod
    def parse(cls, text: str) -> Axis:
        name, _, rest = (part.strip() for part in text.partition("="))
        names = [*(each for each in PARAMETERS if each != "joint"), *WORLD_SETTINGS]
        try:
            if not name or not rest:
                raise SettingError(f"it must be {_FORMS}")
            require_known("parameter", [name], names)
            known = PARAMETERS.get(name)
            if known is not None and isinstance(known.default, str | bool):
                read = {"true": True, "false": False} if known.kind is bool else {}
                parts = [part.strip() for part in rest.split(",")]
                values = tuple(known.checked(read.get(part, part)) for part in parts)
            else:
                values = _numbers(rest)
            if len(set(values)) < len(values):
                doubled = next(value for value in values if values.count(value) > 1)
                raise SettingError(f"{value_text(doubled)} is there twice")
        except SettingError as error:
            raise SettingError(f"--vary {text!r}: {error}") from None
        return cls(name, values)


def value_text(value: AxisValue) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return value if isinstance(value, str) else f"{value:.12g}"


def _numbers(text: str) -> tuple[AxisValue, ...]:
    if ":" not in text:
        return tuple(_number(part) for part in text.split(","))
    parts = text.split(":")
    if len(parts) != 3:
        raise SettingError("a range must be START:STOP:COUNT")
    start, stop = (Fraction(repr(_number(part))) for part in parts[:2])
    count = _number(parts[2])
    if count != int(count) or not 2 <= count <= LARGEST_COUNT:
        raise SettingError(
            f"COUNT must be a whole number from 2 to {LARGEST_COUNT}, not {parts[2]}"
            + ("; for one value write NAME=VALUE" if count == 1.0 else "")
        )
    # Exact, and rounded once: the middle of -0.3:0.3:7 is 0 and its neighbour is 0.1.
    step = (stop - start) / (int(count) - 1)
    return tuple(float(start + k * step) for k in range(int(count)))


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise SettingError(f"{text.strip()!r} is not a number") from None
    if not math.isfinite(value):
        raise SettingError(f"{text.strip()} is not finite")
    return value


@dataclass(frozen=True)
class Row:
    """One point of the grid, or the baseline on one of the grid's robots."""

    label: str  # the controller's label
    values: Mapping[str, AxisValue]  # the varied parameters that it sets, by name
    baseline: int | None  # place among the rows of what it is measured against
    world: WorldSettings  # the robot; its seed is that of the experiment
    loops: tuple[LoopSettings, ...] = ()  # settings of each driven joint
    refusal: str = ""  # why it cannot run, in one line; empty if it can

    @property
    def name(self) -> str:
        """The row in a few words."""
        return " ".join([self.label, *(f"{k}={value_text(v)}" for k, v in self.values.items())])


def rows_of(
    experiment: Experiment, axes: Sequence[Axis], controller: str, joints: Sequence[str]
) -> tuple[Row, ...]:
    """Return a baseline for each robot of a grid, then the grid's points."""
    robots = _combinations([axis for axis in axes if axis.name in WORLD_SETTINGS])
    baselines = [_baseline(experiment, robot) for robot in robots]
    places = {tuple(robot.values()): place for place, robot in enumerate(robots)}
    points = []
    for values in _combinations(axes):
        place = places[tuple(value for k, value in values.items() if k in WORLD_SETTINGS)]
        point = replace(
            baselines[place], label=controller, values=values, baseline=place, loops=()
        )
        points.append(point if point.refusal else _varied(point, experiment, joints))
    return (*baselines, *points)


def _combinations(axes: Sequence[Axis]) -> list[dict[str, AxisValue]]:
    names = [axis.name for axis in axes]
    grid = itertools.product(*(axis.values for axis in axes))
    return [dict(zip(names, values, strict=True)) for values in grid]


def _varied(point: Row, experiment: Experiment, joints: Sequence[str]) -> Row:
    """Return a point with its loops, or with the reason why there are none."""
    changes = {k: value for k, value in point.values.items() if k not in WORLD_SETTINGS}
    has_other_model = any(k == "compensation" or k.startswith("model.") for k in changes)
    loops = _on_robot(experiment.controllers[point.label], experiment.world, point.world)
    for place, each in enumerate(loops):
        if each.joint in joints or not joints:
            given = dict(each.to_parameters())
            if has_other_model and _has_inertia_of_model(each, experiment):
                given["inertia"] = 0.0
            try:
                varied = LoopSettings.from_parameters(given | changes)
                loops[place] = with_robot(varied, point.world, experiment.description)
            except HpidError as error:
                return replace(point, refusal=f"{each.joint}: {error}")
    return replace(point, loops=tuple(loops))


def _has_inertia_of_model(loop: LoopSettings, experiment: Experiment) -> bool:
    if not loop.model.is_decoupling:
        return False
    bare = replace(loop, inertia=0.0)
    return with_robot(bare, experiment.world, experiment.description).inertia == loop.inertia


def _baseline(experiment: Experiment, values: Mapping[str, AxisValue]) -> Row:
    label, world = experiment.baseline, experiment.world
    try:
        changed = _changed_world(world, values, experiment.description)
        return Row(
            label,
            values,
            None,
            changed,
            tuple(_on_robot(experiment.controllers[label], world, changed)),
        )
    except HpidError as error:
        return Row(label, values, None, world, refusal=str(error))


def _changed_world(
    world: WorldSettings, values: Mapping[str, AxisValue], description: RobotDescription
) -> WorldSettings:
    changes: dict[str, Any] = {}
    for name, value in values.items():
        if name != "payload":
            if float(value) != int(value):
                raise SettingError(f"{name} must be a whole number, not {value}")
            value = int(value)
        changes[WORLD_SETTINGS[name]] = value
    changed = replace(world, **changes)
    _ = changed.encoders  # which are checked when they are made
    if changed.payload_mass:
        description.link(changed.payload_link)
    return changed


def _on_robot(
    loops: Sequence[LoopSettings], before: WorldSettings, after: WorldSettings
) -> list[LoopSettings]:
    """Return loops that know the encoder of the robot as they knew that of the one before."""
    known = []
    for each, old, new in zip(loops, before.encoders, after.encoders, strict=True):
        is_as_fitted = each.encoder.encoder_resolution == old.resolution
        fitted = {"encoder_resolution": new.resolution} if is_as_fitted else {}
        known.append(each.with_parameters(fitted))
    return known


LARGEST_SWEEP = 1_000_000  # runs of one sweep at most


@dataclass(frozen=True)
class Sweep:
    experiment: Experiment  # gives the robot, the reference and the controllers
    axes: tuple[Axis, ...]  # what is varied; the last one varies fastest
    controller: str  # label of the controller that is varied
    joints: tuple[str, ...]  # the joints that are varied, and judged; empty for all
    seeds: tuple[int, ...]  # every row runs once with each
    rows: tuple[Row, ...]  # a baseline for each robot, then the points

    @property
    def are_slides(self) -> tuple[bool, ...]:
        """Of each judged joint whether it slides."""
        return self.experiment.are_slides(self.judged)

    @property
    def judged(self) -> tuple[str, ...]:
        return self.joints or self.experiment.world.joints

    def tasks(self) -> dict[tuple[int, int], RunTask]:
        """Return the runs by place of the row and seed; those on one robot side by side."""
        robots = [
            place if row.baseline is None else row.baseline for place, row in enumerate(self.rows)
        ]
        return {
            (place, seed): RunTask.seeded(
                self.experiment, row.name, seed, row.loops, self.joints, row.world
            )
            for place in sorted(range(len(self.rows)), key=robots.__getitem__)
            for row in (self.rows[place],)
            if not row.refusal
            for seed in self.seeds
        }


def plan_sweep(
    experiment: Experiment,
    axes: Sequence[Axis],
    *,
    controller: str | None = None,
    joints: Sequence[str] = (),
    seeds: int = 20,
) -> Sweep:
    """Lay out a grid, and check it as a whole before anything runs.

    Every point is measured against the experiment's first controller as it stands, on the same
    robot and with the same seeds. Points whose settings a loop refuses stay, with the reason.
    """
    labels = tuple(experiment.controllers)
    controller = controller or labels[min(1, len(labels) - 1)]
    require_known("controller", [controller], labels)
    require_known("joint", joints, experiment.world.joints)
    names = [axis.name for axis in axes]
    if not names:
        raise SettingError("nothing is varied: name at least one parameter")
    for name in names:
        if names.count(name) > 1:
            raise SettingError(f"{name} is varied twice")
    if seeds < 1:
        raise SettingError(f"seeds must be at least 1, not {seeds}")
    runs = seeds * math.prod(len(axis.values) for axis in axes)
    if runs > LARGEST_SWEEP:
        raise SettingError(f"{runs} runs are too many; at most {LARGEST_SWEEP}")
    is_homogeneous = any(each.is_homogeneous for each in experiment.controllers[controller])
    if "law" not in names and not is_homogeneous:
        for name in names:
            if name == "mu" or name.startswith("norm."):
                raise SettingError(
                    f"{name} has no effect on controller {controller!r}, whose law is pid"
                )
    chosen = tuple(joint for joint in experiment.world.joints if joint in joints)
    rows = rows_of(experiment, axes, controller, chosen)
    points = [row for row in rows if row.baseline is not None]
    if all(row.refusal for row in points):
        raise SettingError(f"no point can run; {points[0].name}: {points[0].refusal}")
    numbers = tuple(experiment.seed + k for k in range(seeds))
    return Sweep(experiment, tuple(axes), controller, chosen, numbers, rows)


@dataclass(frozen=True)
class SweepResult:
    sweep: Sweep  # what was run
    records: Mapping[tuple[object, ...], RunRecord]  # of each run, by place of the row and seed

    @cached_property
    def table(self) -> RunTable:
        """The numbers over the seeds, by ``(place,)`` of the row."""
        rows = self.sweep.rows
        return RunTable(
            {(place,): self.sweep.seeds for place in range(len(rows))},
            {(k,): (row.baseline,) for k, row in enumerate(rows) if row.baseline is not None},
            self.records,
        )

    def note(self, place: int) -> str:
        """Return in one line what did not run of a row; empty if everything did."""
        refusal = self.sweep.rows[place].refusal
        return f"refused: {refusal}" if refusal else self.table.note((place,))

    def runs_csv(self) -> str:
        """Return every run, one a row: row's place, controller, parameters, seed, numbers."""
        names = [axis.name for axis in self.sweep.axes]
        keys = [q.key for q in PAPER]
        rows: list[list[object]] = [["row", "controller", *names, "seed", *keys, "failure"]]
        for place, row in enumerate(self.sweep.rows):
            lead: list[object] = [place, row.label, *(row.values.get(name, "") for name in names)]
            if row.refusal:
                rows.append([*lead, "", *[""] * len(keys), f"refused: {row.refusal}"])
            for seed, record in self.table.of_row((place,)).items():
                numbers = record.numbers.get(TOTAL, {})
                rows.append([*lead, seed, *(numbers.get(k, "") for k in keys), record.failure])
        return csv_text(rows)

    def summary_csv(self) -> str:
        """Return every row with medians, quartiles and ratios, at full precision."""
        names = [axis.name for axis in self.sweep.axes]
        parts = ("median", "first_quartile", "third_quartile", "ratio")
        numbers = [f"{q.key}_{part}" for q in PAPER for part in parts]
        rows: list[list[object]] = [["controller", *names, *numbers, "note"]]
        for place, row in enumerate(self.sweep.rows):
            cells: list[object] = [row.label, *(row.values.get(name, "") for name in names)]
            for quantity in PAPER:
                own = self.table.quartiles((place,), quantity)
                ratios = self.table.ratios((place,), quantity)
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
            "baseline": experiment.baseline,
            "controller": sweep.controller,
            "joints": list(sweep.judged),
            "seeds": list(sweep.seeds),
            "vary": {axis.name: list(axis.values) for axis in sweep.axes},
            "runs": {"planned": len(sweep.tasks()), "made": len(self.records)},
            "units": {q.key: unit_over(q.unit, sweep.are_slides) for q in PAPER},
            "rows": [self._row(place, row) for place, row in enumerate(sweep.rows)],
            "parameters": {
                label: loops
                for label, loops in experiment.parameters().items()
                if label in (experiment.baseline, sweep.controller)
            },
        }

    def _row(self, place: int, row: Row) -> dict[str, object]:
        own = {q.key: self.table.quartiles((place,), q) for q in PAPER}
        ratios = {q.key: self.table.ratios((place,), q) for q in PAPER}
        return {
            "controller": row.label,
            "values": dict(row.values),
            "baseline": row.baseline,
            "note": self.note(place),
            "indices": {key: each and each.as_mapping() for key, each in own.items()},
            "ratios": {key: each and each.as_mapping() for key, each in ratios.items()},
        }

    def json(self) -> str:
        return json.dumps(self.as_mapping(), indent=2) + "\n"

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield a row a point: parameters, then median, quartiles and ratio of each index."""
        sweep, table = self.sweep, self.table
        dash, marks = ("-", ASCII_MARKS) if options.ascii_only else ("–", MARKS)
        labels = [f"{e.label} (baseline)" if e.baseline is None else e.label for e in sweep.rows]
        names = [TableColumn("controller", labels, is_text=True)]
        for axis in sweep.axes:
            values = [row.values.get(axis.name) for row in sweep.rows]
            texts = [NO_NUMBER if each is None else value_text(each) for each in values]
            names.append(TableColumn(axis.name, texts))
        columns = []
        for quantity in PAPER:
            own = [table.quartiles((place,), quantity) for place in range(len(sweep.rows))]
            ratios = [table.ratios((place,), quantity) for place in range(len(sweep.rows))]
            numbers = iter(format_values(x for each in own if each for x in each))
            spreads = [each and tuple(next(numbers) for _ in each) for each in own]
            columns += [
                TableColumn(
                    f"{quantity.symbol} [{unit_over(quantity.unit, sweep.are_slides)}]",
                    [each[1] if each else NO_NUMBER for each in spreads],
                ),
                TableColumn(
                    "quartiles",
                    [f"{each[0]}{dash}{each[2]}" if each else NO_NUMBER for each in spreads],
                ),
                TableColumn(
                    "ratio",
                    [styled(ratio_cell(x.median), marks) if x else NO_NUMBER for x in ratios],
                ),
            ]
        notes = [self.note(place) for place in range(len(sweep.rows))]
        if any(notes):
            columns.append(TableColumn("note", notes, is_text=True))
        yield WideTable(names, columns, box=SIMPLE)
        count, baseline = len(sweep.seeds), sweep.experiment.baseline
        joints = ", ".join(sweep.joints) or f"all {len(sweep.experiment.world.joints)} joints"
        lines = [
            f"Medians and quartiles over {count} seed{'s' * (count > 1)}, totals over {joints}.",
            f"Ratio: run / {baseline} with the same seed on the same robot; median.",
            slides_note(sweep.judged, sweep.experiment.slides),
        ]
        yield Text("\n".join(filter(None, lines)), style="dim")


def run_sweep(
    sweep: Sweep, folder: ResultFolder, run: Runner, advanced: Callable[[RunRecord], None]
) -> SweepResult:
    """Run every row with every seed, and save what was run, also when interrupted."""
    folder.write(EXPERIMENT, sweep.experiment.text)
    records: dict[tuple[object, ...], RunRecord] = {}
    result = SweepResult(sweep, records)
    try:
        with closing(run(sweep.tasks())) as batch:
            for key, record in batch:
                records[key] = record
                advanced(record)
    finally:
        folder.write("sweep.csv", result.runs_csv())
        folder.write("sweep.json", result.json())
        folder.write("table.txt", tables_text([result]))
    return result

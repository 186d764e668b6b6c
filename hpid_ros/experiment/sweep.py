"""A grid over a controller's parameters and over seeds: axes, rows, runs, result and table."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

from rich.box import SIMPLE
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from hpid_ros.base.console import plain_console
from hpid_ros.base.errors import HpidError, SettingError, unknown_name
from hpid_ros.base.text import csv_text
from hpid_ros.base.units import unit_over
from hpid_ros.control.settings import PARAMETERS, LoopSettings
from hpid_ros.experiment.batch import (
    PAPER_QUANTITIES,
    TOTAL,
    Outcome,
    Quartiles,
    Runner,
    RunRecord,
    RunTable,
    RunTask,
    joint_numbers,
)
from hpid_ros.experiment.description import Experiment, with_robot
from hpid_ros.experiment.result_folder import EXPERIMENT, ResultFolder, versions
from hpid_ros.metrics.comparison import verdict
from hpid_ros.metrics.quantities import Quantity
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
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.settings import WorldSettings

Value = float | str

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
    values: tuple[Value, ...]  # its values, each once, in the order given

    @classmethod
    def parse(cls, text: str) -> Axis:
        name, equals, rest = (part.strip() for part in text.partition("="))
        try:
            if not equals or not name or not rest:
                raise SettingError(f"it must be {_FORMS}")
            values = _texts(name, rest) if _is_text(name) else _numbers(rest)
            if len(set(values)) < len(values):
                doubled = next(value for value in values if values.count(value) > 1)
                raise SettingError(f"{shown(doubled)} is there twice")
        except SettingError as error:
            raise SettingError(f"--vary {text!r}: {error}") from None
        return cls(name, values)


def shown(value: Value) -> str:
    return value if isinstance(value, str) else f"{value:.12g}"


def _is_text(name: str) -> bool:
    names = [*(each for each in PARAMETERS if each != "joint"), *WORLD_SETTINGS]
    if name not in names:
        raise SettingError(unknown_name("parameter", name, names))
    return name in PARAMETERS and isinstance(PARAMETERS[name].default, str)


def _texts(name: str, text: str) -> tuple[Value, ...]:
    return tuple(PARAMETERS[name].checked(part.strip()) for part in text.split(","))


def _numbers(text: str) -> tuple[Value, ...]:
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
    values: Mapping[str, Value]  # the varied parameters that it sets, by name
    baseline: int | None  # place among the rows of what it is measured against
    world: WorldSettings  # the robot; its seed is that of the experiment
    loops: tuple[LoopSettings, ...] = ()  # settings of each driven joint
    refusal: str = ""  # why it cannot run, in one line; empty if it can

    @property
    def name(self) -> str:
        """The row in a few words."""
        return " ".join([self.label, *(f"{k}={shown(v)}" for k, v in self.values.items())])


def rows_of(
    experiment: Experiment, axes: Sequence[Axis], controller: str, joints: Sequence[str]
) -> tuple[Row, ...]:
    """Return a baseline for each robot of a grid, then the grid's points."""
    of_world = [axis for axis in axes if axis.name in WORLD_SETTINGS]
    robots = [_assigned(of_world, values) for values in _product(of_world)]
    baselines = [_baseline(experiment, robot) for robot in robots]
    places = {tuple(robot.values()): place for place, robot in enumerate(robots)}
    points = []
    for combination in _product(axes):
        values = _assigned(axes, combination)
        place = places[tuple(values[axis.name] for axis in of_world)]
        base = baselines[place]
        point = replace(base, label=controller, values=values, baseline=place, loops=())
        if not base.refusal:
            point = _varied(point, experiment, joints)
        points.append(point)
    return (*baselines, *points)


def _varied(point: Row, experiment: Experiment, joints: Sequence[str]) -> Row:
    """Return a point with its loops, or with the reason why there are none."""
    changes = {k: value for k, value in point.values.items() if k not in WORLD_SETTINGS}
    loops = []
    for each in _on_robot(experiment.controllers[point.label], experiment.world, point.world):
        if joints and each.joint not in joints:
            loops.append(each)
            continue
        try:
            varied = LoopSettings.from_parameters({**each.to_parameters(), **changes})
            loops.append(with_robot(varied, point.world))
        except HpidError as error:
            return replace(point, refusal=f"{each.joint}: {error}")
    return replace(point, loops=tuple(loops))


def _product(axes: Sequence[Axis]) -> itertools.product[tuple[Value, ...]]:
    return itertools.product(*(axis.values for axis in axes))


def _assigned(axes: Sequence[Axis], values: Sequence[Value]) -> dict[str, Value]:
    return {axis.name: value for axis, value in zip(axes, values, strict=True)}


def _baseline(experiment: Experiment, values: Mapping[str, Value]) -> Row:
    label, loops = next(iter(experiment.controllers.items()))
    world = experiment.world
    try:
        changed = _changed_world(world, values)
        return Row(label, values, None, changed, _on_robot(loops, world, changed))
    except HpidError as error:
        return Row(label, values, None, world, refusal=str(error))


def _changed_world(world: WorldSettings, values: Mapping[str, Value]) -> WorldSettings:
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
        RobotDescription.load(changed.robot_description).link(changed.payload_link)
    return changed


def _on_robot(
    loops: Sequence[LoopSettings], before: WorldSettings, after: WorldSettings
) -> tuple[LoopSettings, ...]:
    """Return loops that know the encoder of the robot as they knew that of the one before."""
    known = []
    for each, old, new in zip(loops, before.encoders, after.encoders, strict=True):
        is_as_fitted = each.encoder.resolution == old.resolution
        fitted = {"encoder_resolution": new.resolution} if is_as_fitted else {}
        known.append(each.with_parameters(fitted))
    return tuple(known)


LARGEST_SWEEP = 1_000_000
"""Runs of one sweep at most."""


@dataclass(frozen=True)
class Sweep:
    experiment: Experiment  # gives the robot, the reference and the controllers
    axes: tuple[Axis, ...]  # what is varied; the last one varies fastest
    controller: str  # label of the controller that is varied
    joints: tuple[str, ...]  # the joints that are varied, and judged; empty for all
    seeds: tuple[int, ...]  # every row runs once with each
    rows: tuple[Row, ...] = field(init=False)

    def __post_init__(self) -> None:
        rows = rows_of(self.experiment, self.axes, self.controller, self.joints)
        object.__setattr__(self, "rows", rows)

    @property
    def baseline(self) -> str:
        """Label of the experiment's first controller, as it stands."""
        return next(iter(self.experiment.controllers))

    @property
    def are_slides(self) -> tuple[bool, ...]:
        """Of each judged joint whether it slides."""
        return self.experiment.are_slides(self.judged)

    @property
    def judged(self) -> tuple[str, ...]:
        return self.joints or self.experiment.world.joints

    def tasks(self) -> dict[tuple[int, int], RunTask]:
        """Return the runs by place of the row and seed; those on one robot side by side."""
        tasks = {
            (place, seed): RunTask.seeded(
                self.experiment, row.name, seed, row.loops, self.joints, row.world
            )
            for place, row in enumerate(self.rows)
            if not row.refusal
            for seed in self.seeds
        }

        def robot(item: tuple[tuple[int, int], RunTask]) -> int:
            row = self.rows[item[0][0]]
            return item[0][0] if row.baseline is None else row.baseline

        return dict(sorted(tasks.items(), key=robot))


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
    if controller not in labels:
        raise SettingError(unknown_name("controller", controller, labels))
    for joint in joints:
        if joint not in experiment.world.joints:
            raise SettingError(unknown_name("joint", joint, experiment.world.joints))
    _check_size(axes, seeds)
    _require_effect(experiment.controllers[controller], controller, [a.name for a in axes])
    chosen = tuple(joint for joint in experiment.world.joints if joint in joints)
    numbers = tuple(experiment.seed + k for k in range(seeds))
    sweep = Sweep(experiment, tuple(axes), controller, chosen, numbers)
    points = [row for row in sweep.rows if row.baseline is not None]
    if all(row.refusal for row in points):
        raise SettingError(f"no point can run; {points[0].name}: {points[0].refusal}")
    return sweep


def _check_size(axes: Sequence[Axis], seeds: int) -> None:
    """Refuse grids that are none, or that nobody lives to see the end of."""
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


def _require_effect(loops: Sequence[LoopSettings], label: str, names: Sequence[str]) -> None:
    """Refuse to vary what the linear law does not know."""
    if "law" in names or any(each.law != "pid" for each in loops):
        return
    for name in names:
        if name == "mu" or name.startswith("norm."):
            raise SettingError(f"{name} has no effect on controller {label!r}, whose law is pid")


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
        keys = [q.key for q in PAPER_QUANTITIES]
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
        numbers = [f"{q.key}_{part}" for q in PAPER_QUANTITIES for part in parts]
        rows: list[list[object]] = [["controller", *names, *numbers, "note"]]
        for place, row in enumerate(self.sweep.rows):
            cells: list[object] = [row.label, *(row.values.get(name, "") for name in names)]
            for quantity in PAPER_QUANTITIES:
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
            "baseline": sweep.baseline,
            "controller": sweep.controller,
            "joints": list(sweep.judged),
            "seeds": list(sweep.seeds),
            "vary": {axis.name: list(axis.values) for axis in sweep.axes},
            "runs": {"planned": len(sweep.tasks()), "made": len(self.records)},
            "units": {q.key: unit_over(q.unit, sweep.are_slides) for q in PAPER_QUANTITIES},
            "rows": [self._row(place, row) for place, row in enumerate(sweep.rows)],
            "parameters": {
                label: {each.joint: dict(each.to_parameters()) for each in settings}
                for label, settings in experiment.controllers.items()
                if label in (sweep.baseline, sweep.controller)
            },
        }

    def _row(self, place: int, row: Row) -> dict[str, object]:
        own = {q.key: self.table.quartiles((place,), q) for q in PAPER_QUANTITIES}
        ratios = {q.key: self.table.ratios((place,), q) for q in PAPER_QUANTITIES}
        return {
            "controller": row.label,
            "values": dict(row.values),
            "baseline": row.baseline,
            "note": self.note(place),
            "indices": {key: each and each.as_mapping() for key, each in own.items()},
            "ratios": {key: each and each.as_mapping() for key, each in ratios.items()},
        }

    def json(self) -> str:
        """Return :meth:`as_mapping` as JSON text."""
        return json.dumps(self.as_mapping(), indent=2) + "\n"


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
            for quantity in PAPER_QUANTITIES
            for each in self._columns(quantity, is_ascii)
        ]
        notes = [Text(self.result.note(place)) for place in range(len(sweep.rows))]
        if any(notes):
            columns.append(TableColumn("note", notes, is_text=True))
        yield WideTable(names, columns, box=SIMPLE)
        yield self._legend()

    def _columns(self, quantity: Quantity, is_ascii: bool) -> list[tuple[str, list[Text]]]:
        places = range(len(self.result.sweep.rows))
        own = [self.result.table.quartiles((place,), quantity) for place in places]
        ratios = [self.result.table.ratios((place,), quantity) for place in places]
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
    records: dict[tuple[object, ...], RunRecord] = {}
    result = SweepResult(sweep, records)
    try:
        with closing(run(tuple(tasks.values()))) as batch:
            for outcome in batch:
                numbers = joint_numbers(outcome.indices)
                records[keys[outcome.place]] = RunRecord(numbers, outcome.failure)
                advanced(outcome)
    finally:
        folder.write("sweep.csv", result.runs_csv())
        folder.write("sweep.json", result.json())
        folder.write("table.txt", sweep_text(result))
    return result

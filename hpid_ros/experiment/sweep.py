"""A grid over a controller's parameters and over seeds: its axes, its rows, its runs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

from hpid_ros.base.errors import HpidError, SettingError, unknown_name
from hpid_ros.control.settings import PARAMETERS, LoopSettings
from hpid_ros.experiment.batch import RunTask
from hpid_ros.experiment.description import Experiment, with_robot
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
    """One direction of a grid."""

    name: str  # a loop's parameter or one of WORLD_SETTINGS
    values: tuple[Value, ...]  # its values, each once, in the order given

    @property
    def is_of_the_world(self) -> bool:
        """Whether the values are the robot's and not the controller's."""
        return self.name in WORLD_SETTINGS

    @classmethod
    def parse(cls, text: str) -> Axis:
        """Return the axis that a text says."""
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
    """Return a value as a person would write it."""
    return value if isinstance(value, str) else f"{value:.12g}"


def _is_text(name: str) -> bool:
    """Return whether a parameter is a text and no number."""
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
    of_world = [axis for axis in axes if axis.is_of_the_world]
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
    """Return the baseline on the robot of these values."""
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
    """Everything that decides a sweep's numbers."""

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
        """The joints that are judged."""
        return self.joints or self.experiment.world.joints

    def tasks(self) -> dict[tuple[int, int], RunTask]:
        """Return the runs by place of the row and seed; those on one robot side by side."""
        experiment = self.experiment
        tasks = {
            (place, seed): RunTask(
                f"{row.name} seed={seed}",
                replace(row.world, seed=seed),
                row.loops,
                experiment.trajectory,
                experiment.periods,
                self.joints,
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

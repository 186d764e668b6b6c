"""The rows of a sweep: the points of its grid, and what each of them is measured against."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hpid_ros.control import LoopSettings
from hpid_ros.errors import HpidError, SettingError
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.model_of_world import with_robot
from hpid_ros.experiment.sweep_axes import WORLD_SETTINGS, Axis, Value, shown
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation import WorldSettings


@dataclass(frozen=True)
class Row:
    """One point of the grid, or the baseline on one of the grid's robots.

    Attributes:
        label: The controller's label.
        values: The varied parameters that it sets, by name.
        baseline: Place among the rows of what it is measured against; None for a baseline.
        world: The robot; its seed is that of the experiment.
        loops: Settings of each driven joint; empty if they are refused.
        refusal: Why it cannot run, in one line; empty if it can.
    """

    label: str
    values: Mapping[str, Value]
    baseline: int | None
    world: WorldSettings
    loops: tuple[LoopSettings, ...] = ()
    refusal: str = ""

    @property
    def name(self) -> str:
        """The row in a few words."""
        return " ".join([self.label, *(f"{k}={shown(v)}" for k, v in self.values.items())])


def rows_of(
    experiment: Experiment, axes: Sequence[Axis], controller: str, joints: Sequence[str]
) -> tuple[Row, ...]:
    """Return a baseline for each robot of a grid, then the grid's points.

    Args:
        experiment: Gives the robot and the controllers; the first one is the baseline.
        axes: The directions of the grid; the last one varies fastest.
        controller: Label of the controller that is varied.
        joints: The joints that are varied; none for all.
    """
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
    except HpidError as error:
        return Row(label, values, None, world, refusal=str(error))
    return Row(label, values, None, changed, _on_robot(loops, world, changed))


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
        is_as_fitted = each.encoder_resolution == old.resolution
        known.append(replace(each, encoder_resolution=new.resolution) if is_as_fitted else each)
    return tuple(known)

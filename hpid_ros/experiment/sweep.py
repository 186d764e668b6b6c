"""A grid over the parameters of one controller of an experiment, and the runs that it needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from hpid_ros.control import LoopSettings
from hpid_ros.errors import SettingError, unknown_name
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.simulated_run import RunTask
from hpid_ros.experiment.sweep_axes import Axis
from hpid_ros.experiment.sweep_rows import Row, rows_of

LARGEST_SWEEP = 1_000_000
"""Runs of one sweep at most."""


@dataclass(frozen=True)
class Sweep:
    """Everything that decides a sweep's numbers.

    Attributes:
        experiment: Gives the robot, the reference and the controllers.
        axes: What is varied; the last one varies fastest.
        controller: Label of the controller that is varied.
        joints: The joints that are varied, and judged; empty for all.
        seeds: Every row runs once with each.
        rows: The baselines, then the points.
    """

    experiment: Experiment
    axes: tuple[Axis, ...]
    controller: str
    joints: tuple[str, ...]
    seeds: tuple[int, ...]
    rows: tuple[Row, ...] = field(init=False)

    def __post_init__(self) -> None:
        rows = rows_of(self.experiment, self.axes, self.controller, self.joints)
        object.__setattr__(self, "rows", rows)

    @property
    def baseline(self) -> str:
        """Label of the experiment's first controller, as it stands."""
        return next(iter(self.experiment.controllers))

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

    Args:
        experiment: The experiment.
        axes: What to vary, each name once.
        controller: Label of the controller to vary; if None, the first that is not the
            baseline, or else the only one.
        joints: Joints to vary and to judge; none for all.
        seeds: How many: the experiment's own and those that follow it.

    Raises:
        SettingError: A name is unknown or doubled, nothing is varied, no point can run, or
            there are more than :data:`LARGEST_SWEEP` runs.
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

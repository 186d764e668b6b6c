"""Runs of a batch on every core, each as an experiment's numbers; a table of such runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from hpid_bench.experiment.description import Experiment, following_loops
from hpid_ros.base.errors import HpidError
from hpid_ros.base.processes import raise_if_interrupted, side_by_side
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.series import RunSeries, complete_run
from hpid_ros.metrics.comparison import median_and_quartiles, ratio
from hpid_ros.metrics.quantities import CHATTER, ERROR_MAX, OVERSHOOT, PAPER, Fold, Quantity
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.motion.joint_trajectory import JointTrajectory
from hpid_ros.robot.compensation import compensators
from hpid_ros.simulation.engine import record_run
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

LAST = 1.0  # how much of the end of a run is looked at, in [s]; all of a shorter one

LAST_ERROR = Quantity(
    "last_error", "last |e|", "rad", "largest error of the last second", Fold.WORST, 1
)
BATCH_QUANTITIES: tuple[Quantity, ...] = (*PAPER, OVERSHOOT, ERROR_MAX, CHATTER, LAST_ERROR)

TOTAL = ""  # stands for all judged joints where a joint's name would be


class RunRecord(NamedTuple):
    """What is kept of a run: its numbers, or why it has none."""

    # of each joint, and of all under TOTAL, by the quantity's key; undefined ones are left out
    numbers: Mapping[str, Mapping[str, float]]
    failure: str = ""  # why it failed, in one line; empty if it did not

    def value(self, quantity: Quantity) -> float:
        """Return one number of all judged joints; nan if it is not defined."""
        return self.numbers[TOTAL].get(quantity.key, math.nan)


@dataclass(frozen=True)
class RunTask:
    """Everything that decides the numbers of one run."""

    label: str  # name of the run, also in the line that says why it failed
    world: WorldSettings  # the simulated robot
    loops: tuple[LoopSettings, ...]  # settings of each driven joint, in the world's order
    trajectory: JointTrajectory  # the reference of every joint
    periods: int  # control periods of the run; it has one state more
    joints: tuple[str, ...] = ()  # the joints that the numbers are of, totals and norms included

    @classmethod
    def of(cls, experiment: Experiment, label: str) -> RunTask:
        """Return the run of one of an experiment's controllers, as ``hpid compare`` makes it."""
        loops = experiment.controllers[label]
        return cls(label, experiment.world, loops, experiment.trajectory, experiment.periods)

    @classmethod
    def seeded(
        cls,
        experiment: Experiment,
        name: str,
        seed: int,
        loops: tuple[LoopSettings, ...],
        joints: tuple[str, ...] = (),
        world: WorldSettings | None = None,
    ) -> RunTask:
        """Return a run of an experiment with another seed, other loops, and perhaps robot."""
        world = replace(world or experiment.world, seed=seed)
        label = f"{name} seed={seed}"
        return cls(label, world, loops, experiment.trajectory, experiment.periods, joints)

    def record(self, run: RunSeries) -> RunRecord:
        """Return the numbers of the run that this task made."""
        if self.joints:
            chosen = tuple(series for series in run.joints if series.joint in self.joints)
            run = RunSeries(run.label, chosen)
        indices = run_indices(run)
        last = {}
        for series in run.joints:
            is_last = series.time >= series.time[-1] - LAST
            last[series.joint] = float(np.abs(series.error[is_last]).max())
        last[TOTAL] = max(last.values())
        numbers = {}
        for joint in (*indices.joints, TOTAL):
            values = {q.key: indices.value(q, joint or None) for q in BATCH_QUANTITIES[:-1]}
            values[LAST_ERROR.key] = last[joint]
            numbers[joint] = {key: value for key, value in values.items() if value == value}
        return RunRecord(numbers)


class WorldKeeper(AbstractContextManager["WorldKeeper"]):
    """Keeps the world of the last run for the next one.

    Building a world takes as long as a thousand physics steps, mostly settling on the ground;
    a reset takes none and gives the same numbers to the last bit.
    """

    def __init__(self) -> None:
        self._world: World | None = None

    def __exit__(self, *error: object) -> None:
        self.close()

    def at_start(self, settings: WorldSettings) -> World:
        """Return a world at time 0: the kept one where it differs by its seed at most."""
        kept = self._world
        if kept is not None and replace(kept.settings, seed=settings.seed) == settings:
            kept.reset(settings.seed)
            return kept
        self.close()
        self._world = World(settings)
        return self._world

    def close(self) -> None:
        """Let go of the kept world; a second call does nothing."""
        kept, self._world = self._world, None
        if kept is not None:
            kept.close()


def simulate_task(task: RunTask, keeper: WorldKeeper) -> RunSeries:
    loops = following_loops(task.loops, task.trajectory)
    try:
        models = compensators(task.loops, str(task.world.robot_description))
        world = keeper.at_start(task.world)
        stamps_ns, *columns = record_run(world, loops, task.periods, models)
        slides = world.description.slides
        return complete_run(task.label, task.world.joints, stamps_ns, columns, slides)
    except BaseException:
        keeper.close()
        raise


def simulated(task: RunTask, keeper: WorldKeeper) -> RunRecord:
    """Run a task and return its numbers: to the last bit those of ``hpid compare``."""
    return task.record(simulate_task(task, keeper))


def attempted(task: RunTask, keeper: WorldKeeper) -> RunRecord:
    """Run a task and return its numbers, or why it has none, whatever that is."""
    try:
        return simulated(task, keeper)
    except HpidError as error:
        return RunRecord({}, str(error))
    except Exception as error:  # one bad run of a thousand is named; the others are wanted
        return RunRecord({}, " ".join(f"{type(error).__name__}: {error}".split()))


RunRecords = Generator[tuple[Any, RunRecord], None, None]

Runner = Callable[[Mapping[Any, RunTask]], RunRecords]
"""Runs tasks, as :func:`run_batch` does; wherever that is, the numbers are the same."""

_keeper = WorldKeeper()  # of this process, which runs one task after the other


def _work(task: RunTask) -> RunRecord:
    return attempted(task, _keeper)


def run_batch(tasks: Mapping[Any, RunTask], jobs: int | None = None) -> RunRecords:
    """Run tasks and give the key and record of each as it finishes.

    The numbers of a task depend on nothing but the task: neither on how many processes there
    are nor on the order. A run that fails has its reason in its record, and the others go on; a
    process that dies ends the batch. Whatever ends the iteration, an interrupt included, ends
    all processes at once; close the generator when leaving it early.
    """
    keys = tuple(tasks)
    runs = side_by_side(_work, tuple(tasks.values()), jobs, name=lambda task: task.label)
    try:
        with closing(runs):
            for place, record in runs:
                yield keys[place], record
                raise_if_interrupted()
    finally:
        _keeper.close()


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
            median, (first, third) = median_and_quartiles(values)  # a baseline of zero: infinity
            return cls(first, median, third)
        return cls(*(float(each) for each in np.quantile(values, (0.25, 0.5, 0.75))))

    def as_mapping(self) -> dict[str, float | None]:
        """Return them for JSON, which knows no infinity."""
        return {k: v if math.isfinite(v) else None for k, v in self._asdict().items()}


RowKey = tuple[object, ...]  # names a row: what is run once with every seed


@dataclass(frozen=True)
class RunTable:
    """Runs by row and seed, and their numbers over the seeds."""

    seeds: Mapping[RowKey, Sequence[int]]  # of each row
    baselines: Mapping[RowKey, RowKey]  # the row that a row is measured against
    # of each run by its row's key with the seed after it; those that were not made are missing
    records: Mapping[tuple[object, ...], RunRecord] = field(default_factory=dict)

    def of_row(self, row: RowKey) -> dict[int, RunRecord]:
        """Return the runs of a row that were made, by seed."""
        found = {seed: self.records.get((*row, seed)) for seed in self.seeds[row]}
        return {seed: each for seed, each in found.items() if each is not None}

    def numbers(self, row: RowKey, quantity: Quantity, joint: str = TOTAL) -> dict[int, float]:
        """Return one number of a row's runs by seed; failed runs have none."""
        found = {s: each.numbers.get(joint, {}) for s, each in self.of_row(row).items()}
        return {s: each[quantity.key] for s, each in found.items() if quantity.key in each}

    def quartiles(self, row: RowKey, quantity: Quantity, joint: str = TOTAL) -> Quartiles | None:
        """Return one number of a row over its seeds; None if no run gave it."""
        return Quartiles.of(list(self.numbers(row, quantity, joint).values()))

    def seed_ratios(self, row: RowKey, quantity: Quantity, joint: str = TOTAL) -> dict[int, float]:
        """Return a row's ratio to its baseline with the same seed, by seed; none of a baseline."""
        if row not in self.baselines:
            return {}
        against = self.numbers(self.baselines[row], quantity, joint)
        own = self.numbers(row, quantity, joint)
        return {seed: ratio(own[seed], against[seed]) for seed in own if seed in against}

    def ratios(self, row: RowKey, quantity: Quantity, joint: str = TOTAL) -> Quartiles | None:
        """Return a row's ratio to its baseline, taken seed by seed before the median."""
        return Quartiles.of(list(self.seed_ratios(row, quantity, joint).values()))

    def note(self, row: RowKey) -> str:
        """Return in one line what did not run of a row; empty if everything did."""
        of, found = f"of {len(self.seeds[row])} runs", self.of_row(row).values()
        failures = [each.failure for each in found if each.failure]
        notes = [f"{len(failures)} {of} failed: {failures[0]}"] if failures else []
        missing = len(self.seeds[row]) - len(found)
        return "; ".join([*notes, f"{missing} {of} were not made"] if missing else notes)

    @property
    def failures(self) -> int:
        return sum(bool(record.failure) for record in self.records.values())

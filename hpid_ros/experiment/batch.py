"""Runs of a batch on every core, each as an experiment's numbers."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from types import TracebackType
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.processes import processors, raise_if_interrupted, side_by_side
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.settings import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.messages.series import RunSeries, complete_run
from hpid_ros.metrics.quantities import EFFORT_L2, ERROR_L2, IAVC, ITAE, IVC, Fold, Quantity
from hpid_ros.metrics.results import JointIndices, RunIndices, run_indices
from hpid_ros.motion.joint_trajectory import JointTrajectory
from hpid_ros.robot.compensation import compensators
from hpid_ros.simulation.engine import record_run
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World


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
        return cls(
            label,
            experiment.world,
            experiment.controllers[label],
            experiment.trajectory,
            experiment.periods,
        )

    def numbers(self, run: RunSeries) -> RunIndices:
        """Return the numbers of the run that this task made."""
        if self.joints:
            chosen = tuple(series for series in run.joints if series.joint in self.joints)
            run = RunSeries(run.label, chosen)
        return run_indices(run)


class WorldKeeper:
    """Keeps the world of the last run for the next one.

    Building a world takes as long as a thousand physics steps, mostly settling on the ground;
    a reset takes none and gives the same numbers to the last bit.
    """

    def __init__(self) -> None:
        self._world: World | None = None

    def __enter__(self) -> WorldKeeper:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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


def simulate(task: RunTask, keeper: WorldKeeper) -> RunSeries:
    """Run a task."""
    loops = [JointLoop(each) for each in task.loops]
    for loop in loops:
        loop.follow(task.trajectory.column(loop.settings.joint))
    try:
        models = compensators(task.loops, str(task.world.robot_description))
        world = keeper.at_start(task.world)
        stamps_ns, *columns = record_run(world, loops, task.periods, models)
        slides = world.description.slides
        return complete_run(task.label, task.world.joints, stamps_ns, columns, slides)
    except BaseException:
        keeper.close()
        raise


def simulated_indices(task: RunTask, keeper: WorldKeeper) -> RunIndices:
    """Run a task and return its numbers.

    They equal those that ``hpid compare`` computes from its bags, to the last bit.
    """
    return task.numbers(simulate(task, keeper))


PAPER_QUANTITIES = (IVC, IAVC, ITAE, EFFORT_L2, ERROR_L2)
"""The indices of the paper's Table I."""

LAST = 1.0
"""How much of the end of a run is looked at, in [s]; all of a shorter one."""

LAST_ERROR = Quantity(
    "last_error", "last |e|", "rad", "largest error of the last second", Fold.WORST, 1
)


@dataclass(frozen=True)
class JudgedTask(RunTask):
    """A run whose numbers have :data:`LAST_ERROR` beside the indices."""

    def numbers(self, run: RunSeries) -> RunIndices:
        """Return the indices and the largest error of the last second."""
        indices = super().numbers(run)
        errors = {series.joint: series for series in run.joints if series.joint in indices.joints}
        last = {}
        for joint, series in errors.items():
            is_last = series.time >= series.time[-1] - LAST
            last[joint] = float(np.abs(series.error[is_last]).max())
        return replace(
            indices,
            joints={joint: _with(each, last[joint]) for joint, each in indices.joints.items()},
            totals=_with(indices.totals, max(last.values())),
            quantities=(*indices.quantities, LAST_ERROR),
        )


def _with(indices: JointIndices, last: float) -> JointIndices:
    further: Mapping[str, float] = {**indices.further, LAST_ERROR.key: last}
    return replace(indices, further=further)


_keeper = WorldKeeper()
"""Of a worker process, which runs one task after the other."""


class Outcome(NamedTuple):
    """What became of one task."""

    place: int  # its task's place among the tasks
    indices: RunIndices | None  # its numbers; None if the run failed
    failure: str = ""  # why it failed, in one line; empty if it did not


Outcomes = Generator[Outcome, None, None]

Runner = Callable[[Sequence[RunTask]], Outcomes]
"""Runs tasks, as :func:`run_batch` does; wherever that is, the numbers are the same."""


def in_processes(jobs: int | None) -> Runner:
    """Return what runs tasks in processes of this machine."""
    if jobs is not None and jobs < 1:
        raise SettingError(f"jobs must be at least 1, not {jobs}")
    return partial(run_batch, jobs=jobs)


def run_batch(tasks: Sequence[RunTask], jobs: int | None = None) -> Outcomes:
    """Run tasks and give their outcomes as they finish.

    The numbers of a task depend on nothing but the task: neither on how many processes there
    are nor on the order. A run that fails is an outcome with its reason, and the others go on;
    a process that dies ends the batch. Whatever ends the iteration, an interrupt included, ends
    all processes at once; close the generator when leaving it early.
    """
    jobs = processors() if jobs is None else jobs
    return _one_by_one(tasks) if min(jobs, len(tasks)) <= 1 else _side_by_side(tasks, jobs)


def _one_by_one(tasks: Sequence[RunTask]) -> Outcomes:
    with WorldKeeper() as keeper:
        for place, task in enumerate(tasks):
            raise_if_interrupted()
            yield outcome_of(place, task, keeper)


def _side_by_side(tasks: Sequence[RunTask], jobs: int) -> Outcomes:
    numbered = list(enumerate(tasks))
    work = side_by_side(_work, numbered, jobs, name=lambda each: each[1].label)
    with closing(work):
        for _, outcome in work:
            yield outcome


def _work(numbered: tuple[int, RunTask]) -> Outcome:
    """Run a task in a worker process."""
    return outcome_of(*numbered, _keeper)


def outcome_of(place: int, task: RunTask, keeper: WorldKeeper) -> Outcome:
    """Run a task and return what became of it, whatever that is."""
    try:
        return Outcome(place, simulated_indices(task, keeper))
    except HpidError as error:
        return Outcome(place, None, str(error))
    except Exception as error:  # one bad run of a thousand is named; the others are wanted
        line = " ".join(f"{type(error).__name__}: {error}".split())
        return Outcome(place, None, line)

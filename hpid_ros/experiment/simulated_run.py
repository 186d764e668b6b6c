"""One controller on the simulated robot, in this process and without a bag."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import TracebackType

from hpid_ros.analysis import RunIndices, RunSeries, run_indices
from hpid_ros.analysis.complete_run import complete_run
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.simulation import World, WorldSettings
from hpid_ros.simulation.recording import record_run
from hpid_ros.trajectory import JointTrajectory
from hpid_ros.tuning.compensation import compensators


@dataclass(frozen=True)
class RunTask:
    """Everything that decides the numbers of one run.

    Attributes:
        label: Name of the run, also in the line that says why it failed.
        world: The simulated robot.
        loops: Settings of each driven joint, in the world's order.
        trajectory: The reference of every joint.
        periods: Control periods of the run; it has one state more.
        joints: The joints that the numbers are of, totals and norms included; empty for all.
    """

    label: str
    world: WorldSettings
    loops: tuple[LoopSettings, ...]
    trajectory: JointTrajectory
    periods: int
    joints: tuple[str, ...] = ()

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
        """Return the numbers of the run that this task made.

        Args:
            run: The series of all joints.
        """
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
        """Return a world at time 0: the kept one where it differs by its seed at most.

        Raises:
            HpidError: The world cannot be built.
        """
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
    """Run a task.

    Args:
        task: What to run.
        keeper: Gives the world, and keeps it if nothing goes wrong.

    Returns:
        What the run left behind: the series of all joints.

    Raises:
        HpidError: The world cannot be built, or the run left the finite numbers.
    """
    loops = [JointLoop(each) for each in task.loops]
    for loop in loops:
        loop.follow(task.trajectory.column(loop.settings.joint))
    try:
        models = compensators(task.loops, str(task.world.robot_description))
        world = keeper.at_start(task.world)
        stamps_ns, *columns = record_run(world, loops, task.periods, models)
        return complete_run(task.label, task.world.joints, stamps_ns, columns)
    except BaseException:
        keeper.close()
        raise


def simulated_indices(task: RunTask, keeper: WorldKeeper) -> RunIndices:
    """Run a task and return its numbers.

    They equal those that ``hpid compare`` computes from its bags, to the last bit.

    Args:
        task: What to run.
        keeper: As for :func:`simulate`.

    Raises:
        HpidError: As for :func:`simulate`.
    """
    return task.numbers(simulate(task, keeper))

"""Many runs on every core, without ROS."""

from __future__ import annotations

import multiprocessing.resource_tracker
import signal
import warnings
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from hpid_ros.analysis import RunIndices
from hpid_ros.errors import HpidError, RunError, SettingError
from hpid_ros.experiment.simulated_run import RunTask, WorldKeeper, simulated_indices
from hpid_ros.interrupts import raise_if_interrupted

_keeper = WorldKeeper()
"""Of a worker process, which runs one task after the other."""


class Outcome(NamedTuple):
    """What became of one task.

    Attributes:
        place: Its task's place among the tasks.
        indices: Its numbers; None if the run failed.
        failure: Why it failed, in one line; empty if it did not.
    """

    place: int
    indices: RunIndices | None
    failure: str = ""


Outcomes = Generator[Outcome, None, None]


def default_jobs() -> int:
    """Return how many processors this process may use."""
    from joblib import cpu_count  # type: ignore[import-untyped]

    return int(cpu_count())


def run_batch(tasks: Sequence[RunTask], jobs: int | None = None) -> Outcomes:
    """Run tasks and give their outcomes as they finish.

    The numbers of a task depend on nothing but the task: neither on how many processes there
    are nor on the order. A run that fails is an outcome with its reason, and the others go on;
    a process that dies ends the batch. Whatever ends the iteration, an interrupt included, ends
    all processes at once; close the generator when leaving it early.

    Args:
        tasks: What to run.
        jobs: Processes that run them, at least 1, which is this process alone; no more are
            started than there are tasks. If None, one for each processor.

    Returns:
        Generator of one outcome for each task, in the order in which they finish.

    Raises:
        SettingError: ``jobs`` is below 1.
        RunError: While iterating: a process died.
    """
    jobs = default_jobs() if jobs is None else jobs
    if jobs < 1:
        raise SettingError(f"jobs must be at least 1, not {jobs}")
    jobs = min(jobs, len(tasks))
    return _one_by_one(tasks) if jobs <= 1 else _side_by_side(tasks, jobs)


def _one_by_one(tasks: Sequence[RunTask]) -> Outcomes:
    with WorldKeeper() as keeper:
        for place, task in enumerate(tasks):
            raise_if_interrupted()
            yield _outcome(place, task, keeper)


def _side_by_side(tasks: Sequence[RunTask], jobs: int) -> Outcomes:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.backend import resource_tracker  # type: ignore[import-untyped]
    from joblib.externals.loky.process_executor import (  # type: ignore[import-untyped]
        BrokenProcessPool,
    )

    under_way: dict[int, None] = {}

    def dispatched() -> Iterable[object]:
        for place, task in enumerate(tasks):
            under_way[place] = None
            yield delayed(_work)(place, task)

    # Each worker computes in one thread: more would fight for the same processors. Tasks are
    # handed out one at a time, so that the names of those that a dead worker had are known.
    with parallel_config("loky", n_jobs=jobs, inner_max_num_threads=1):
        parallel = Parallel(
            return_as="generator_unordered", pre_dispatch=jobs, batch_size=1, max_nbytes=None
        )
    outcomes: Outcomes | None = None
    try:
        # The first worker would start these, which clears the mask that it is to inherit.
        multiprocessing.resource_tracker.ensure_running()
        resource_tracker.ensure_running()
        with _uninterruptible_children():
            outcomes = parallel(dispatched())
        for outcome in outcomes:
            del under_way[outcome.place]
            yield outcome
    except BrokenProcessPool:
        names = "; ".join(tasks[place].label for place in tuple(under_way))
        raise RunError(f"a process died during one of these runs: {names}") from None
    finally:
        _close(outcomes)


def _work(place: int, task: RunTask) -> Outcome:
    """Run a task in a worker process."""
    return _outcome(place, task, _keeper)


def _outcome(place: int, task: RunTask, keeper: WorldKeeper) -> Outcome:
    try:
        return Outcome(place, simulated_indices(task, keeper))
    except HpidError as error:
        return Outcome(place, None, str(error))
    except Exception as error:  # one bad run of a thousand is named; the others are wanted
        line = " ".join(f"{type(error).__name__}: {error}".split())
        return Outcome(place, None, line)


@contextmanager
def _uninterruptible_children() -> Iterator[None]:
    """Let processes start that an interrupt from the terminal does not reach.

    The terminal sends it to all; the parent alone answers it, and ends the others. Children
    inherit the mask. An interrupt that comes meanwhile is held until the end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _close(outcomes: Outcomes | None) -> None:
    """End the workers if anything is left to do."""
    if outcomes is not None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # joblib's advice to consume what was asked for
            outcomes.close()

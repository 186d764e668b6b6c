"""Interrupts, and work on other processes of this machine (joblib's loky).

They are new interpreters, no forks: a fork of a process that has threads, of a library or of the
middleware, inherits locks as they stand, and may wait for one for ever.

Python raises ``KeyboardInterrupt`` wherever it happens to be, and swallows it in places that
cannot raise, for instance between a fork and what follows it. What takes long therefore asks
here as well.
"""

from __future__ import annotations

import multiprocessing.resource_tracker
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TypeVar

from hpid_ros.base.errors import RunError

_is_requested = False
_postponed = 0


def heed_interrupts() -> None:
    """Treat SIGINT and SIGTERM as an interrupt, also where the shell had them ignored."""
    global _is_requested
    _is_requested = False
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def raise_if_interrupted() -> None:
    """Raise what was asked for and perhaps swallowed."""
    if _is_requested:
        raise KeyboardInterrupt


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Postpone an interrupt to the end of a block, as where a new process is written down."""
    global _postponed
    was_requested = _is_requested
    _postponed += 1
    try:
        yield
    finally:
        _postponed -= 1
    if _is_requested and not was_requested and not _postponed:
        raise KeyboardInterrupt


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _is_requested
    is_first, _is_requested = not _is_requested, True
    if (
        is_first and not _postponed
    ):  # a second one must not disturb the cleaning up after the first
        raise KeyboardInterrupt


Task = TypeVar("Task")
Result = TypeVar("Result")


def processors() -> int:
    """Return how many processors this process may use: one where joblib is not installed."""
    try:
        from joblib import cpu_count  # type: ignore[import-untyped]
    except ModuleNotFoundError:
        return 1
    return int(cpu_count())


def side_by_side(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    jobs: int | None = None,
    name: Callable[[Task], str] = str,
) -> Generator[tuple[int, Result], None, None]:
    """Do every task and yield the results as they become known.

    Whatever ends the iteration, an interrupt included, ends all processes at once; close the
    generator when leaving it early.
    """
    jobs = min(processors() if jobs is None else jobs, len(tasks))
    if jobs <= 1:
        yield from ((place, work(task)) for place, task in enumerate(tasks))
    else:
        yield from _in_processes(work, tasks, jobs, name)


def _in_processes(
    work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int, name: Callable[[Task], str]
) -> Generator[tuple[int, Result], None, None]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.backend import resource_tracker  # type: ignore[import-untyped]
    from joblib.externals.loky.process_executor import (  # type: ignore[import-untyped]
        BrokenProcessPool,
    )

    under_way: dict[int, None] = {}

    def dispatched() -> Iterable[object]:
        for place, task in enumerate(tasks):
            under_way[place] = None
            yield delayed(_placed)(work, place, task)

    # Each worker computes in one thread: more would fight for the same processors. Tasks are
    # handed out one at a time, so that the names of those that a dead worker had are known.
    with parallel_config("loky", n_jobs=jobs, inner_max_num_threads=1):
        parallel = Parallel(
            return_as="generator_unordered", pre_dispatch=jobs, batch_size=1, max_nbytes=None
        )
    results: Generator[tuple[int, Result], None, None] | None = None
    try:
        # The first worker would start these, which clears the mask that it is to inherit.
        multiprocessing.resource_tracker.ensure_running()
        resource_tracker.ensure_running()
        with uninterrupted(), _uninterruptible_children():
            results = parallel(dispatched())
        for place, result in results:
            del under_way[place]
            yield place, result
    except BrokenProcessPool:
        names = "; ".join(name(tasks[place]) for place in tuple(under_way))
        raise RunError(f"a process died during one of these: {names}") from None
    finally:
        if results is not None:
            with _quiet_end():
                results.close()


def _placed(work: Callable[[Task], Result], place: int, task: Task) -> tuple[int, Result]:
    return place, work(task)


@contextmanager
def _quiet_end() -> Iterator[None]:
    """Have joblib say nothing where it is ended before all is done.

    It advises to consume what was asked for; and the thread that hands out tasks fails where one
    had not been handed out yet (loky drops the tasks, but not their numbers).
    """
    usual = threading.excepthook

    def hook(failure: threading.ExceptHookArgs) -> None:
        name = failure.thread.name if failure.thread else ""
        if failure.exc_type is not KeyError or name != "ExecutorManagerThread":
            usual(failure)

    threading.excepthook = hook
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        threading.excepthook = usual


@contextmanager
def _uninterruptible_children() -> Iterator[None]:
    """Let processes start that an interrupt from the terminal does not reach.

    The terminal sends it to all; the parent alone answers it, and ends the others. Children
    inherit the mask, which holds nothing back here where another thread takes the signal.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

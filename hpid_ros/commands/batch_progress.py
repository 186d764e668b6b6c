"""How far a batch of runs is, for a person who waits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from hpid_ros.experiment.batch import Outcome


@contextmanager
def batch_progress(console: Console, runs: int) -> Iterator[Callable[[Outcome], None]]:
    """Show how many runs are done, their rate and the remaining time; nothing to a file.

    Args:
        console: Where.
        runs: How many there are.

    Returns:
        Context whose value is to be told of every run that has ended.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("runs", style="bold"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[failed]}", style="yellow"),
    )
    failures = 0
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=runs, rate="", failed="")

        def advanced(outcome: Outcome) -> None:
            nonlocal failures
            failures += bool(outcome.failure)
            failed = f"{failures} failed" if failures else ""
            progress.advance(task)
            speed = progress.tasks[0].finished_speed or progress.tasks[0].speed
            rate = f"{speed:.2f} runs/s" if speed else ""
            progress.update(task, rate=rate, failed=failed)

        yield advanced

"""What the commands that run a batch on every core have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hpid_ros.errors import SettingError

if TYPE_CHECKING:
    import argparse

    from rich.console import Console

    from hpid_ros.experiment.batch import Outcome
    from hpid_ros.experiment.result_folder import ResultFolder


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Add ``--jobs`` to the parser."""
    parser.add_argument(
        "-j", "--jobs", type=int, metavar="N", help="processes (one for each processor)"
    )


def check_jobs(options: argparse.Namespace) -> None:
    """Refuse an impossible number of processes.

    Raises:
        SettingError: It is not positive.
    """
    if options.jobs is not None and options.jobs < 1:
        raise SettingError(f"--jobs must be at least 1, not {options.jobs}")


@contextmanager
def telling_where(console: Console, folder: ResultFolder, interrupted: str) -> Iterator[None]:
    """Say at the end where the result is, or after an interrupt where the rest of it is.

    Args:
        console: Where to say so.
        folder: The result folder.
        interrupted: What the folder holds after an interrupt.
    """
    try:
        yield
    except KeyboardInterrupt:
        console.print(f"{interrupted}: {folder.path}", soft_wrap=True, highlight=False)
        raise
    console.print(f"result: {folder.path}", soft_wrap=True, highlight=False)


@contextmanager
def progress(console: Console, noun: str, total: int) -> Iterator[Callable[[str], None]]:
    """Show how many are done, their rate and the remaining time; nothing to a file.

    Args:
        console: Where.
        noun: What is counted.
        total: How many there are.

    Returns:
        Context whose value is to be called for each that has ended, with a note to show.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn(noun, style="bold"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as shown:
        task = shown.add_task("", total=total, rate="", note="")

        def advanced(note: str) -> None:
            shown.advance(task)
            speed = shown.tasks[0].finished_speed or shown.tasks[0].speed
            rate = f"{speed:.2f} {noun}/s" if speed else ""
            shown.update(task, rate=rate, note=note)

        yield advanced


@contextmanager
def joint_progress(
    console: Console, what: str, joints: int, is_logged: bool = False
) -> Iterator[Callable[[Sequence[str]], None]]:
    """Show how many joints are done.

    Args:
        console: Where.
        what: What is done with them, for instance ``"certified"``.
        joints: How many there are.
        is_logged: Tell each with a line of its own where the console is no terminal.

    Returns:
        Context whose value is to be called with the names of joints that are done.
    """
    with progress(console, "joints", joints) as advanced:
        done = 0

        def told(names: Sequence[str]) -> None:
            nonlocal done
            for name in names:
                done += 1
                advanced(f"{what}: {name}")
                if is_logged and not console.is_terminal:
                    line = f"{what}: {name} ({done} of {joints})"
                    console.print(line, markup=False, highlight=False, soft_wrap=True)

        yield told


@contextmanager
def run_progress(console: Console, runs: int) -> Iterator[Callable[[Outcome], None]]:
    """Show the progress of runs and how many have failed.

    Args:
        console: Where.
        runs: How many there are.

    Returns:
        Context whose value is to be told of every run that has ended.
    """
    failures = 0
    with progress(console, "runs", runs) as advanced:

        def ended(outcome: Outcome) -> None:
            nonlocal failures
            failures += bool(outcome.failure)
            advanced(f"[yellow]{failures} failed" if failures else "")

        yield ended

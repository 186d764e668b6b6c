"""The terminal while something runs, and at its end."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

from hpid_bench.report.console import TextConsole
from hpid_bench.report.table import UNLIMITED_WIDTH, WideTable
from hpid_ros.base.processes import raise_if_interrupted

if TYPE_CHECKING:
    from hpid_bench.experiment.description import Experiment
    from hpid_bench.experiment.in_process import RunReport


_LOOK: dict[str, Any] = {"header_style": "dim", "padding": 2}


def output_console() -> TextConsole:
    """Return where a command prints: in a pipe or a file nothing limits its width."""
    console = TextConsole()
    return console if console.is_terminal else TextConsole(width=UNLIMITED_WIDTH)


class Unprinted:
    """Keeps what cannot be printed from costing the result: it is raised when that is written."""

    def __init__(self) -> None:
        self._failure: OSError | None = None

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if not isinstance(error, OSError):
            return False
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is left in buffers would fail again
        self._failure = error
        return True

    def require_none(self) -> None:
        """Raise what could not be printed."""
        if self._failure is not None:
            raise self._failure


class RunProgress:
    """A progress bar for each run, with simulated time, rate and real-time factor."""

    def __init__(self, console: Console, experiment: Experiment, labels: Sequence[str]) -> None:
        self._duration, self._labels = experiment.duration, tuple(labels)
        self._period = experiment.world.control_period_ns * 1e-9
        self._console = console
        self._begin()
        self._begun: dict[str, tuple[float, float]] = {}

    def _begin(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}", style="bold", markup=False),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[figures]}", markup=False),
            TextColumn("{task.fields[phase]}", style="dim", markup=False),
            console=self._console,
            refresh_per_second=10,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> RunProgress:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._end(is_done=error is None)

    def _end(self, *, is_done: bool) -> None:
        for task in self._tasks.values() if is_done else ():
            self._progress.update(task, phase="")
        if self._tasks:
            self._progress.stop()

    def finish(self) -> None:
        """Leave the bars as they are: what is printed next stands below them."""
        self._end(is_done=True)
        self._begin()

    def phase(self, label: str, what: str) -> None:
        """Show what a run is doing; the empty label stands for the work after all runs."""
        label = label or self._labels[-1]
        if label not in self._tasks:
            self._progress.start()
            width = max(len(each) for each in self._labels)
            self._tasks[label] = self._progress.add_task(
                label.ljust(width), total=self._duration, figures="", phase=what
            )
        self._progress.update(self._tasks[label], phase=what)

    def note(self, line: str) -> None:
        """Print a line above the bars."""
        self._progress.console.print(line, style="yellow", soft_wrap=True)

    def advanced(self, label: str, simulated: float) -> None:
        """Move a run's bar, with the rate since its first report."""
        now = time.monotonic()
        first, begun = self._begun.setdefault(label, (simulated, now))
        figures, left = f"{simulated:5.2f} s", ""
        if now - begun > 0.2:
            factor = (simulated - first) / (now - begun)
            figures += f"  {factor / self._period:6.0f} Hz  {factor:5.2f} x real time"
            left = f"{(self._duration - simulated) / factor:.0f} s left" if factor > 0.0 else ""
        is_done = simulated >= self._duration
        if not is_done or simulated > first:
            self._progress.update(
                self._tasks[label], completed=simulated, figures=figures, phase=left
            )
        if is_done:
            self._progress.update(self._tasks[label], completed=simulated, phase="")


@contextmanager
def reading() -> Iterator[Callable[[str, float], None]]:
    """Show on a terminal what is being read, how far it is and how long it will take."""
    console = TextConsole(stderr=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeRemainingColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        task = progress.add_task("", total=1.0)

        def tell(what: str, share: float) -> None:
            raise_if_interrupted()
            progress.update(task, description=what, completed=share)

        yield tell


def print_notes(console: Console, notes: Sequence[str]) -> None:
    for note in notes:
        console.print(note, style="yellow", soft_wrap=True)


def print_timing(console: Console, report: RunReport, duration: float) -> None:
    """Print how one run went, and where the time of its nodes went."""
    print_runs(console, [report], duration)
    if report.timing is None:
        return
    headings = ("period", "p99", "compute", "p99", "latency", "p99", "missed", "silent")
    cycle = report.timing["cycle"]
    rows = [["(bridge)", *_microseconds(cycle["median"], cycle["p99"]), *[""] * 6]]
    for joint, each in report.timing["joints"].items():
        spreads = (each[name] for name in ("period", "compute", "latency"))
        figures = [spread[name] for spread in spreads for name in ("median", "p99")]
        counts = (str(each["missed"]), str(each["unanswered"]))
        rows.append([joint, *_microseconds(*figures), *counts])
    console.print()
    console.print(WideTable.of_rows(("joint, in us", *headings), rows, **_LOOK))


def print_result_places(console: Console, places: Mapping[str, Path]) -> None:
    console.print()
    for what, path in places.items():
        console.print(f"{what}: {path}", soft_wrap=True)


def print_runs(console: Console, reports: Sequence[RunReport], duration: float) -> None:
    headings = ("run", "states", "processes", "wall time", "rate", "real time")
    rows = [
        (
            report.label,
            str(report.states),
            str(report.processes),
            f"{report.wall_time:.2f} s",
            f"{report.rate:.0f} Hz",
            f"{duration / report.wall_time:.2f} x",
        )
        for report in reports
    ]
    console.print()
    console.print(WideTable.of_rows(headings, rows, **_LOOK))
    for report in reports:
        for warning in report.warnings:
            console.print(f"{report.label}: {warning}", style="yellow")


def _microseconds(*values: float) -> list[str]:
    return [f"{value:.0f}" if value >= 100.0 else f"{value:.1f}" for value in values]

"""Options that several commands have in common: experiments, batches, robots."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.resources import find_resource

if TYPE_CHECKING:
    from rich.console import Console

    from hpid_ros.experiment.description import Experiment
    from hpid_ros.experiment.result.folder import ResultFolder
    from hpid_ros.studies.batch import Outcome, Runner


DEFAULT_EXPERIMENT = "config/experiments/paper.yaml"
"""What runs if no file is named."""


def add_experiment(parser: argparse.ArgumentParser) -> None:
    """Add the experiment's file, which may be left out, to the parser."""
    parser.add_argument(
        "experiment", nargs="?", metavar="FILE", help="experiment file (the paper's comparison)"
    )


BOTH = "both"
"""``--engine both``: the same runs in every engine."""


def add_engine(parser: argparse.ArgumentParser, *, or_both: bool = False) -> None:
    """Add ``--engine`` to the parser; ``or_both`` says whether it may be more than one."""
    names = "pybullet, mujoco, or both to compare them" if or_both else "pybullet or mujoco"
    parser.add_argument(
        "--engine", metavar="ENGINE", help=f"who computes the physics, {names} (as the file says)"
    )


def chosen_engines(options: argparse.Namespace) -> tuple[str | None, ...]:
    """Return who is to compute the physics; None as the file says."""
    from hpid_ros.simulation.settings import ENGINES, require_engine

    if options.engine is None:
        return (None,)
    if options.engine not in (*ENGINES, BOTH):
        raise SettingError(unknown_name("engine", options.engine, (*ENGINES, BOTH)))
    engines = ENGINES if options.engine == BOTH else (options.engine,)
    for engine in engines:
        require_engine(engine)
    return engines


def tell_engine(experiments: Iterable[Experiment]) -> None:
    """Say who computes the physics where nobody chose and PyBullet is not installed."""
    for note in dict.fromkeys(each.engine_note for each in experiments):
        if note:
            print(f"hpid: {note}", file=sys.stderr)


def tell_uncontrolled(experiments: Iterable[Experiment]) -> None:
    """Say on stderr which joints have no gains: they are driven, and nothing holds them."""
    uncontrolled = dict.fromkeys(
        settings.joint
        for experiment in experiments
        for loops in experiment.controllers.values()
        for settings in loops
        if settings.gains.p == settings.gains.i == settings.gains.d == 0.0
    )
    if uncontrolled:
        print(
            f"hpid: {', '.join(uncontrolled)}: gains p, i and d are 0, the law gives no effort; "
            "hpid gains computes some",
            file=sys.stderr,
        )


def named_experiment(file: str | None, engine: str | None = None) -> Experiment:
    """Return the experiment of a file, or the paper's if none is named."""
    from hpid_ros.experiment.description import load_experiment

    return load_experiment(file or find_resource(DEFAULT_EXPERIMENT), engine)


def experiment_to_run(options: argparse.Namespace) -> Experiment:
    """Return the experiment that the options name, in the engine that they name."""
    from hpid_ros.simulation.settings import ENGINES, require_engine

    if options.engine == BOTH:
        known = " or ".join(ENGINES)
        raise SettingError(
            f"engine both is for hpid compare and hpid study; this command takes {known}"
        )
    (engine,) = chosen_engines(options)
    experiment = named_experiment(options.experiment, engine)
    require_engine(experiment.world.engine)
    tell_uncontrolled([experiment])
    return experiment


def add_joints(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add ``--joint``, which may be repeated, to the parser; ``purpose`` says what for."""
    parser.add_argument("--joint", action="append", default=[], metavar="NAME", help=purpose)


def add_output(parser: argparse.ArgumentParser, default: str) -> None:
    """Add ``--output`` and ``--force`` to the parser; ``default`` is the folder in words."""
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help=f"folder (results/{default}-TIME)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing result")


def output_folder(options: argparse.Namespace, name: str) -> Path:
    """Return the folder that ``--output`` names, or ``results/NAME-TIME``."""
    return options.output or Path("results") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Add ``--jobs`` and ``--scheduler`` to the parser."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "-j", "--jobs", type=int, metavar="N", help="processes (one for each processor)"
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask scheduler whose workers run everything, tcp://HOST:PORT",
    )


@contextmanager
def chosen_runner(options: argparse.Namespace, console: Console) -> Iterator[Runner]:
    """Give what runs a batch: processes of this machine, or the workers of a scheduler."""
    from hpid_ros.studies.batch import in_processes

    if options.scheduler is None:
        if options.jobs is not None and options.jobs < 1:
            raise SettingError(f"--jobs must be at least 1, not {options.jobs}")
        yield in_processes(options.jobs)
        return
    from hpid_ros.studies.cluster import Cluster

    with Cluster(options.scheduler) as cluster:
        console.print(str(cluster), soft_wrap=True, highlight=False)
        yield cluster


@contextmanager
def telling_where(console: Console, folder: ResultFolder, interrupted: str) -> Iterator[None]:
    """Say at the end where the result is, or after an interrupt where the rest of it is."""
    try:
        yield
    except KeyboardInterrupt:
        console.print(f"{interrupted}: {folder.path}", soft_wrap=True, highlight=False)
        raise
    console.print(f"result: {folder.path}", soft_wrap=True, highlight=False)


@contextmanager
def progress(console: Console, noun: str, total: int) -> Iterator[Callable[[str], None]]:
    """Show how many are done, their rate and the remaining time; nothing to a file."""
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
    """Show how many joints are done."""
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
    """Show the progress of runs and how many have failed."""
    failures = 0
    with progress(console, "runs", runs) as advanced:

        def ended(outcome: Outcome) -> None:
            nonlocal failures
            failures += bool(outcome.failure)
            advanced(f"[yellow]{failures} failed" if failures else "")

        yield ended

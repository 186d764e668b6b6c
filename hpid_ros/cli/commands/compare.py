"""``hpid compare``: run the controllers of an experiment and compare them."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from hpid_ros.base.errors import SettingError
from hpid_ros.cli.commands import DONE
from hpid_ros.cli.options import (
    BOTH,
    chosen_engines,
    experiment_to_run,
    named_experiment,
    output_folder,
    warn_uncontrolled,
)
from hpid_ros.cli.terminal import (
    RunProgress,
    output_console,
    print_notes,
    print_result_places,
    print_runs,
)
from hpid_ros.experiment.compare import Compared, compare, compare_engines
from hpid_ros.experiment.in_process import named
from hpid_ros.experiment.result_folder import ResultFolder
from hpid_ros.report.table import ComparisonTable


def run(options: argparse.Namespace) -> int:
    """Run the comparison and print what it gave."""
    if options.engine == BOTH:
        if options.animation:
            raise SettingError("--animation is of one engine: hpid render takes one of both")
        return _run_in_both(options)
    experiment = experiment_to_run(options)
    output = output_folder(options, experiment.name)
    console = output_console()
    with RunProgress(console, experiment, tuple(experiment.controllers)) as progress:
        compared = compare(
            experiment,
            output,
            progress,
            in_process=options.in_process,
            force=options.force,
            has_figures=not options.no_figures,
        )
    if options.animation:
        _animate(console, output)
    _print(console, compared)
    return DONE


def _animate(console: Console, output: Path) -> None:
    from hpid_ros.cli.commands.render import ANIMATION, rendered, save_in_report
    from hpid_ros.report.film import FilmSettings, encoded

    film = rendered(console, output, (), FilmSettings())
    with ResultFolder.reopen(output) as folder:
        folder.write(ANIMATION, encoded(film, ANIMATION[-5:]))
        save_in_report(folder, film)


def _run_in_both(options: argparse.Namespace) -> int:
    """Run the comparison in both engines, one after the other, and print how far they differ."""
    engines = chosen_engines(options)
    experiments = [named_experiment(options.experiment, engine) for engine in engines]
    warn_uncontrolled(experiments)
    first = experiments[0]
    output = output_folder(options, first.name)
    console = output_console()
    labels = [named(label, str(engine)) for engine in engines for label in first.controllers]
    with RunProgress(console, first, labels) as progress:
        both = compare_engines(
            *(experiments, output, progress),
            in_process=options.in_process,
            has_figures=not options.no_figures,
            force=options.force,
        )
    for engine, compared in both.compared.items():
        console.print(f"\nin {engine}:")
        _print(console, compared)
    console.print()
    for grid in both.grids:
        console.print(grid)
    print_result_places(console, {"both": both.folder.path})
    return DONE


def _print(console: Console, compared: Compared) -> None:
    result = compared.result
    console.print(ComparisonTable(result.comparison))
    print_notes(console, result.notes)
    print_runs(console, compared.reports, result.experiment.duration)
    folder = compared.folder.path
    print_result_places(console, {"result": folder, "report": folder / "report.html"})

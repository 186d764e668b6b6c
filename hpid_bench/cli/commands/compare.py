"""``hpid compare``, ``hpid run``: the controllers of an experiment compared, or one of them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.options import (
    experiment_to_run,
    output_folder,
)
from hpid_bench.cli.terminal import (
    RunProgress,
    Unprinted,
    output_console,
    print_notes,
    print_result_places,
    print_runs,
    print_timing,
)
from hpid_bench.experiment.compare import ExperimentResult, run_comparison, run_controller
from hpid_bench.experiment.graph_run import GraphOptions
from hpid_bench.experiment.in_process import RunReport
from hpid_bench.experiment.result_folder import ResultFolder
from hpid_bench.report.figures import require_formats
from hpid_bench.report.table import ComparisonTable

REPORT = "report.html"


def run(options: argparse.Namespace) -> int:
    formats = () if options.figures == ("none",) else options.figures
    require_formats(formats)
    experiment = experiment_to_run(options)
    if options.animation:
        from hpid_bench.report.film import require_few

        require_few(tuple(experiment.controllers))
    output = output_folder(options, experiment.name)
    console = output_console()
    unprinted = Unprinted()
    with RunProgress(console, experiment, tuple(experiment.controllers)) as progress:

        def show(result: ExperimentResult, reports: Sequence[RunReport]) -> None:
            with unprinted:
                progress.finish()
                _print(console, result, reports)

        run_comparison(
            experiment,
            output,
            progress,
            in_process=options.in_process,
            options=GraphOptions(options.processes),
            force=options.force,
            computed=show,
        )
    with unprinted:
        print_result_places(console, {"result": output, "report": output / REPORT})
    if options.animation:
        _animate(console, output)
    if formats:
        _draw(console, output, formats)
    unprinted.require_none()
    return DONE


def _animate(console: Console, output: Path) -> None:
    from hpid_bench.cli.commands.render import ANIMATION, rendered, save_in_report
    from hpid_bench.report.film import FilmSettings, encoded

    film = rendered(console, output, (), FilmSettings())
    with ResultFolder.reopen(output) as folder:
        folder.write(ANIMATION, encoded(film, ANIMATION[-5:]))
        save_in_report(folder, film)


def _draw(console: Console, result: Path, formats: Sequence[str]) -> None:
    from hpid_bench.cli.commands.figures import FIGURES, draw_result

    draw_result(console, result, formats)
    console.print(f"{FIGURES}: {result / FIGURES}", soft_wrap=True)


def run_one(options: argparse.Namespace) -> int:
    """Run one controller on the graph, and print what it gave and how its time was spent."""
    graph = GraphOptions(
        processes=options.processes,
        is_recorded=not options.no_record,
        is_realtime=options.realtime,
        realtime_priority=options.realtime_priority,
    )
    experiment = experiment_to_run(options)
    label = options.controller or list(experiment.controllers)[-1]
    output = output_folder(options, experiment.name)
    console = output_console()
    with RunProgress(console, experiment, [label]) as progress:
        report, result = run_controller(
            experiment,
            label,
            output,
            progress,
            graph,
            force=options.force,
            is_tried=not options.no_trial,
        )
    if result:
        console.print(ComparisonTable(result.comparison))
        print_notes(console, result.notes)
    print_timing(console, report, experiment.duration)
    print_result_places(console, {"result": output})
    return DONE


def _print(console: Console, result: ExperimentResult, reports: Sequence[RunReport]) -> None:
    console.print(ComparisonTable(result.comparison))
    print_notes(console, result.notes)
    print_runs(console, reports, result.experiment.duration)

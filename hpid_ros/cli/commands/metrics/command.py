"""``hpid metrics``: the indices of recordings, alone or compared."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hpid_ros import __version__
from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.output_files import refuse_outputs, write_file

if TYPE_CHECKING:
    from hpid_ros.analysis.signals import Gains
    from hpid_ros.control import LoopSettings
    from hpid_ros.metrics import Summary
    from hpid_ros.metrics.compare import Parameters
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hpid_ros.cli.commands import DONE
from hpid_ros.cli.commands.metrics.options import (
    EXAMPLES,
    add_options,
    baseline_label,
    measuring,
    sources_of,
)

if TYPE_CHECKING:
    from hpid_ros.analysis import Comparison
    from hpid_ros.analysis.indices.task import EndEffectorFigures
    from hpid_ros.metrics import Summary


def refuse_existing(options: argparse.Namespace) -> None:
    """Refuse outputs that would replace something, or that cannot be drawn, before any reading."""
    for form in figure_formats(options):
        if form not in ("png", "pdf", "svg"):
            raise SettingError(unknown_name("figure format", form, ("png", "pdf", "svg")))
    inputs = _inputs(options)
    outputs = [("--save", options.save), ("--report", options.report)]
    refuse_outputs(outputs, force=options.force, inputs=inputs)
    if options.figures is not None:
        from hpid_ros.experiment.result.folder import check_place

        check_place(options.figures, force=options.force, inputs=inputs, option="--figures")


def _inputs(options: argparse.Namespace) -> list[Path]:
    """Return all that is read, of which nothing is replaced."""
    named = [*options.bags, *(path for _, *paths in options.group for path in paths)]
    named += [each for each in (options.baseline, options.parameters) if each is not None]
    return [Path(each) for each in named if Path(each).exists()]


def figure_formats(options: argparse.Namespace) -> list[str]:
    """Return the formats in which figures are asked for."""
    return [form.strip().lower() for form in options.formats.split(",") if form.strip()]


def write_outputs(options: argparse.Namespace, found: Summary) -> list[Path]:
    """Write what was asked for."""
    written: list[Path] = []
    try:
        if options.save is not None:
            write_file(options.save, _saved_text(found))
            written.append(options.save)
        gains = {} if options.figures is None and options.report is None else _gains(found)
        if options.figures is not None:
            _save_figures(options, found, gains)
            written.append(options.figures)
        if options.report is not None:
            write_file(options.report, _report_text(found, gains))
            written.append(options.report)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write {error.filename or 'the output'}: {reason}") from None
    return written


def _save_figures(options: argparse.Namespace, found: Summary, gains: Gains) -> None:
    from hpid_ros.experiment.result.folder import ResultFolder
    from hpid_ros.report.figures.plots import save_figures

    with ResultFolder.create(
        options.figures, force=options.force, inputs=_inputs(options), option="--figures"
    ) as folder:
        for path in save_figures(
            found.series,
            folder.path,
            figure_formats(options),
            comparison=found.comparison,
            repeats=found.repeats,
            gains=gains,
            paths=found.paths,
        ):
            folder.add(path.name)


def _saved_text(found: Summary) -> str:
    document = {
        "hpid_ros": __version__,
        "sources": [str(path) for path in found.sources],
        "indices": found.comparison.as_mapping(),
    }
    return json.dumps(document, indent=2) + "\n"


def _report_text(found: Summary, gains: Gains) -> str:
    from hpid_ros.experiment.result.folder import versions
    from hpid_ros.report.html.page import render_report

    provenance: dict[str, object] = {
        "command": shlex.join(["hpid", *sys.argv[1:]]),
        "sources": [str(path) for path in found.sources],
        "versions": versions(),
    }
    return render_report(
        found.comparison,
        found.series,
        provenance,
        found.parameters,
        warnings=found.warnings,
        repeats=found.repeats,
        gains=gains,
        paths=found.paths,
    )


def _gains(found: Summary) -> Gains:
    """Return what the laws did to their gains, of each run whose parameters are known."""
    from hpid_ros.metrics.gain_signals import gain_signals

    gains = {}
    for run in found.series:
        signals = gain_signals(run, _settings(found.parameters.get(run.label, {})))
        if signals is not None:
            gains[run.label] = signals
    return gains


def _settings(parameters: Mapping[str, Mapping[str, object]]) -> dict[str, LoopSettings]:
    from hpid_ros.control import LoopSettings

    return {joint: LoopSettings.from_parameters(values) for joint, values in parameters.items()}


def parameters_from_file(path: Path, labels: Sequence[str]) -> Parameters:
    """Return what a parameter file says, for each label."""
    from hpid_ros.tuning.controller_files import settings_from_parameter_file

    settings = settings_from_parameter_file(path).values()
    by_joint = {each.joint: dict(each.to_parameters()) for each in settings}
    return dict.fromkeys(labels, by_joint)


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "metrics",
        description="Compute performance indices of recordings, the first the baseline;\n"
        "tables, figures and a report. docs/indices.md defines every number.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_options(parser)
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Read, compute, compare, and leave what was asked for."""
    from hpid_ros.analysis.quantities import ANGLE_UNITS, find_quantities
    from hpid_ros.base.errors import SettingError, unknown_name
    from hpid_ros.metrics import measure_all, summary

    if options.units not in ANGLE_UNITS:
        raise SettingError(unknown_name("unit of angles", options.units, ANGLE_UNITS))
    indices = options.indices.split(",")
    find_quantities(indices)
    refuse_existing(options)
    sources, how = sources_of(options), measuring(options)
    with _progress() as tell:
        found = summary(
            measure_all(sources, how, tell=tell),
            baseline=baseline_label(options),
            indices=indices,
            units=options.units,
            is_overall=options.overall,
            names_commands=options.commands is not None,
        )
        labels = [run.label for run in found.comparison.runs]
        if options.parameters is not None:
            found = replace(found, parameters=parameters_from_file(options.parameters, labels))
        for line in found.warnings:
            print(f"hpid: warning: {line}", file=sys.stderr)
        if how.keeps_series and len(found.series) < len(labels):
            print(
                "hpid: warning: saved numbers have no recording: only runs from bags are drawn",
                file=sys.stderr,
            )
        tell("writing", 1.0)
        written = write_outputs(options, found)
    _print(options, found)
    for path in written:
        print(f"written: {path}", file=sys.stderr)
    return DONE


def _print(options: argparse.Namespace, found: Summary) -> None:
    from hpid_ros.base.errors import SettingError
    from hpid_ros.report.tables.export import FORMATS

    try:
        _print_to_output(options, found, FORMATS)
    except BrokenPipeError:  # whoever reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write the output: {reason}") from None


def _print_to_output(
    options: argparse.Namespace,
    found: Summary,
    formats: Mapping[str, Callable[[Comparison], str]],
) -> None:
    if options.format == "table" and sys.stdout.isatty():
        from hpid_ros.cli.terminal import output_console
        from hpid_ros.report.tables.table import ComparisonTable

        output_console().print(ComparisonTable(found.comparison))
        print(*_end_effector_lines(found.end_effectors), sep="", end="", flush=True)
    else:
        text = formats[options.format](found.comparison)
        text = _with_end_effectors(text, options.format, found.end_effectors)
        print(text, end="", flush=True)


def _with_end_effectors(text: str, form: str, figures: Mapping[str, EndEffectorFigures]) -> str:
    """Return a printed comparison together with the end effectors of its runs.

    As lines below a table, as ``end_effector`` in JSON; CSV and LaTeX are tables of joints and
    stay as they are.
    """
    if not figures:
        return text
    if form == "json":
        document = json.loads(text)
        document["end_effector"] = {label: each.as_mapping() for label, each in figures.items()}
        return json.dumps(document, indent=2) + "\n"
    return text + "".join(_end_effector_lines(figures)) if form == "table" else text


def _end_effector_lines(figures: Mapping[str, EndEffectorFigures]) -> list[str]:
    """Return one line a run, with its end."""
    return [f"{each.line(label)}\n" for label, each in figures.items()]


@contextmanager
def _progress() -> Iterator[Callable[[str, float], None]]:
    """Show on a terminal what is being read, how far it is and how long it will take."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from hpid_ros.base.console import TextConsole

    console = TextConsole(stderr=True)
    if not console.is_terminal:
        yield lambda what, share: None
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("", total=1.0)
        yield lambda what, share: progress.update(task, description=what, completed=share)

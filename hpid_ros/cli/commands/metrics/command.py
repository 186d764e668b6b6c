"""``hpid metrics``: the indices of recordings, alone or compared."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
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


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "metrics",
        help="compute the indices of recorded bags and compare them",
        description="Compute performance indices of recordings, the first the baseline; tables, "
        "figures and a report. docs/indices.md defines every number.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_options(parser)
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Read, compute, compare, and leave what was asked for."""
    from hpid_ros.analysis.quantities import ANGLE_UNITS, find_quantities
    from hpid_ros.base.errors import SettingError, unknown_name
    from hpid_ros.cli.commands.metrics.outputs import (
        parameters_from_file,
        refuse_existing,
        write_outputs,
    )
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

    Args:
        text: The comparison as printed.
        form: ``table``, ``csv``, ``json`` or ``latex``.
        figures: By label of the run.
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

"""``hpid metrics``: the indices of recordings, alone or compared."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from hpid_ros.cli.commands import DONE
from hpid_ros.cli.commands.metrics.options import EXAMPLES, add_options
from hpid_ros.cli.commands.metrics.robot import end_effector_lines, with_end_effectors

if TYPE_CHECKING:
    from hpid_ros.analysis import Comparison, RunIndices
    from hpid_ros.cli.commands.metrics.inputs import Measured
    from hpid_ros.cli.commands.metrics.outputs import Outcome


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
    from hpid_ros.cli.commands.metrics.inputs import inputs_of, measure
    from hpid_ros.cli.commands.metrics.outputs import refuse_existing, write_outputs

    if options.units not in ANGLE_UNITS:
        raise SettingError(unknown_name("unit of angles", options.units, ANGLE_UNITS))
    find_quantities(options.indices.split(","))
    refuse_existing(options)
    inputs = inputs_of(options)
    keeps_series = options.figures is not None or options.report is not None
    with _progress() as tell:
        measured = measure(options, inputs, keeps_series, tell)
        outcome = _outcome(options, measured)
        _require_a_number(outcome.comparison)
        for line in outcome.warnings:
            print(f"hpid: warning: {line}", file=sys.stderr)
        if keeps_series and len(outcome.series) < len(outcome.comparison.runs):
            print(
                "hpid: warning: saved numbers have no recording: only runs from bags are drawn",
                file=sys.stderr,
            )
        tell("writing", 1.0)
        written = write_outputs(options, outcome)
    _print(options, outcome)
    for path in written:
        print(f"written: {path}", file=sys.stderr)
    return DONE


def _outcome(options: argparse.Namespace, measured: Sequence[Measured]) -> Outcome:
    from hpid_ros.analysis.comparability import mismatches
    from hpid_ros.analysis.folding import fold_repeats
    from hpid_ros.analysis.units import with_angles_in
    from hpid_ros.cli.commands.metrics.outputs import Outcome, parameters_from_file

    single = [run for each in measured for run in each.runs]
    single = _baseline_first(options, single)
    warnings = (
        *(line for each in measured for line in each.defects),
        *_advice(single, options.commands is None),
        *mismatches(single),
    )
    single = [with_angles_in(run, options.units) for run in single]
    comparison = _selected(options, fold_repeats(single))
    labels = [run.label for run in comparison.runs]
    first_of = {each.runs[0].label: each for each in reversed(measured) if each.series}
    parameters = {
        label: first_of[label].parameters
        for label in labels
        if label in first_of and first_of[label].parameters
    }
    if options.parameters is not None:
        parameters = dict(parameters_from_file(options.parameters, labels))
    return Outcome(
        comparison=comparison,
        repeats=tuple(run for run in single if comparison.run(run.label).spread),
        series=tuple(
            series
            for label in labels
            if label in first_of and (series := first_of[label].series) is not None
        ),
        parameters=parameters,
        warnings=warnings,
        sources=tuple(each.path for each in measured),
        end_effectors={
            label: figures
            for label in labels
            if (figures := _first(measured, label, "end_effector")) is not None
        },
        paths=tuple(
            path
            for label in labels
            if (path := _first(measured, label, "end_effector_path")) is not None
        ),
    )


_OPTIONS = {
    "effort": "--commands TOPIC, --commands effort or --command-topic JOINT=TOPIC[INDEX]",
    "reference": "--reference TOPIC, FILE or hold",
}


def _advice(runs: Sequence[RunIndices], is_measured_a_choice: bool = True) -> list[str]:
    """Return one line for each set of runs that lack something, with the options that give it.

    Args:
        runs: The runs.
        is_measured_a_choice: Whether measured efforts were taken for want of commands.
    """
    from hpid_ros.analysis.quantities import Data

    labels: dict[str, list[str]] = {}
    for run in runs:
        parts = []
        if Data.EFFORT in run.assumed and is_measured_a_choice:
            parts.append(
                f"efforts are {run.assumed[Data.EFFORT]}, as nothing else carries any "
                "(--commands TOPIC or --command-topic JOINT=TOPIC[INDEX] names commands)"
            )
        for data, options in _OPTIONS.items():
            reasons: dict[str, list[str]] = {}
            for joint, lacking in run.lacking.items():
                for each, reason in lacking.items():
                    if each.value == data:
                        reasons.setdefault(reason, []).append(joint)
            for reason, joints in reasons.items():
                where = "" if len(joints) == len(run.joints) else f" for {', '.join(joints)}"
                parts.append(f"{reason}{where}: {options}")
        if parts:
            labels.setdefault("; ".join(parts), []).append(repr(run.label))
    return [
        f"run{'s' if len(names) > 1 else ''} {', '.join(dict.fromkeys(names))}: {text}"
        for text, names in labels.items()
    ]


def _require_a_number(comparison: Comparison) -> None:
    """Raise SettingError if no run has what any of the numbers asked for needs."""
    from hpid_ros.base.errors import SettingError

    for run in comparison.runs:
        for quantity in (*comparison.indices, *comparison.norms):
            if any(quantity.needs not in run.lacking.get(joint, {}) for joint in run.joints):
                return
    lines = "; ".join(_advice(comparison.runs))
    raise SettingError(f"none of the indices asked for can be computed: {lines}")


def _first(measured: Sequence[Measured], label: str, what: str) -> Any:
    """Return something of the first recording of a label; None without any."""
    return next((getattr(each, what) for each in measured if each.runs[0].label == label), None)


def _baseline_first(options: argparse.Namespace, runs: Sequence[RunIndices]) -> list[RunIndices]:
    from pathlib import Path

    from hpid_ros.base.errors import SettingError, unknown_name

    if options.baseline is None or Path(options.baseline).exists():
        return list(runs)
    labels = [run.label for run in runs]
    if options.baseline not in labels:
        raise SettingError(unknown_name("baseline", options.baseline, set(labels)))
    return sorted(runs, key=lambda run: run.label != options.baseline)


def _selected(options: argparse.Namespace, runs: Sequence[RunIndices]) -> Comparison:
    """Return the runs with the indices that were asked for."""
    from hpid_ros.analysis import Comparison
    from hpid_ros.analysis.quantities import INDICES, NORMS, find_quantities

    chosen = find_quantities(options.indices.split(","))
    if options.overall:
        return Comparison(tuple(runs), indices=(), norms=chosen)
    if chosen == (*INDICES, *NORMS):
        return Comparison(tuple(runs))
    return Comparison(tuple(runs), indices=chosen, norms=())


def _print(options: argparse.Namespace, outcome: Outcome) -> None:
    from hpid_ros.base.errors import SettingError
    from hpid_ros.report.tables.export import FORMATS

    try:
        _print_to_output(options, outcome, FORMATS)
    except BrokenPipeError:  # whoever reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write the output: {reason}") from None


def _print_to_output(
    options: argparse.Namespace,
    outcome: Outcome,
    formats: Mapping[str, Callable[[Comparison], str]],
) -> None:
    if options.format == "table" and sys.stdout.isatty():
        from hpid_ros.cli.terminal import output_console
        from hpid_ros.report.tables.table import ComparisonTable

        output_console().print(ComparisonTable(outcome.comparison))
        print(*end_effector_lines(outcome.end_effectors), sep="", end="", flush=True)
    else:
        text = formats[options.format](outcome.comparison)
        text = with_end_effectors(text, options.format, outcome.end_effectors)
        print(text, end="", flush=True)


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

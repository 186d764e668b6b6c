"""What ``hpid metrics`` leaves: numbers to read again, figures, a report."""

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
from hpid_ros.base.output_files import refuse_output, write_file

if TYPE_CHECKING:
    from hpid_ros.analysis.signals import Gains
    from hpid_ros.control import LoopSettings
    from hpid_ros.metrics import Summary
    from hpid_ros.metrics.compare import Parameters


def refuse_existing(options: argparse.Namespace) -> None:
    """Refuse outputs that would replace something, or that cannot be drawn, before any reading.

    Raises:
        ResultExistsError: A file is there and ``--force`` was not given.
        SettingError: A figure's format is unknown.
    """
    for form in figure_formats(options):
        if form not in ("png", "pdf", "svg"):
            raise SettingError(unknown_name("figure format", form, ("png", "pdf", "svg")))
    inputs = _inputs(options)
    for option, path in (("--save", options.save), ("--report", options.report)):
        if path is not None:
            refuse_output(path, force=options.force, inputs=inputs, option=option)
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
    """Write what was asked for.

    Returns:
        What was written: files, or the folder of the figures.

    Raises:
        SettingError: Something cannot be written.
    """
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
    """Return what a parameter file says, for each label.

    Raises:
        SettingError: The file holds no controller.
    """
    from hpid_ros.tuning.controller_files import settings_from_parameter_file

    settings = settings_from_parameter_file(path).values()
    by_joint = {each.joint: dict(each.to_parameters()) for each in settings}
    return dict.fromkeys(labels, by_joint)

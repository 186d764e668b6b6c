"""``hpid metrics``: the indices of recordings, alone or compared."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.terminal import output_console, reading
from hpid_bench.experiment.result_folder import ResultFolder, check_place, versions
from hpid_bench.report.console import TextConsole
from hpid_bench.report.figures import require_formats
from hpid_bench.report.table import ComparisonTable, table_text
from hpid_ros import __version__
from hpid_ros.base.errors import HpidError, SettingError, require_known
from hpid_ros.base.files import refuse_outputs, write_file
from hpid_ros.base.names import require_label
from hpid_ros.base.resources import find_resource
from hpid_ros.messages.selection import BagSelection, ReferenceChoice, parse_command_topics
from hpid_ros.metrics.alignment import RunWindow, parse_windows
from hpid_ros.metrics.measure import (
    ALL_JOINTS,
    Measuring,
    Source,
    Summary,
    expanded,
    measure_all,
    summary,
)
from hpid_ros.metrics.quantities import ANGLE_UNITS, find_quantities
from hpid_ros.metrics.texts import FORMATS
from hpid_ros.robot.description import RobotDescription

if TYPE_CHECKING:
    from hpid_ros.metrics.task import TaskFrame


def bag_selection(
    options: argparse.Namespace,
    joints: Sequence[str] | None,
    reference: ReferenceChoice = "auto",
    is_identified: bool = False,
) -> BagSelection:
    return BagSelection(
        joints=joints,
        namespace=options.namespace,
        states=options.states or None,
        commands=options.commands,
        command_topics=parse_command_topics(options.command_topic),
        reference=reference,
        clock=options.clock,
        start=options.start,
        end=options.end,
        separates_runs=is_identified,  # which are no one motion
        every=is_identified,
        sender=options.sender,
    )


def sources_of(options: argparse.Namespace) -> list[Source]:
    """Return what is to be read, the baseline first if it was named by a path."""
    if options.labels and len(options.labels) != len(options.bags):
        raise SettingError(
            f"there must be one label for each of {len(options.bags)} bags, "
            f"not {len(options.labels)}"
        )
    for label in options.labels or ():
        require_label(label, "--labels", SettingError)
    labels = options.labels or [None] * len(options.bags)
    named = [Source(path, label) for path, label in zip(options.bags, labels, strict=True)]
    for label, *paths in options.group:
        if not paths:
            raise SettingError(f"--group {label} names no bag: it takes a label, then bags")
        require_label(label, "--group", SettingError)
        named += [Source(Path(path), label) for path in paths]
    sources = [each for one in named for each in expanded(one)]
    if is_path(options.baseline):
        named_first = Path(options.baseline)
        first = [each for each in sources if each.path.resolve() == named_first.resolve()]
        others = [each for each in sources if each not in first]
        sources = [*(first or expanded(Source(named_first))), *others]
    if not sources:
        raise SettingError("name at least one bag, result folder or file of saved indices")
    return sources


def is_path(baseline: str | None) -> bool:
    """Say whether a baseline is named by its path, and not by a label."""
    return baseline is not None and Path(baseline).exists()


def measuring(options: argparse.Namespace) -> Measuring:
    """Return how the bags are to be read, and what is to be computed of them."""
    selection = bag_selection(options, options.joints, _reference(options.reference))
    how = Measuring(
        selection,
        effort_limits=_effort_limits(options.effort_limit),
        robot=_task_frame(options),
        keeps_series=options.figures is not None or options.report is not None,
        align=options.align,
        windows=_windows(options),
    )
    return how if options.cutoff is None else replace(how, cutoff=options.cutoff)


def _reference(text: str) -> ReferenceChoice:
    """Return a kind or a topic as it is, and the trajectory of a file."""
    if Path(text).suffix not in (".yaml", ".yml") and not Path(text).is_file():
        return text

    from hpid_bench.experiment.description import load_reference

    return load_reference(text)


def _windows(options: argparse.Namespace) -> dict[str, RunWindow]:
    if options.window and (options.start is not None or options.end is not None):
        raise SettingError("--window is of one bag, --start and --end of all: not both")
    return parse_windows(options.window)


def _effort_limits(texts: Sequence[str]) -> dict[str, float]:
    limits: dict[str, float] = {}
    for text in texts:
        name, _, number = text.rpartition("=")
        try:
            limits[name or ALL_JOINTS] = float(number)
        except ValueError:
            raise SettingError(
                f"--effort-limit must be EFFORT or JOINT=EFFORT, got {text!r}"
            ) from None
    return limits


def _task_frame(options: argparse.Namespace) -> TaskFrame | None:
    """Return the robot that the options name; None without one."""
    if options.robot is None:
        if options.end_effector is not None or options.wheels is not None:
            raise SettingError("--end-effector and --wheels need --robot URDF")
        return None

    from hpid_bench.experiment.description import load_experiment
    from hpid_ros.metrics.task import TaskFrame
    from hpid_ros.robot.differential_drive import DifferentialDrive

    file = find_resource(options.robot)
    if file.suffix in (".yaml", ".yml"):
        experiment = load_experiment(file)
        world, description = experiment.world, experiment.description
        base, others, link = world.rolling_base, world.initial_positions, experiment.end_effector
    else:
        description = RobotDescription.load(file)
        base, others, link = None, {}, description.last_link
    if options.wheels is not None:
        base = DifferentialDrive.of(description, *options.wheels)
    return TaskFrame(
        description,
        description.link(options.end_effector or link),
        base,
        others,
        is_required=options.end_effector is not None or base is not None,
    )


def refuse_existing(options: argparse.Namespace) -> None:
    """Refuse outputs that would replace something, or that cannot be drawn, before any reading."""
    require_formats(options.formats)
    inputs = _inputs(options)
    outputs = [("--save", options.save), ("--report", options.report)]
    refuse_outputs(outputs, force=options.force, inputs=inputs)
    if options.figures is not None:
        check_place(options.figures, force=options.force, inputs=inputs, option="--figures")


def _inputs(options: argparse.Namespace) -> list[Path]:
    """Return all that is read, of which nothing is replaced."""
    named = [*options.bags, *(path for _, *paths in options.group for path in paths)]
    once = (options.baseline, options.params, options.robot, options.reference)
    named += [each for each in once if each is not None]
    return [Path(each) for each in named if Path(each).exists()]


def write_outputs(options: argparse.Namespace, found: Summary) -> list[Path]:
    written: list[Path] = []
    try:
        if options.figures is not None:  # first: the folder must be empty, others may go into it
            _save_figures(options, found)
            written.append(options.figures)
        if options.save is not None:
            write_file(options.save, _saved_text(found))
            written.append(options.save)
        if options.report is not None:
            write_file(options.report, _report_text(found))
            written.append(options.report)
    except HpidError:  # one of them is an OSError, too
        raise
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write {error.filename or 'the output'}: {reason}") from None
    return written


def _save_figures(options: argparse.Namespace, found: Summary) -> None:
    from hpid_bench.cli.commands.figures import drawn_files, printed_figures

    figures = printed_figures(found)
    labels = [each.label for each in found.comparison.runs]
    console = TextConsole(stderr=True)
    with ResultFolder.create(
        options.figures, force=options.force, inputs=_inputs(options), option="--figures"
    ) as folder:
        for name, content in drawn_files(console, figures, labels, options.formats):
            folder.write(name, content)


def _saved_text(found: Summary) -> str:
    document = {
        "hpid_ros": __version__,
        "sources": [str(path) for path in found.sources],
        "indices": found.comparison.as_mapping(),
    }
    return json.dumps(document, indent=2) + "\n"


def _report_text(found: Summary) -> str:
    from hpid_bench.report.page import render_report

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
        warnings=(*found.warnings, *found.gain_notes()),
        repeats=found.repeats,
        gains=found.gains(),
        paths=found.paths,
    )


def run(options: argparse.Namespace) -> int:
    require_known("unit of angles", [options.units], ANGLE_UNITS)
    indices = options.indices.split(",")
    find_quantities(indices)
    refuse_existing(options)
    sources, how = sources_of(options), measuring(options)
    with reading() as tell:
        found = summary(
            measure_all(sources, how, tell=tell),
            baseline=None if is_path(options.baseline) else options.baseline,
            indices=indices,
            units=options.units,
            is_overall=options.overall,
            names_commands=options.commands is not None,
        )
        labels = [run.label for run in found.comparison.runs]
        if options.params is not None:
            from hpid_bench.cli.options import parameter_file  # imports more than bags need

            settings = parameter_file(options.params).loops.values()
            by_joint = {each.joint: dict(each.to_parameters()) for each in settings}
            found = replace(found, parameters=dict.fromkeys(labels, by_joint))
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
    # As lines below a table, as ``end_effector`` in JSON; CSV is a table of joints.
    lines = "".join(f"{each.line(label)}\n" for label, each in found.end_effectors.items())
    if options.format == "table" and sys.stdout.isatty():
        output_console().print(ComparisonTable(found.comparison))
        print(lines, end="", flush=True)
        return
    write = table_text if options.format == "table" else FORMATS[options.format]
    text = write(found.comparison)
    if options.format == "json" and found.end_effectors:
        figures = {label: asdict(each) for label, each in found.end_effectors.items()}
        text = json.dumps(json.loads(text) | {"end_effector": figures}, indent=2) + "\n"
    print(text + (lines if options.format == "table" else ""), end="", flush=True)

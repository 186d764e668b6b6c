"""``hpid metrics``: the indices of recordings, alone or compared."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros import __version__
from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.files import refuse_outputs, write_file
from hpid_ros.cli.commands import DONE
from hpid_ros.cli.options import add_time, add_topics, bag_selection

if TYPE_CHECKING:
    from hpid_ros.messages.selection import Reference
    from hpid_ros.metrics.measure import Measuring, Source, Summary
    from hpid_ros.metrics.quantities import Gains
    from hpid_ros.metrics.task import TaskFrame


EXAMPLES = """\
examples:
  hpid metrics my_bag                                  one recording
  hpid metrics pid_bag hpid_bag --labels PID hPID      second against first
  hpid metrics --group PID pid_* --group hPID hpid_*   repeats: medians
  hpid metrics my_bag --indices step,rmse --units deg  other indices, degrees
  hpid metrics my_bag --reference my_motion.yaml       none in the bag: given
  hpid metrics my_bag --command-topic elbow=/group_controller/commands[2]
  hpid metrics a_bag b_bag --save ab.json --report ab.html
  hpid metrics my_bag --robot my_robot.urdf            how far off its hand was
  hpid metrics ab.json results/mine/result.json        saved numbers, no bags
"""


def _add_inputs(parser: Any) -> None:
    parser.add_argument(
        "bags",
        nargs="*",
        type=Path,
        metavar="BAG",
        help="bag folder or file; a result folder stands for its bags, a .json file for numbers "
        "that were saved",
    )
    parser.add_argument(
        "--labels",
        nargs="+",
        metavar="LABEL",
        help="one for each BAG; of the same label are repeats (from the bag's metadata, else its "
        "name)",
    )
    parser.add_argument(
        "--group",
        action="append",
        nargs="+",
        default=[],
        metavar=("LABEL", "BAG"),
        help="repeats of one run, for instance with other seeds; may be given several times",
    )
    parser.add_argument(
        "--baseline",
        metavar="BAG",
        help="what ratios are taken of: one of the bags, another one, or a label (the first)",
    )


def _add_selection(group: Any) -> None:
    group.add_argument("--joints", nargs="+", metavar="JOINT", help="only these joints")
    add_topics(group)
    group.add_argument(
        "--reference",
        default="auto",
        metavar="TOPIC|FILE|hold",
        help="what the joints were to follow: a topic; a YAML file with a reference section, as "
        "experiments have, followed from the first state on; hold: each joint its first position; "
        "or a kind of topic: trajectory, setpoint, sampled, controller_state (auto: any of these "
        "kinds that is there)",
    )
    add_time(group)


def _add_numbers(group: Any) -> None:
    group.add_argument(
        "--indices",
        default="paper",
        metavar="NAME,...",
        help="ivc, iavc, itae, iae, ise, rmse, error_max, effort_l2, error_l2, rise_time, "
        "settling_time, overshoot, steady_state_error, saturation, chatter, energy; or paper, "
        "step, all (paper)",
    )
    group.add_argument(
        "--overall", action="store_true", help="only the numbers over all joints, one a line"
    )
    group.add_argument("--units", default="rad", metavar="UNIT", help="of angles: rad, deg (rad)")
    group.add_argument(
        "--cutoff", type=float, metavar="HZ", help="effort above it is chatter (20 Hz)"
    )
    group.add_argument(
        "--effort-limit",
        action="append",
        default=[],
        metavar="[JOINT=]EFFORT",
        help="in N m, or N where it slides, at which a joint saturates (found in its efforts)",
    )


def _add_outputs(group: Any) -> None:
    formats = group.add_mutually_exclusive_group()
    formats.add_argument(
        "--format", choices=("table", "csv", "json", "latex"), default="table", help="(table)"
    )
    for name in ("csv", "json", "latex"):
        formats.add_argument(
            f"--{name}", dest="format", action="store_const", const=name, help=f"--format {name}"
        )
    group.add_argument("--save", type=Path, metavar="FILE", help="all numbers, to be read again")
    group.add_argument("--figures", type=Path, metavar="FOLDER", help="draw the figures")
    group.add_argument(
        "--formats", default="png,pdf", metavar="NAME,...", help="png, pdf, svg (png,pdf)"
    )
    group.add_argument("--report", type=Path, metavar="FILE", help="one self-contained web page")
    group.add_argument(
        "--parameters",
        type=Path,
        metavar="FILE",
        help="parameter file of the controllers, for the report (from a result folder beside)",
    )
    group.add_argument("--force", action="store_true", help="replace files that exist")


def _add_robot(group: Any) -> None:
    group.add_argument(
        "--robot",
        metavar="URDF",
        help="says which joints slide, in m and N (else the bag does, if it holds "
        "/robot_description); also tell how far its end effector was from the reference, by "
        "forward kinematics; an experiment file (.yaml) names wheels and initial positions, too",
    )
    group.add_argument(
        "--end-effector", metavar="LINK", help="link whose pose counts, with --robot (the last)"
    )
    group.add_argument(
        "--wheels",
        nargs=2,
        metavar=("LEFT", "RIGHT"),
        help="joints of the wheels of a base, with --robot: its odometry is added",
    )


def sources_of(options: argparse.Namespace) -> list[Source]:
    """Return what is to be read, the baseline first if it was named by a path."""
    from hpid_ros.base.names import require_label
    from hpid_ros.metrics.measure import Source, expanded

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
    from hpid_ros.metrics.measure import Measuring

    selection = bag_selection(options, options.joints, _reference(options.reference))
    how = Measuring(
        selection,
        effort_limits=_effort_limits(options.effort_limit),
        robot=_task_frame(options),
        keeps_series=options.figures is not None or options.report is not None,
    )
    return how if options.cutoff is None else replace(how, cutoff=options.cutoff)


def _reference(text: str) -> Reference:
    """Return a kind or a topic as it is, and the trajectory of a file."""
    if Path(text).suffix not in (".yaml", ".yml") and not Path(text).is_file():
        return text
    from hpid_ros.experiment.description import load_reference

    return load_reference(text)


def _effort_limits(texts: Sequence[str]) -> dict[str, float]:
    from hpid_ros.metrics.measure import ALL_JOINTS

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
    from hpid_ros.base.files import find_resource
    from hpid_ros.experiment.description import load_experiment
    from hpid_ros.metrics.task import TaskFrame
    from hpid_ros.robot.description import RobotDescription
    from hpid_ros.robot.differential_drive import DifferentialDrive

    file = find_resource(options.robot)
    if file.suffix in (".yaml", ".yml"):
        experiment = load_experiment(file)
        world = experiment.world
        description = RobotDescription.load(world.robot_description)
        base, others, link = world.base, world.initial_positions, experiment.end_effector
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
    for form in figure_formats(options):
        if form not in ("png", "pdf", "svg"):
            raise SettingError(unknown_name("figure format", form, ("png", "pdf", "svg")))
    inputs = _inputs(options)
    outputs = [("--save", options.save), ("--report", options.report)]
    refuse_outputs(outputs, force=options.force, inputs=inputs)
    if options.figures is not None:
        from hpid_ros.experiment.result_folder import check_place

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
    from hpid_ros.experiment.result_folder import ResultFolder
    from hpid_ros.report.plots import save_figures

    with ResultFolder.create(
        options.figures, force=options.force, inputs=_inputs(options), option="--figures"
    ) as folder:
        for path in save_figures(
            found.comparison,
            found.series,
            folder.path,
            figure_formats(options),
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
    from hpid_ros.experiment.result_folder import versions
    from hpid_ros.report.page import render_report

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
    from hpid_ros.control.settings import LoopSettings
    from hpid_ros.metrics.laws import gain_signals

    gains = {}
    for run in found.series:
        parameters = found.parameters.get(run.label, {})
        settings = {j: LoopSettings.from_parameters(each) for j, each in parameters.items()}
        signals = gain_signals(run, settings)
        if signals is not None:
            gains[run.label] = signals
    return gains


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "metrics",
        description="Compute performance indices of recordings, the first the baseline;\n"
        "tables, figures and a report. docs/indices.md defines every number.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_inputs(parser)
    _add_selection(parser.add_argument_group("what is read from the bags"))
    _add_numbers(parser.add_argument_group("numbers"))
    _add_robot(parser.add_argument_group("the robot"))
    _add_outputs(parser.add_argument_group("output"))
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Read, compute, compare, and leave what was asked for."""
    from hpid_ros.metrics.measure import measure_all, summary
    from hpid_ros.metrics.quantities import ANGLE_UNITS, find_quantities

    if options.units not in ANGLE_UNITS:
        raise SettingError(unknown_name("unit of angles", options.units, ANGLE_UNITS))
    indices = options.indices.split(",")
    find_quantities(indices)
    refuse_existing(options)
    sources, how = sources_of(options), measuring(options)
    with _progress() as tell:
        found = summary(
            measure_all(sources, how, tell=tell),
            baseline=None if is_path(options.baseline) else options.baseline,
            indices=indices,
            units=options.units,
            is_overall=options.overall,
            names_commands=options.commands is not None,
        )
        labels = [run.label for run in found.comparison.runs]
        if options.parameters is not None:
            from hpid_ros.control.controller_files import settings_from_parameter_file

            settings = settings_from_parameter_file(options.parameters).values()
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
    from hpid_ros.report.export import FORMATS

    # As lines below a table, as ``end_effector`` in JSON; CSV and LaTeX are tables of joints.
    lines = "".join(f"{each.line(label)}\n" for label, each in found.end_effectors.items())
    try:
        if options.format == "table" and sys.stdout.isatty():
            from hpid_ros.cli.terminal import output_console
            from hpid_ros.report.table import ComparisonTable

            output_console().print(ComparisonTable(found.comparison))
            print(lines, end="", flush=True)
            return
        text = FORMATS[options.format](found.comparison)
        if options.format == "json" and found.end_effectors:
            figures = {label: asdict(each) for label, each in found.end_effectors.items()}
            text = json.dumps(json.loads(text) | {"end_effector": figures}, indent=2) + "\n"
        print(text + (lines if options.format == "table" else ""), end="", flush=True)
    except BrokenPipeError:  # whoever reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write the output: {reason}") from None


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

"""``hpid margins``: gain, phase, delay and disk margins of every joint's sampled loop."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hpid_ros import __version__
from hpid_ros.base.errors import HpidError, SettingError, unknown_name
from hpid_ros.base.files import refuse_outputs, write_file
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import (
    LoopFile,
    add_joints,
    add_robot_options,
    judged_loops,
    loop_file,
    named_loops,
    shown_name,
    sliding_joints,
)

if TYPE_CHECKING:
    from hpid_ros.control.controller_files import ParameterFile
    from hpid_ros.control.settings import LoopSettings
    from hpid_ros.robot.description import RobotDescription
    from hpid_ros.stability.frequency import FrozenLoop
    from hpid_ros.stability.gain_check import Loop
    from hpid_ros.stability.margins import LoopFamily
    from hpid_ros.stability.measured_margins import LoopReport, MeasuredJoint


_FORMATS = ("png", "pdf", "svg")


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "margins",
        description="Compute the margins of every joint's loop as it is sampled and held, over "
        "the inertia and, for the homogeneous law, over the multipliers that it reaches, each "
        "frozen in turn; beside them what is certified of the law itself.",
        epilog="docs/margins.md defines every number. Exit code 0 if every frozen loop is stable, "
        "1 if one is not.",
    )
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="parameter file of controllers, or experiment"
    )
    add_joints(parser, "only this joint; may be repeated (all)")
    parser.add_argument(
        "--controller", metavar="LABEL", help="only this controller of an experiment (all)"
    )
    add_robot_options(parser)
    parser.add_argument(
        "--friction",
        action="append",
        nargs="+",
        default=[],
        metavar="B",
        help="viscous friction [N m s/rad] of every joint, or JOINT=B (the damping of --urdf or "
        "of the experiment's robot, else 0)",
    )
    parser.add_argument(
        "--delay",
        type=float,
        default=0.0,
        metavar="S",
        help="from a state to its effort at the joint, beyond the hold: computation, bus, dead "
        "time [s] (0); an experiment's drives add theirs",
    )
    parser.add_argument(
        "--norm-max",
        type=float,
        metavar="N",
        help="largest norm that the loops reach (norm.cap, or 2 where there is none)",
    )
    parser.add_argument(
        "--bag",
        type=Path,
        help="recorded excitation: the measured frequency response is compared and drawn",
    )
    parser.add_argument(
        "--coherence",
        type=float,
        default=0.95,
        metavar="C",
        help="frequencies of the bag with less are left out (0.95)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="draw Bode, Nyquist, |S| and |T| as .png, .pdf or .svg; of several loops one file "
        "each, FILE with the loop's name",
    )
    parser.add_argument("--force", action="store_true", help="replace existing files")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Compute, then write, then print."""
    from hpid_ros.base.console import TextConsole
    from hpid_ros.cli.options import joint_progress
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.report.margins import MarginTable
    from hpid_ros.stability.gain_check import check_gains
    from hpid_ros.stability.margins import family_margins
    from hpid_ros.stability.measured_margins import LoopReport, distance

    found = loop_file(options.file)
    file = _chosen(named_loops(found), found, options)
    judged = judged_loops(options, file)
    families = _families(options, found, judged)
    names = [shown_name(name) for name in file.loops]
    charts = _charts(options, dict(zip(names, families, strict=True)))
    _refuse_in_the_way(options, charts)
    measured = _measured(options, families)
    reports: dict[str, LoopReport] = {}
    with joint_progress(TextConsole(stderr=True), "certified", len(judged)) as tell:
        verdicts = check_gains(judged, tell)
    slides = sliding_joints(options, found.experiment)
    for name, family, verdict in zip(names, families, verdicts, strict=True):
        joint = measured.get(family.settings.joint)
        apart = None if joint is None else (joint, distance(_nearest(family, joint), joint))
        is_slide = family.settings.joint in slides
        reports[name] = LoopReport(family, family_margins(family), verdict, apart, is_slide)
    written = _write(options, reports, charts)
    output_console().print(MarginTable(reports))
    for path in written:
        print(f"written: {path}")
    return DONE if all(each.band.is_stable for each in reports.values()) else FAILED


def _refuse_in_the_way(options: argparse.Namespace, charts: Mapping[str, Path]) -> None:
    """Refuse outputs that would replace something, before any work is done for them."""
    inputs = [each for each in (options.file, options.bag) if each is not None]
    wanted = [("--json", options.json), *(("--plot", path) for path in charts.values())]
    refuse_outputs(wanted, force=options.force, inputs=inputs)


def _chosen(file: ParameterFile, found: LoopFile, options: argparse.Namespace) -> ParameterFile:
    """Return the loops of the joints and of the controller that are named."""
    loops = file.loops
    known = list(dict.fromkeys(each.joint for each in loops.values()))
    for joint in options.joint:
        if joint not in known:
            raise SettingError(unknown_name("joint", joint, known))
    label = options.controller
    if label is not None:
        if found.experiment is None:
            raise SettingError(f"--controller is for experiments, and {options.file} is none")
        if label not in found.experiment.controllers:
            raise SettingError(unknown_name("controller", label, found.experiment.controllers))
    return file._replace(
        loops={
            name: each
            for name, each in loops.items()
            if (not options.joint or each.joint in options.joint)
            and (label is None or name == f"{label} {each.joint}")
        }
    )


class _RobotFacts(NamedTuple):
    """What a robot says of one joint's loop beside its inertia."""

    friction: float = 0.0  # [N m s/rad] viscous friction
    delay: float = 0.0  # [s] of its drive


def _families(
    options: argparse.Namespace, found: LoopFile, judged: Sequence[Loop]
) -> list[LoopFamily]:
    from hpid_ros.stability.margins import loop_family

    joints = [settings.joint for settings, _ in judged]
    facts = _robot_facts(options, found, joints)
    given = _given_friction(options.friction, joints)
    families = []
    for settings, inertia in judged:
        own = facts.get(settings.joint, _RobotFacts())
        friction = given.get(settings.joint, own.friction)
        delay = options.delay + own.delay
        settings = _as_measured(settings, found)
        families.append(loop_family(settings, inertia, friction, delay, options.norm_max))
    return families


def _robot_facts(
    options: argparse.Namespace, found: LoopFile, joints: Sequence[str]
) -> dict[str, _RobotFacts]:
    """Return what the robot of the experiment, or else of ``--urdf``, says of the joints."""
    from hpid_ros.cli.options import load_robot
    from hpid_ros.robot.description import RobotDescription

    description: RobotDescription | None = None
    delays: dict[str, float] = {}
    if found.experiment is not None:
        world = found.experiment.world
        description = RobotDescription.load(world.robot_description)
        period = world.control_period_ns * 1e-9
        delays = {
            joint: drive.delay * period
            for joint, drive in zip(world.joints, world.drives, strict=False)
        }
    if options.urdf:
        description = load_robot(options.urdf).description
    known = {} if description is None else description.joints
    return {
        joint: _RobotFacts(known[joint].damping if joint in known else 0.0, delays.get(joint, 0.0))
        for joint in joints
    }


def _as_measured(settings: LoopSettings, found: LoopFile) -> LoopSettings:
    """Return settings whose velocity source is the one that the experiment's robot leaves."""
    experiment = found.experiment
    if experiment is None or experiment.world.velocity != "none":
        return settings
    if not settings.velocity.is_measured:
        return settings
    return settings.with_parameters({"velocity_source": "filtered"})


def _given_friction(texts: Sequence[Sequence[str]], joints: Sequence[str]) -> dict[str, float]:
    """Return what ``--friction`` says, by joint."""
    of_all: dict[str, float] = {}
    of_one: dict[str, float] = {}
    for text in (each for group in texts for each in group):
        joint, is_named, value = text.rpartition("=")
        try:
            friction = float(value)
        except ValueError:
            friction = -1.0
        if not 0.0 <= friction < float("inf") or (is_named and not joint):
            raise SettingError(
                f"--friction takes B or JOINT=B, a number that is not negative, not {text!r}"
            )
        if not is_named:
            of_all = dict.fromkeys(joints, friction)
        elif joint not in joints:
            raise SettingError(unknown_name("joint in --friction", joint, joints))
        else:
            of_one[joint] = friction
    return of_all | of_one


def _measured(
    options: argparse.Namespace, families: Sequence[LoopFamily]
) -> dict[str, MeasuredJoint]:
    """Return the measured joints, by name."""
    if options.bag is None:
        return {}
    from hpid_ros.base.processes import raise_if_interrupted
    from hpid_ros.messages.run import read_run
    from hpid_ros.stability.measured_margins import measured_joint

    loops = {each.settings.joint: each.settings for each in families}
    decoupled = [joint for joint, each in loops.items() if each.model.is_decoupling]
    if decoupled:
        raise SettingError(
            f"--bag: the effort of {decoupled[0]!r} is the model's and other joints', too: with "
            f"decoupling it is not the loop's, and cannot be compared"
        )
    run = read_run(
        options.bag, "bag", joints=list(loops), progress=lambda share: raise_if_interrupted()
    )
    found, reasons = {}, []
    for series in run.joints:
        try:
            joint = measured_joint(series, options.coherence)
            _require_period(loops[series.joint], joint)
        except HpidError as error:
            reasons.append(str(error))
        else:
            found[series.joint] = joint
    if not found:
        raise SettingError(f"{options.bag}: {'; '.join(reasons)}")
    for reason in reasons:
        print(f"not measured: {reason}")
    return found


_PERIOD_TOLERANCE = 0.02


def _require_period(settings: LoopSettings, measured: MeasuredJoint) -> None:
    period = settings.timing.control_period
    if abs(measured.period - period) > _PERIOD_TOLERANCE * period:
        raise SettingError(
            f"joint {settings.joint!r}: the bag has a sample each {measured.period:.6g} s, but "
            f"control_period is {period:g} s"
        )


def _nearest(family: LoopFamily, measured: MeasuredJoint) -> FrozenLoop:
    """Return the PID's loop on the inertia of its range that the measurement is nearest to."""
    from hpid_ros.stability.measured_margins import distance

    low, high = family.inertia
    own = distance(family.loop(low), measured).inertia
    return family.loop(min(max(own, low), high))


def _charts(options: argparse.Namespace, families: Mapping[str, LoopFamily]) -> dict[str, Path]:
    """Return the loops to draw, each with its file: a PID is drawn with the band around it."""
    if options.plot is None:
        return {}
    path: Path = options.plot
    if path.suffix.lower().removeprefix(".") not in _FORMATS:
        raise SettingError(unknown_name("figure format", path.suffix.removeprefix("."), _FORMATS))
    bands = [each.settings for each in families.values() if each.is_homogeneous]
    names = [
        name
        for name, each in families.items()
        if each.is_homogeneous
        or not any(
            (band.joint, band.gains) == (each.settings.joint, each.settings.gains)
            for band in bands
        )
    ]
    if len(names) == 1:
        return {names[0]: path}
    return {name: path.with_stem(f"{path.stem}-{_in_file_name(name)}") for name in names}


def _in_file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", name)


def _write(
    options: argparse.Namespace, reports: Mapping[str, LoopReport], charts: Mapping[str, Path]
) -> list[Path]:
    written = []
    try:
        if options.json is not None:
            document = {
                "hpid_ros": __version__,
                "file": str(options.file),
                "loops": {name: each.as_mapping() for name, each in reports.items()},
            }
            write_file(options.json, json.dumps(document, indent=2) + "\n")
            written.append(options.json)
        for name, path in charts.items():
            from hpid_ros.report.margins import margins_figure
            from hpid_ros.report.plots import render

            each = reports[name]
            figure = margins_figure(name, each)
            write_file(path, render(figure, path.suffix.lower().removeprefix(".")))
            written.append(path)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write {error.filename or 'the output'}: {reason}") from None
    return written

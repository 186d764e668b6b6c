"""``hpid margins``: gain, phase, delay and disk margins of every joint's sampled loop."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.options import (
    JointPlants,
    joint_progress,
    judged_loops,
    load_robot,
    loop_file,
    require_controller,
    shown_name,
    sliding_joints_from,
    viscous_frictions,
    write_output,
)
from hpid_bench.cli.terminal import output_console, reading
from hpid_bench.experiment.description import Experiment
from hpid_bench.report.console import TextConsole
from hpid_bench.report.figures import require_picture
from hpid_bench.report.margins import margin_table, margins_figure
from hpid_bench.report.plots import drawing_bytes
from hpid_ros import __version__
from hpid_ros.base.errors import HpidError, SettingError, unknown_name
from hpid_ros.base.files import refuse_outputs
from hpid_ros.base.names import NamePatterns
from hpid_ros.control.parameter_files import ParameterFile
from hpid_ros.messages.quality import MEASURED
from hpid_ros.messages.run import read_run
from hpid_ros.stability.gain_check import Loop, check_gains
from hpid_ros.stability.margins import LoopFamily, family_margins
from hpid_ros.stability.measured_margins import (
    LoopReport,
    MeasuredJoint,
    measured_joint,
    nearest_distance,
)


def run(options: argparse.Namespace) -> int:
    experiment, file = loop_file(options.file)
    file = _chosen(file, experiment, options)
    judged = judged_loops(options, file, experiment)
    families = _families(options, experiment, judged)
    names = [shown_name(name) for name in file.loops]
    charts = _charts(options, dict(zip(names, families, strict=True)))
    inputs = [each for each in (options.file, options.bag) if each is not None]
    plots = [(f"--plot of {name}", path) for name, path in charts.items()]
    refuse_outputs([("--json", options.json), *plots], force=options.force, inputs=inputs)
    measured = _measured(options, families)
    with joint_progress(TextConsole(stderr=True), "certified", len(judged)) as progress:
        verdicts = check_gains(judged, progress)
    slides = sliding_joints_from(options, experiment)
    reports: dict[str, LoopReport] = {}
    for name, family, verdict in zip(names, families, verdicts, strict=True):
        joint = measured.get(family.settings.joint)
        apart = None if joint is None else (joint, nearest_distance(family, joint))
        is_slide = family.settings.joint in slides
        reports[name] = LoopReport(family, family_margins(family), verdict, apart, is_slide)
    written: dict[Path, str | bytes] = {}
    if options.json is not None:
        document = {
            "hpid_ros": __version__,
            "file": str(options.file),
            "loops": {name: each.as_mapping() for name, each in reports.items()},
        }
        written[options.json] = json.dumps(document, indent=2) + "\n"
    for name, path in charts.items():
        figure = margins_figure(name, reports[name])
        written[path] = drawing_bytes(figure, path.suffix.lower().removeprefix("."))
    for path, content in written.items():
        write_output(path, content)
    output_console().print(margin_table(reports))
    for path in written:
        print(f"written: {path}")
    return DONE if all(each.band.is_stable for each in reports.values()) else FAILED


def _chosen(
    file: ParameterFile, experiment: Experiment | None, options: argparse.Namespace
) -> ParameterFile:
    """Return the loops of the joints and of the controller that are named."""
    known = list(dict.fromkeys(each.joint for each in file.loops.values()))
    asked = NamePatterns(options.joint).chosen("joint", known, SettingError)
    label = options.controller
    if label is not None:
        require_controller(experiment, label, options.file)
    return file._replace(
        loops={
            name: each
            for name, each in file.loops.items()
            if each.joint in asked and (label is None or name == f"{label} {each.joint}")
        }
    )


def _families(
    options: argparse.Namespace, experiment: Experiment | None, judged: Sequence[Loop]
) -> list[LoopFamily]:
    """Return the loops with the friction and the delays of the experiment's robot, or --urdf's."""
    plants = JointPlants() if experiment is None else JointPlants.of(experiment)
    friction = dict(plants.friction)
    if options.urdf:
        friction = viscous_frictions(load_robot(options.urdf).description)
    friction |= _given_friction(options.friction, [settings.joint for settings, _ in judged])
    plants = plants._replace(friction=friction)
    return [
        plants.family(settings, inertia, options.delay, options.norm_max)
        for settings, inertia in judged
    ]


def _given_friction(texts: Sequence[Sequence[str]], joints: Sequence[str]) -> dict[str, float]:
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
    if options.bag is None:
        return {}

    loops = {each.settings.joint: each.settings for each in families}
    for joint, settings in loops.items():
        if settings.model.is_decoupling:
            raise SettingError(
                f"--bag: the effort of {joint!r} is the model's and other joints', too: with "
                f"decoupling it is not the loop's, and cannot be compared"
            )
    with reading() as tell:
        told = partial(tell, options.bag.name)
        run = read_run(options.bag, "bag", joints=list(loops), progress=told)
    found, reasons = {}, []
    for series in run.joints:
        period = loops[series.joint].timing.control_period
        source = run.quality.joints[series.joint].effort
        if source.startswith(MEASURED):  # later than what was sent, by who knows how much
            reasons.append(f"{series.joint}: its efforts are {source}; record the commands")
            continue
        try:
            found[series.joint] = measured_joint(series, options.coherence, period)
        except HpidError as error:
            reasons.append(str(error))
    if not found:
        raise SettingError(f"{options.bag}: {'; '.join(reasons)}")
    for reason in reasons:
        print(f"not measured: {reason}")
    return found


def _charts(options: argparse.Namespace, families: Mapping[str, LoopFamily]) -> dict[str, Path]:
    """Return the loops to draw, each with its file: a PID is drawn with the band around it."""
    if options.plot is None:
        return {}
    path: Path = options.plot
    require_picture(path)
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
    plain = {name: re.sub(r"[^\w.+=,()-]+", "-", name) for name in names}
    return {name: path.with_stem(f"{path.stem}-{plain[name]}") for name in names}

"""``hpid export``: the loop of each joint as C, or all as a plugin for ros2_control."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.options import (
    InertiaPair,
    first_homogeneous,
    inertias_from,
    joint_progress,
    load_robot,
    loop_file,
    require_controller,
    write_output,
)
from hpid_bench.experiment.in_process import controllers_text
from hpid_bench.report.console import TextConsole
from hpid_bench.tuning.export import (
    c_files,
    file_names,
    package_files,
    require_distinct,
    require_package,
)
from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.files import refuse_output
from hpid_ros.base.names import NamePatterns, node_sections
from hpid_ros.base.yaml_files import load_document
from hpid_ros.control.settings import LoopSettings
from hpid_ros.robot.loop_settings import on_robot
from hpid_ros.stability.gain_boxes import gain_ranges
from hpid_ros.stability.gain_check import judged_inertia


def run(options: argparse.Namespace) -> int:
    experiment, parameters = loop_file(options.file)
    label, loops = options.controller, list(parameters.loops.values())
    if label is not None:
        require_controller(experiment, label, options.file)
    if experiment is not None:
        loops = list(experiment.controllers[label] if label else first_homogeneous(experiment))
    known = list(dict.fromkeys(each.joint for each in loops))
    asked = NamePatterns(options.joint).chosen("joint", known, SettingError)
    chosen = [each for each in loops if each.joint in asked]
    if parameters.remarks:
        chosen = [_without_feedforward(each) for each in chosen]
    loops = _within_robot(options, chosen)
    require_distinct([each.joint for each in loops])
    if options.output.exists() and not options.output.is_dir():
        raise SettingError(f"{options.output} is no folder; name one with -o")
    if options.ros2_control:
        return _export_plugin(options, loops, parameters.inertias)
    _refuse_in_the_way(options, [name for loop in loops for name in file_names(loop.joint)])
    files = [c_files(each, options.precision, options.file.name) for each in loops]
    for each in files:
        _write(options.output, each)
    for loop, each in zip(loops, files, strict=True):
        header, source, *_, test = each
        print(f"{loop.joint}: {header}, {source}; to check it: {test}")
    return _written(options, loops)


def _without_feedforward(loop: LoopSettings) -> LoopSettings:
    """Return a loop of ros2_control's own without what no exported loop has; say so."""
    name = "feedforward.viscous_friction"
    if not loop.feedforward.viscous_friction:
        return loop
    print(f"hpid: {loop.joint}: {name} is left out: no exported loop has it", file=sys.stderr)
    return loop.with_parameters({name: 0.0})


def _export_plugin(
    options: argparse.Namespace, loops: Sequence[LoopSettings], inertias: Mapping[str, InertiaPair]
) -> int:
    if options.precision != "double":
        raise SettingError("--precision single is for --c: ros2_control computes in double")
    package = options.output.resolve().name
    require_package(package, [each.joint for each in loops])
    _refuse_in_the_way(options, ["package.xml", "config/joints.yaml"])
    joints = [each.joint for each in loops]
    without_robot = argparse.Namespace(**{**vars(options), "urdf": None})
    known = {**inertias_from(options, joints), **inertias}
    known |= inertias_from(without_robot, joints)
    judged = [(each, judged_inertia(each, known.get(each.joint))) for each in loops]
    print(
        f"hpid: certifying {len(loops)} loops: half a minute to two minutes for each kind of loop",
        file=sys.stderr,
    )
    with joint_progress(
        TextConsole(stderr=True), "certified", len(loops), is_logged=True
    ) as progress:
        ranges = gain_ranges(judged, progress)
    files = package_files(package, ranges, controllers_text(loops), options.file.name)
    _refuse_in_the_way(options, files)
    _write(options.output, files)
    for each in ranges:
        print(f"{each.settings.joint}: {each}")
    return _written(options, loops)


def _written(options: argparse.Namespace, loops: Sequence[LoopSettings]) -> int:
    free = [
        each.joint
        for each in loops
        if not each.motion.has_stop and math.isinf(each.motion.fastest)
    ]
    if free and options.urdf is None:
        print(f"no limits of position and velocity: {', '.join(free)}; --urdf takes the robot's")
    print(f"written: {options.output}")
    return DONE


def _write(folder: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        write_output(folder / name, text)


def _within_robot(options: argparse.Namespace, loops: list[LoopSettings]) -> list[LoopSettings]:
    """Return loops within the limits of the robot that ``--urdf`` names."""
    if options.urdf is None:
        sections = node_sections(load_document(options.file, SettingError).values)
        if any(own.get("robot_description") for own in sections.values()):
            raise SettingError(
                f"{options.file} takes limits from a robot_description, which no exported loop "
                f"has: name the robot's URDF with --urdf"
            )
        return loops
    robot = load_robot(options.urdf)
    try:
        found = robot.description.select([each.joint for each in loops])
    except HpidError as error:
        raise SettingError(f"{options.urdf}: {error}") from None
    return [on_robot(loop, own, robot.source) for own, loop in zip(found, loops, strict=True)]


def _refuse_in_the_way(options: argparse.Namespace, names: Iterable[str]) -> None:
    for name in names:
        path = options.output / name
        refuse_output(path, force=options.force, inputs=[options.file], option="-o")

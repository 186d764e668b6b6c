"""``hpid identify``: inertia, friction, load and delay of a robot's joints, from a bag."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.commands.metrics import bag_selection
from hpid_bench.cli.options import load_robot, write_output
from hpid_bench.cli.terminal import output_console, reading
from hpid_bench.report.figures import require_picture
from hpid_bench.tuning.identification.identification_report import (
    as_mapping,
    experiment_text,
    identification_figure,
    report,
)
from hpid_bench.tuning.identification.identify import Method
from hpid_bench.tuning.identification.robot_identification import (
    RobotIdentification,
    base_travel,
    identify_robot,
)
from hpid_ros.base.errors import SettingError
from hpid_ros.base.files import refuse_outputs
from hpid_ros.base.names import NamePatterns
from hpid_ros.base.resources import find_resource
from hpid_ros.messages.run import read_run
from hpid_ros.metrics.measure import sliding_joints
from hpid_ros.robot.description import GivenRobot

_LABEL = "recording"
_HEADER = (
    "An experiment says extends: and this file's name, or has these lines; check-gains and",
    "upgrade take it as --inertia and, where it names a robot, as --urdf.",
)


def run(options: argparse.Namespace) -> int:
    if options.effort_unit == "any" and not options.urdf:
        raise SettingError("--effort-unit any needs --urdf, whose masses fix the unit")
    if options.plot is not None:
        require_picture(options.plot)
    inputs = [options.bag, *([Path(options.urdf)] if options.urdf else [])]
    outputs = [("-o", options.output), ("--json", options.json), ("--plot", options.plot)]
    refuse_outputs(outputs, force=options.force, inputs=inputs)
    robot = load_robot(options.urdf) if options.urdf else None
    found = _identified(options, robot)
    contents = _contents(options, robot, found)
    console = output_console()
    for part in report(found):
        console.print(part, soft_wrap=isinstance(part, str))
    for path, content in contents.items():
        write_output(path, content)
        console.print(f"written: {path}", soft_wrap=True)
    return DONE if any(each.is_found for each in found.joints) else FAILED


def _identified(options: argparse.Namespace, robot: GivenRobot | None) -> RobotIdentification:
    method = Method(options.cutoff, options.longest_delay, options.effort_unit == "any")
    # Other joints' efforts count where the robot is known, whichever are asked for.
    asked = options.joint or None
    selection = bag_selection(options, None if robot else asked, is_identified=True)
    known = sliding_joints(options.bag, None, selection.namespace)
    kinds = {**known.kinds, **(robot.description.kinds if robot else {})}
    selection = replace(selection, kinds=kinds)
    with reading() as tell:
        told = partial(tell, options.bag.name)
        recording = read_run(options.bag, _LABEL, selection=selection, progress=told)
    if asked is not None:
        asked = NamePatterns(asked).chosen("joint", recording.joint_names, SettingError)
    recording = recording.with_slides(known.slides)
    base = base_travel(options.bag, selection.namespace or "")
    return identify_robot(
        recording, robot, method, asked, str(options.urdf), str(options.bag), base
    )


def _contents(
    options: argparse.Namespace, robot: GivenRobot | None, found: RobotIdentification
) -> dict[Path, str | bytes]:
    """Return the contents of the files that are asked for."""
    contents: dict[Path, str | bytes] = {}
    if options.output is not None:
        header = [f"Identified from {options.bag.name}."]
        header += [f"Not whole: {each}." for each in found.missing]
        header += _HEADER
        joints = {} if robot is None else robot.description.joints
        ratios = {name: joint.gear_ratio for name, joint in joints.items()}
        contents[options.output] = experiment_text(found, ratios, _origin(options), header)
    if options.json is not None:
        document = {
            "bag": str(options.bag),
            "urdf": options.urdf,
            "missing": list(found.missing),
            "joints": as_mapping(found),
        }
        contents[options.json] = json.dumps(document, indent=2) + "\n"
    if options.plot is not None:
        from hpid_bench.report.plots import drawing_bytes

        form = options.plot.suffix.lower()[1:]
        contents[options.plot] = drawing_bytes(
            identification_figure(found.joints, found.slides), form
        )
    return contents


def _origin(options: argparse.Namespace) -> tuple[str, str] | None:
    """Return the key that names the robot, and its file as the written file names it."""
    if not options.urdf:
        return None
    file = find_resource(options.urdf)
    key = "extends" if file.suffix in (".yaml", ".yml") else "description"
    if key == "description" and options.urdf.startswith("package://"):
        return key, options.urdf
    try:
        return key, os.path.relpath(file.resolve(), options.output.resolve().parent)
    except ValueError:  # on another drive
        return key, str(file.resolve())

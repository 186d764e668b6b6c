"""``hpid identify``: inertia, friction, load and delay of a robot's joints, from a bag."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import SettingError
from hpid_ros.base.files import find_resource, refuse_outputs
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import (
    add_joints,
    add_time,
    add_topics,
    bag_selection,
    load_robot,
    write_output,
)

if TYPE_CHECKING:
    from hpid_ros.robot.description import GivenRobot
    from hpid_ros.tuning.robot_identification import RobotIdentification


_FORMATS = (".png", ".pdf", ".svg")
_LABEL = "recording"
_HEADER = (
    "An experiment says extends: and this file's name, or has these lines; check-gains and",
    "upgrade take it as --inertia and, where it names a robot, as --urdf.",
)


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "identify",
        description="Find what each joint's motor moves and what holds it back, from recorded "
        "positions and efforts, with 95 % intervals, and say what the recording cannot tell. "
        "With --urdf the links' masses are known, and rotors, friction and the effort's scale are "
        "sought; without, each joint is taken for itself, as if the others were at rest.",
        epilog="Exit code 1 if nothing could be found of any joint.",
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="bag folder or file")
    parser.add_argument(
        "--urdf",
        metavar="FILE",
        help="the robot: a URDF, or an experiment file (.yaml); its base stands still, and its "
        "own rotors and friction do not count",
    )
    add_joints(parser, "a joint to identify; may be repeated (all)")
    parser.add_argument(
        "--effort-unit",
        choices=("si", "any"),
        default="si",
        help="any: efforts are in a unit of their own, as of current, which the masses of --urdf "
        "fix (si: N m and N)",
    )
    parser.add_argument(
        "--cutoff", type=float, metavar="HZ", help="of the low pass (by each joint's noise)"
    )
    parser.add_argument(
        "--longest-delay", type=float, default=0.1, metavar="S", help="to look for (0.1 s)"
    )
    read = parser.add_argument_group("what is read from the bag")
    add_topics(read)
    add_time(read)
    written = parser.add_argument_group("output")
    written.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="what was found, as YAML that experiment files extend and that --urdf and --inertia "
        "of other commands take",
    )
    written.add_argument("--json", type=Path, metavar="FILE", help="every number")
    written.add_argument(
        "--plot", type=Path, metavar="FILE", help="predicted and measured efforts: png, pdf, svg"
    )
    written.add_argument("--force", action="store_true", help="replace files that exist")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Identify the joints of a bag."""
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.tuning.identification_report import report

    if options.effort_unit == "any" and not options.urdf:
        raise SettingError("--effort-unit any needs --urdf, whose masses fix the unit")
    if options.plot is not None and options.plot.suffix.lower() not in _FORMATS:
        raise SettingError(f"--plot must end in {', '.join(_FORMATS)}, not {options.plot.name!r}")
    inputs = [options.bag, *([Path(options.urdf)] if options.urdf else [])]
    outputs = [("-o", options.output), ("--json", options.json), ("--plot", options.plot)]
    refuse_outputs(outputs, force=options.force, inputs=inputs)
    robot = load_robot(options.urdf) if options.urdf else None
    found = _identified(options, robot)
    contents = _contents(options, robot, found)
    console = output_console()
    for part in report(found):
        console.print(part, soft_wrap=isinstance(part, str), highlight=False, markup=False)
    for path, content in contents.items():
        write_output(path, content)
        console.print(f"written: {path}", markup=False, soft_wrap=True, highlight=False)
    return DONE if any(each.is_found for each in found.joints) else FAILED


def _identified(options: argparse.Namespace, robot: GivenRobot | None) -> RobotIdentification:
    from hpid_ros.base.processes import raise_if_interrupted
    from hpid_ros.messages.run import read_run
    from hpid_ros.metrics.measure import sliding_joints
    from hpid_ros.tuning.identify import Method
    from hpid_ros.tuning.robot_identification import base_motion, identify_robot

    method = Method(options.cutoff, options.longest_delay, options.effort_unit == "any")
    # Other joints' motion counts where the robot is known, whichever are asked for.
    asked = options.joint or None
    selection = bag_selection(options, None if robot else asked, separates_runs=True)
    recording = read_run(
        options.bag, _LABEL, selection=selection, progress=lambda share: raise_if_interrupted()
    )
    recording = recording.with_slides(
        sliding_joints(options.bag, None, selection.namespace).slides
    )
    base = base_motion(options.bag, selection.namespace or "")
    return identify_robot(
        recording, robot, method, asked, str(options.urdf), str(options.bag), base
    )


def _contents(
    options: argparse.Namespace, robot: GivenRobot | None, found: RobotIdentification
) -> dict[Path, str | bytes]:
    """Return the contents of the files that are asked for."""
    from hpid_ros.tuning.identification_report import as_mapping, experiment_text

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
        from hpid_ros.report.plots import render
        from hpid_ros.tuning.identification_report import identification_figure

        form = options.plot.suffix.lower()[1:]
        contents[options.plot] = render(identification_figure(found.joints, found.slides), form)
    return contents


def _origin(options: argparse.Namespace) -> tuple[str, str] | None:
    """Return the key that names the robot, and its file as the written file names it."""
    if not options.urdf:
        return None
    file = find_resource(options.urdf)
    key = "extends" if file.suffix in (".yaml", ".yml") else "description"
    if options.urdf.startswith("package://"):
        return key, options.urdf
    try:
        return key, os.path.relpath(file.resolve(), options.output.resolve().parent)
    except ValueError:  # on another drive
        return key, str(file.resolve())

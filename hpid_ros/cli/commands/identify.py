"""``hpid identify``: inertia, friction, load and delay of a robot's joints, from a bag."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import SettingError
from hpid_ros.base.files import refuse_outputs, write_file
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import add_joints, add_time, add_topics, bag_selection, load_robot

if TYPE_CHECKING:
    from hpid_ros.robot.description import GivenRobot
    from hpid_ros.tuning.identification_report import Origin
    from hpid_ros.tuning.robot_identification import Findings


_FORMATS = (".png", ".pdf", ".svg")
_LABEL = "recording"


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
        "--plot",
        type=Path,
        metavar="FILE",
        help="predicted and measured efforts: png, pdf, svg",
    )
    written.add_argument("--force", action="store_true", help="replace files that exist")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Identify the joints of a bag."""
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.tuning.identification_report import report

    _check(options)
    robot = load_robot(options.urdf) if options.urdf else None
    found = _found(options, robot)
    console = output_console()
    parts = report(found.joints, found.sources, found.slides, found.moved, found.missing)
    for part in parts:
        console.print(part, soft_wrap=isinstance(part, str), highlight=False, markup=False)
    for path in _written(options, robot, found):
        console.print(f"written: {path}", markup=False, soft_wrap=True, highlight=False)
    return DONE if any(each.is_found for each in found.joints) else FAILED


def _check(options: argparse.Namespace) -> None:
    """Refuse what cannot be, before anything is read."""
    if options.effort_unit == "any" and not options.urdf:
        raise SettingError("--effort-unit any needs --urdf, whose masses fix the unit")
    if options.plot is not None and options.plot.suffix.lower() not in _FORMATS:
        raise SettingError(f"--plot must end in {', '.join(_FORMATS)}, not {options.plot.name!r}")
    inputs = [options.bag, *([Path(options.urdf)] if options.urdf else [])]
    outputs = [("-o", options.output), ("--json", options.json), ("--plot", options.plot)]
    refuse_outputs(outputs, force=options.force, inputs=inputs)


def _found(options: argparse.Namespace, robot: GivenRobot | None) -> Findings:
    from hpid_ros.base.processes import raise_if_interrupted
    from hpid_ros.messages.run import read_run
    from hpid_ros.metrics.measure import sliding_joints
    from hpid_ros.tuning.identify import Method
    from hpid_ros.tuning.robot_identification import base_motion, findings_of

    method = Method(options.cutoff, options.longest_delay, options.effort_unit == "any")
    # Other joints' motion counts where the robot is known, whoever is asked for.
    asked = options.joint or None
    selection = bag_selection(options, None if robot else asked, separates_runs=True)
    recording = read_run(
        options.bag, _LABEL, selection=selection, progress=lambda share: raise_if_interrupted()
    )
    recording = recording.with_slides(
        sliding_joints(options.bag, None, selection.namespace).slides
    )
    base = base_motion(options.bag, selection.namespace or "")
    return findings_of(recording, robot, method, asked, str(options.urdf), str(options.bag), base)


def _written(options: argparse.Namespace, robot: GivenRobot | None, found: Findings) -> list[Path]:
    """Write what was asked for, and return it."""
    from hpid_ros.tuning.identification_report import as_mapping

    contents: dict[Path, str | bytes] = {}
    if options.output is not None:
        contents[options.output] = _yaml(options, robot, found)
    if options.json is not None:
        joints = as_mapping(found.joints, found.sources, found.slides, found.moved)
        document = {
            "bag": str(options.bag),
            "urdf": options.urdf,
            "missing": list(found.missing),
            "joints": joints,
        }
        contents[options.json] = json.dumps(document, indent=2) + "\n"
    if options.plot is not None:
        from hpid_ros.tuning.identification_report import identification_figure, saved

        form = options.plot.suffix.lower()[1:]
        contents[options.plot] = saved(identification_figure(found.joints, found.slides), form)
    for path, content in contents.items():
        try:
            write_file(path, content)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise SettingError(f"cannot write {path}: {reason}") from None
    return list(contents)


def _yaml(options: argparse.Namespace, robot: GivenRobot | None, found: Findings) -> str:
    from hpid_ros.tuning.identification_report import experiment_text

    header = [
        f"Identified from {options.bag.name}.",
        *(f"Not whole: {each}." for each in found.missing),
        "An experiment says extends: and this file's name, or has these lines; check-gains and",
        "upgrade take it as --inertia and, where it names a robot, as --urdf.",
    ]
    return experiment_text(
        found.joints, found.moved, found.slides, _ratios(robot), _origin(options, robot), header
    )


def _ratios(robot: GivenRobot | None) -> dict[str, float]:
    joints = {} if robot is None else robot.description.joints
    return {name: joint.gear_ratio for name, joint in joints.items()}


def _origin(options: argparse.Namespace, robot: GivenRobot | None) -> Origin | None:
    from hpid_ros.base.files import find_resource
    from hpid_ros.tuning.identification_report import Origin

    if robot is None:
        return None
    file = find_resource(options.urdf)
    key = "extends" if file.suffix in (".yaml", ".yml") else "description"
    if options.urdf.startswith("package://"):
        return Origin(key, options.urdf)
    try:
        name = os.path.relpath(file.resolve(), options.output.resolve().parent)
    except ValueError:  # on another drive
        name = str(file.resolve())
    return Origin(key, name)

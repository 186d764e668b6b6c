"""Options that name a robot, and inertias: from a URDF, an experiment or numbers."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from hpid_ros.base.errors import ExperimentError, HpidError, SettingError, unknown_name
from hpid_ros.base.resources import find_resource
from hpid_ros.robot.given import GivenRobot

_POSES = 200


def load_robot(name: str) -> GivenRobot:
    """Return the robot of a URDF, of an experiment file or of what ``hpid identify`` wrote."""
    from hpid_ros.robot.description import RobotDescription

    file = find_resource(name)
    if file.suffix not in (".yaml", ".yml"):
        return GivenRobot(str(file), RobotDescription.load(file))
    identified = identified_robot(file)
    if identified is not None:
        return identified
    from hpid_ros.experiment.description import load_experiment

    world = load_experiment(file).world
    source = str(world.robot_description)
    description = RobotDescription.load(source)
    wheels = tuple(world.base.joints) if world.base is not None else ()
    return GivenRobot(source, description, world.fixed_base, world.initial_positions, wheels)


def identified_robot(file: Path) -> GivenRobot | None:
    """Return the robot of a file that is no experiment but says of a robot what one would."""
    from hpid_ros.documents.records import take_record
    from hpid_ros.documents.sections import Section
    from hpid_ros.documents.yaml_files import load_document
    from hpid_ros.robot.configuration import RobotSection
    from hpid_ros.robot.description import RobotDescription

    document = load_document(file, SettingError)
    values = document.values
    if not isinstance(values, Mapping) or "robot" not in values or "compare" in values:
        return None
    with document.blaming(SettingError):
        section = Section(values["robot"], "robot", SettingError)
        robot = take_record(RobotSection, section)
        section.finish()
        known = robot.load(
            lambda name: RobotDescription.load(find_resource(name, document.folders))
        )
    return GivenRobot(known.xml, known, robot.fixed_base, robot.initial_positions)


def add_robot_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--inertia``, ``--urdf``, ``--payload`` and ``--poses``."""
    parser.add_argument(
        "--inertia",
        action="append",
        nargs="+",
        default=[],
        metavar="M",
        help="of every joint: M, or LOW HIGH; of one: JOINT=M or JOINT=LOW:HIGH, also where "
        "--urdf says that of the others; or a file that hpid identify wrote (.yaml)",
    )
    parser.add_argument(
        "--urdf",
        metavar="FILE",
        help="compute inertias over the joints' ranges from this robot: a URDF, or an experiment "
        "file (.yaml) with what it knows better",
    )
    parser.add_argument(
        "--payload", type=float, default=0.0, metavar="KG", help="largest payload, with --urdf"
    )
    parser.add_argument(
        "--poses",
        type=int,
        metavar="N",
        help=f"sampled over the joints' ranges, with --urdf ({_POSES})",
    )


Range = tuple[float, float]


def inertias_from(
    options: argparse.Namespace,
    joints: Sequence[str],
    poses: Sequence[Mapping[str, float]] = (),
) -> dict[str, Range]:
    """Return the least and the largest inertia that the options say, by joint."""
    of_all, of_one = _given(options.inertia)
    for each in (text for texts in options.inertia for text in texts if _is_file(text)):
        in_file = _of_file(Path(each))
        of_one |= {joint: in_file[joint] for joint in joints if joint in in_file}
    unknown = [joint for joint in of_one if joint not in joints]
    if unknown:
        raise SettingError(unknown_name("joint in --inertia", unknown[0], joints))
    if of_all and options.urdf:
        raise SettingError(
            "--inertia takes JOINT=M or JOINT=LOW:HIGH beside --urdf, which says that of "
            "the others"
        )
    if of_all:
        found = dict.fromkeys(joints, of_all)
    elif options.urdf:
        asked = [joint for joint in joints if joint not in of_one]
        found = _of_robot(options, asked, poses) if asked else {}
    else:
        found = {}
    found |= of_one
    for joint, (low, high) in found.items():
        if not 0.0 < low <= high < math.inf:
            raise SettingError(
                f"the inertia of {joint!r} must be positive and finite, its least value not above "
                f"its largest, not {low:g} to {high:g} kg m^2"
            )
    return found


def _given(inertias: Sequence[Sequence[str]]) -> tuple[Range | None, dict[str, Range]]:
    """Return what ``--inertia`` says of all joints, and of single ones."""
    numbers: list[float] = []
    of_one: dict[str, Range] = {}
    for text in (each for texts in inertias for each in texts if not _is_file(each)):
        joint, is_named, value = text.rpartition("=")
        try:
            found = [float(each) for each in (value.split(":") if is_named else [value])]
        except ValueError:
            found = []
        if len(found) not in (1, 2) or (is_named and not joint):
            raise SettingError(
                f"--inertia takes M, LOW HIGH, JOINT=M or JOINT=LOW:HIGH, not {text!r}"
            )
        if is_named:
            of_one[joint] = (found[0], found[-1])
        else:
            numbers += found
    if len(numbers) > 2:
        raise SettingError(
            f"--inertia takes one number, or the least and the largest, not {len(numbers)}"
        )
    return ((numbers[0], numbers[-1]) if numbers else None), of_one


def _is_file(text: str) -> bool:
    return text.endswith((".yaml", ".yml"))


def _of_file(file: Path) -> dict[str, Range]:
    """Return the inertias that a file's ``controllers`` section has, by joint."""
    from hpid_ros.documents.yaml_files import load_document

    values = load_document(file, SettingError).values
    try:
        joints = values["controllers"]["joints"]
        found = {
            name: float(each["inertia"]) for name, each in joints.items() if "inertia" in each
        }
    except (KeyError, TypeError, ValueError, AttributeError):
        found = {}
    if not found:
        raise SettingError(f"--inertia {file}: it has no controllers.joints.JOINT.inertia")
    return {name: (value, value) for name, value in found.items()}


def _of_robot(
    options: argparse.Namespace, joints: Sequence[str], poses: Sequence[Mapping[str, float]]
) -> dict[str, Range]:
    from hpid_ros.tuning.inertias import inertia_ranges

    wanted = _POSES if options.poses is None else options.poses
    try:
        robot = load_robot(options.urdf)
        if poses and options.poses is None:
            known = [{**robot.initial_positions, **pose} for pose in poses]
            return inertia_ranges(robot.description, joints, options.payload, known)
        return inertia_ranges(robot.description, joints, options.payload, wanted)
    except ExperimentError:  # names the file itself
        raise
    except HpidError as error:
        raise SettingError(f"{options.urdf}: {error}") from None

"""The options of ``hpid metrics``, and what they choose."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.cli.bag_options import add_time, add_topics, bag_selection

if TYPE_CHECKING:
    from hpid_ros.bags.selection import Reference
    from hpid_ros.metrics import Measuring
    from hpid_ros.metrics.end_effector import TaskFrame
    from hpid_ros.metrics.sources import Source

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


def add_options(parser: Any) -> None:
    """Add all options to the parser of the command."""
    _add_inputs(parser)
    _add_selection(parser.add_argument_group("what is read from the bags"))
    _add_numbers(parser.add_argument_group("numbers"))
    _add_robot(parser.add_argument_group("the robot"))
    _add_outputs(parser.add_argument_group("output"))


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
    from hpid_ros.base.errors import SettingError
    from hpid_ros.base.names import require_label
    from hpid_ros.metrics.sources import Source, expanded

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
    if options.baseline is not None and Path(options.baseline).exists():
        sources = _with_baseline_first(sources, Path(options.baseline))
    if not sources:
        raise SettingError("name at least one bag, result folder or file of saved indices")
    return sources


def _with_baseline_first(sources: Sequence[Source], baseline: Path) -> list[Source]:
    from hpid_ros.metrics.sources import Source, expanded

    def is_baseline(each: Source) -> bool:
        return each.path.resolve() == baseline.resolve()

    first = [each for each in sources if is_baseline(each)] or expanded(Source(baseline))
    return [*first, *(each for each in sources if not is_baseline(each))]


def baseline_label(options: argparse.Namespace) -> str | None:
    """Return the label of the baseline; None if it was named by its path, or not at all."""
    if options.baseline is None or Path(options.baseline).exists():
        return None
    return str(options.baseline)


def measuring(options: argparse.Namespace) -> Measuring:
    """Return how the bags are to be read, and what is to be computed of them."""
    from hpid_ros.metrics import Measuring

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
    from hpid_ros.base.errors import SettingError
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
            from hpid_ros.base.errors import SettingError

            raise SettingError("--end-effector and --wheels need --robot URDF")
        return None
    from hpid_ros.base.resources import find_resource
    from hpid_ros.experiment.description import load_experiment
    from hpid_ros.metrics.end_effector import TaskFrame
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

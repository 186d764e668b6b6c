"""The options of ``hpid metrics``, and the choices that they make."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.cli.commands.metrics.robot import add_robot_options

if TYPE_CHECKING:
    from hpid_ros.analysis.indices.run import IndexSettings
    from hpid_ros.bags.selection import BagSelection, Reference

EXAMPLES = """\
examples:
  hpid metrics my_bag                                  one recording
  hpid metrics pid_bag hpid_bag --labels PID hPID      the second against the first
  hpid metrics --group PID pid_* --group hPID hpid_*   repeats: medians and quartiles
  hpid metrics my_bag --indices step,rmse --units deg  other indices, angles in degrees
  hpid metrics my_bag --reference my_motion.yaml       no reference in the bag: it is given
  hpid metrics my_bag --command-topic elbow=/group_controller/commands[2]
  hpid metrics a_bag b_bag --save ab.json --report ab.html
  hpid metrics my_bag --robot my_robot.urdf            and how far its hand was off
  hpid metrics ab.json results/mine/result.json        saved numbers instead of bags
"""


def add_options(parser: Any) -> None:
    """Add all options to the parser of the command."""
    _add_inputs(parser)
    _add_selection(parser.add_argument_group("what is read from the bags"))
    _add_numbers(parser.add_argument_group("numbers"))
    add_robot_options(parser.add_argument_group("end effector"))
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
    group.add_argument("--namespace", metavar="NAME", help="which of several robots")
    group.add_argument("--states", metavar="TOPIC", help="of the joint states")
    group.add_argument(
        "--commands",
        metavar="TOPIC",
        help="of the efforts; effort: *_controller/commands are efforts, the topic of the states: "
        "measured ones, none: none (found by name and type, else the measured ones)",
    )
    group.add_argument(
        "--command-topic",
        action="append",
        default=[],
        metavar="JOINT=TOPIC[INDEX]",
        help="of one joint's efforts; may be given several times",
    )
    group.add_argument(
        "--reference",
        default="auto",
        metavar="TOPIC|FILE|hold",
        help="what the joints were to follow: a topic; a YAML file with a reference section, as "
        "experiments have, followed from the first state on; hold: each joint its first position; "
        "or a kind of topic: trajectory, setpoint, sampled, controller_state (auto: any of these "
        "kinds that is there)",
    )
    group.add_argument(
        "--clock", default="header", metavar="CLOCK", help="header or receive (header)"
    )
    group.add_argument("--start", type=float, metavar="S", help="seconds after the first state")
    group.add_argument("--end", type=float, metavar="S", help="seconds after the first state")


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
        metavar="[JOINT=]NM",
        help="effort at which a joint saturates (found in its efforts)",
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


def bag_selection(options: argparse.Namespace) -> BagSelection:
    """Return what is to be read from the bags.

    Raises:
        SettingError: The options are no selection.
    """
    from hpid_ros.bags.selection import BagSelection, parse_command_topics

    return BagSelection(
        joints=options.joints,
        namespace=options.namespace,
        states=options.states,
        commands=options.commands,
        command_topics=parse_command_topics(options.command_topic),
        reference=_reference(options.reference),
        clock=options.clock,
        start=options.start,
        end=options.end,
    )


def _reference(text: str) -> Reference:
    """Return a kind or a topic as it is, and the trajectory of a file.

    Raises:
        HpidError: The file is not there, or has no usable reference.
    """
    if Path(text).suffix not in (".yaml", ".yml") and not Path(text).is_file():
        return text
    from hpid_ros.experiment.description import load_reference

    return load_reference(text)


def index_settings(options: argparse.Namespace, joints: Sequence[str]) -> IndexSettings:
    """Return the settings of the indices for a run with these joints.

    Raises:
        SettingError: An effort limit is no number.
        SeriesError: A value is not positive, or names a joint that is not there.
    """
    from hpid_ros.analysis.indices.run import DEFAULT_CUTOFF, IndexSettings
    from hpid_ros.base.errors import SettingError

    limits: dict[str, float] = {}
    for text in options.effort_limit:
        name, separator, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            raise SettingError(f"--effort-limit must be NM or JOINT=NM, got {text!r}") from None
        limits |= {name: value} if separator else dict.fromkeys(joints, value)
    cutoff = DEFAULT_CUTOFF if options.cutoff is None else options.cutoff
    return IndexSettings(cutoff=cutoff, effort_limits=limits)

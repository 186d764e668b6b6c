"""What the subcommands of ``hpid`` take that look at recordings and results."""

from __future__ import annotations

import argparse
from pathlib import Path

from hpid_bench.cli.parser import Parser
from hpid_bench.cli.shared_arguments import (
    comma_separated,
    joint_options,
    times_options,
    topics_options,
)


def metrics(parser: Parser) -> None:
    parser.describe(
        "BAG ...",
        "Compute performance indices of recordings, the first the baseline; tables, figures and a "
        "report. docs/indices.md defines every number.",
        {
            "hpid metrics my_bag": "one recording",
            "hpid metrics pid_bag hpid_bag --labels PID hPID": "second against first",
            "hpid metrics --group PID pid_* --group hPID hpid_*": "repeats: medians",
            "hpid metrics my_bag --indices step,rmse --units deg": "other indices",
            "hpid metrics my_bag --reference my_motion.yaml": "none in the bag: given",
            "hpid metrics a b --save ab.json --report ab.html": "to read again, a page",
        },
    )
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
        help="repeats of one run, for instance with other seeds; may be repeated",
    )
    parser.add_argument(
        "--baseline",
        metavar="BAG",
        help="what ratios are taken of: one of the bags, another one, or a label (the first)",
    )
    parser.add_argument(
        "--joint",
        dest="joints",
        action="append",
        default=None,
        metavar="NAME",
        help="this joint, or 'arm_*'; '!*hand*' leaves out (all)",
    )
    parser.add_argument(
        "--joints", action="extend", nargs="+", metavar="JOINT", help=argparse.SUPPRESS
    )
    parser.add_argument(
        "--reference",
        default="auto",
        metavar="TOPIC|FILE|hold",
        help="what the joints were to follow: a topic, or a kind of it (trajectory, setpoint, "
        "sampled, controller_state); a YAML file with a reference section; hold: each its first "
        "position (auto: as reported or asked)",
    )
    parser.add_argument(
        "--indices",
        default="paper",
        metavar="NAME,...",
        help="ivc, iavc, itae, iae, ise, rmse, error_max, effort_l2, error_l2, rise_time, "
        "settling_time, overshoot, steady_state_error, saturation, chatter, energy; or paper, "
        "step, all (paper)",
    )
    parser.add_argument("--units", default="rad", metavar="UNIT", help="of angles: rad, deg (rad)")
    output_format = parser.add_mutually_exclusive_group()
    output_format.add_argument(
        "--format", choices=("table", "csv", "json"), default="table", help="of the output (table)"
    )
    output_format.add_argument(
        "--csv", dest="format", action="store_const", const="csv", help="the same as --format csv"
    )
    output_format.add_argument(
        "--json", dest="format", action="store_const", const="json", help="likewise"
    )
    parser.add_argument("--save", type=Path, metavar="FILE", help="all numbers, to be read again")
    parser.add_argument("--report", type=Path, metavar="FILE", help="one self-contained web page")
    parser.add_argument(
        "--figures", type=Path, metavar="FOLDER", help="draw the figures for print"
    )
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    rare = parser.rare()
    topics_options(rare)
    times_options(rare)
    rare.add_argument(
        "--align",
        default="auto",
        metavar="HOW",
        help="lay runs over each other where their references begin, where these first move "
        "(motion), or not (none) (auto: begin, or motion where that makes them one)",
    )
    rare.add_argument(
        "--window",
        action="append",
        default=[],
        metavar="LABEL=START[:END]",
        help="part of one recording, in s after its first state, instead of --align",
    )
    rare.add_argument(
        "--overall", action="store_true", help="only the numbers over all joints, one a line"
    )
    rare.add_argument(
        "--cutoff", type=float, metavar="HZ", help="effort above it is chatter (20 Hz)"
    )
    rare.add_argument(
        "--effort-limit",
        action="append",
        default=[],
        metavar="[JOINT=]EFFORT",
        help="in N m, or N where it slides, at which a joint saturates (found in its efforts)",
    )
    rare.add_argument(
        "--robot",
        metavar="URDF",
        help="says which joints slide, in m and N (else the bag does, if it holds "
        "/robot_description); also tell how far its end effector was from the reference, by "
        "forward kinematics; an experiment file (.yaml) names wheels and initial positions, too",
    )
    rare.add_argument(
        "--end-effector", metavar="LINK", help="link whose pose counts, with --robot (the last)"
    )
    rare.add_argument(
        "--wheels",
        nargs=2,
        metavar=("LEFT", "RIGHT"),
        help="joints of the wheels of a base, with --robot: its odometry is added",
    )
    rare.add_argument(
        "--formats",
        type=comma_separated,
        default=("png",),
        metavar="FORMAT,...",
        help="of the figures: png, pdf, svg (png)",
    )
    rare.add_argument(
        "--params",
        type=Path,
        metavar="FILE",
        help="parameter file of the controllers, for the report (from a result folder beside)",
    )
    rare.add_argument(
        "--parameters", dest="params", type=Path, metavar="FILE", help=argparse.SUPPRESS
    )


def replay(parser: Parser) -> None:
    parser.describe(
        "BAG",
        "Feed the recorded states, references and parameter changes to the same control loops, "
        "and say whether every command is theirs, or where and how it is not. A bag must hold the "
        "states, the commands with the stamps of the states that they answer (joint_commands), "
        "and what the controllers were told: joint_trajectory, ~/setpoint, and /parameter_events "
        "if anything was retuned.",
        {
            "hpid replay results/mine/bags/hPID": "a bag of hpid compare or run",
            "hpid replay my_bag --params controllers.yaml": "a bag of ros2 bag record",
        },
        "Exit codes: 0 every command is the law's, 1 one is not, 2 the input cannot be used.",
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="a bag folder, or one file of it")
    parser.add_argument(
        "--params",
        type=Path,
        metavar="FILE",
        help="parameter file of the controllers as they were started (those in the bag)",
    )
    joint_options(parser)
    parser.add_argument("--namespace", metavar="NAME", help="only topics below this namespace")
    parser.add_argument(
        "--states",
        action="append",
        default=[],
        metavar="TOPIC",
        help="topic of the states; once for each topic of one robot",
    )
    parser.add_argument("--commands", metavar="TOPIC", help="topic of the commands")


def repair(parser: Parser) -> None:
    parser.describe(
        "BAG",
        "Write every message that can be read into a new bag, with its index and metadata.yaml, "
        "and say what was saved and what was lost. The old bag is never changed.",
        {
            "hpid repair my_bag": "the readable part into my_bag_repaired",
            "hpid repair my_bag.mcap -o saved": "of one file that lost its folder",
        },
        "Exit codes: 0 a bag was written (what was lost is listed), 2 nothing could be read or "
        "written.",
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="a bag folder, or one file of it")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FOLDER",
        help="the new bag, which must not exist (BAG_repaired beside BAG)",
    )


def figures(parser: Parser) -> None:
    parser.describe(
        "RESULT",
        "Draw the figures of a result for print: positions, errors, efforts, norms, spectra, "
        "phase portraits, gain multipliers, error against effort, the end effector's path.",
        {
            "hpid figures results/mine": "PNG, in its folder figures/",
            "hpid figures results/mine --formats pdf,svg": "for a paper",
        },
    )
    parser.add_argument(
        "result", type=Path, metavar="RESULT", help="folder of hpid compare or run"
    )
    parser.add_argument(
        "--formats",
        type=comma_separated,
        default=("png",),
        metavar="FORMAT,...",
        help="png, pdf, svg (png)",
    )
    parser.add_argument("--force", action="store_true", help="replace figures that exist")


def render(parser: Parser) -> None:
    parser.describe(
        "RESULT",
        "Draw the robot of a result as it was recorded, under each controller side by side, above "
        "the error over time; green is where the references are. The suffix of FILE is the "
        "format: .webp (small), .gif, .png (lossless); of one picture also .jpg.",
        {
            "hpid render results/mine --report": "animation.webp, in the report",
            "hpid render results/mine --to 4 --speed 0.2": "slow motion",
            "hpid render results/mine --at 3.3 -o arm.png": "one picture",
        },
    )
    parser.add_argument(
        "result", type=Path, metavar="RESULT", help="folder of hpid compare or run"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="(animation.webp in RESULT)"
    )
    parser.add_argument(
        "--report", action="store_true", help="put the animation into RESULT's report.html, too"
    )
    parser.add_argument(
        "--from",
        dest="start",
        type=float,
        default=0.0,
        metavar="S",
        help="first instant, in s (0)",
    )
    parser.add_argument("--to", type=float, metavar="S", help="last instant, in s (the end)")
    parser.add_argument("--at", type=float, metavar="S", help="one picture, of this instant in s")
    parser.add_argument(
        "--speed",
        type=float,
        metavar="X",
        help="seconds shown in one (1, or more for runs of more than 10 s)",
    )
    parser.add_argument(
        "--joint", metavar="NAME", help="draw its position, not the error's norm over all joints"
    )
    parser.add_argument(
        "--controller",
        action="append",
        default=[],
        metavar="LABEL",
        help="show this run; may be repeated (all, at most 4)",
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    rare = parser.rare()
    rare.add_argument("--size", default="720x450", metavar="WxH", help="in pixels (720x450)")
    rare.add_argument(
        "--fps", type=float, default=12.5, metavar="N", help="pictures in a second (12.5)"
    )
    rare.add_argument(
        "--view",
        nargs=2,
        type=float,
        default=(-50.0, 16.0),
        metavar=("AZIMUTH", "ELEVATION"),
        help="where the camera stands, in degrees (-50 16)",
    )
    rare.add_argument(
        "--engine",
        help="kept from earlier versions, pybullet or mujoco: MuJoCo draws, which needs OpenGL "
        "but no screen",
    )

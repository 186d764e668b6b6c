"""What the subcommands of ``hpid`` take that are for loops, their gains and running robots."""

from __future__ import annotations

from pathlib import Path

from hpid_bench.cli.parser import Parser
from hpid_bench.cli.shared_arguments import (
    graph_options,
    joint_options,
    robot_options,
    times_options,
    topics_options,
)

GAIN_OPTIONS = {
    "p": "gains.p",
    "i": "gains.i",
    "d": "gains.d",
    "mu": "mu",
    "norm": "norm.type",
    "error_scale": "norm.error_scale",
    "rate_weight": "norm.rate_weight",
    "period": "control_period",
}
"""Options of check-gains by the controllers' parameter that they stand for."""


def robot(parser: Parser) -> None:
    parser.describe(
        "FILE",
        "Show the joints of a URDF, or of an experiment's robot with all that the experiment "
        "knows better, and what to know before it is simulated. Ends with 1 where limits are "
        "missing.",
        {"hpid robot arm.urdf": "", "hpid robot found.yaml --save known.urdf": ""},
    )
    parser.add_argument("file", metavar="FILE", help="URDF, or experiment file (.yaml)")
    parser.add_argument(
        "--poses", type=int, default=200, metavar="N", help="sampled for the inertias (200)"
    )
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument("--save", type=Path, metavar="URDF", help="write the robot to a new file")
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def excite(parser: Parser) -> None:
    parser.describe(
        "[--joint NAME]",
        "Move joints of a running robot, by sums of sines or steps within shares of their limits, "
        "through the controllers that run, and record it. It asks before anything moves. At any "
        "limit, when a controller, the states or the recorder are silent, when somebody else "
        "sends a trajectory, and at Ctrl-C the joints come to rest, and their controllers hold "
        "them. Watch the robot, with a hand at its emergency stop: it knows neither its "
        "surroundings nor itself.",
        {
            "hpid excite --joint elbow --dry-run": "the plan, and nothing moves",
            "hpid excite --joint elbow -o elbow_bag": "then: hpid identify elbow_bag",
        },
    )
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="NAME",
        help="only this joint; may be repeated (all that run)",
    )
    parser.add_argument(
        "--kind", choices=("multisine", "steps"), default="multisine", help="of motion (multisine)"
    )
    parser.add_argument(
        "--together", action="store_true", help="all joints at once, not one after the other"
    )
    parser.add_argument(
        "--duration", type=float, default=20.0, metavar="S", help="of each joint (20)"
    )
    parser.add_argument(
        "--share",
        type=float,
        default=0.5,
        help="of what is left of each limit of position and effort, and of the velocity limit "
        "(0.5)",
    )
    parser.add_argument(
        "--amplitude", type=float, default=0.5, metavar="A", help="at most, in rad or m (0.5)"
    )
    rare = parser.rare()
    robot_options(parser, rare)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="BAG", help="new folder (excitation-TIME)"
    )
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="draw the plan: .png, .pdf or .svg"
    )
    parser.add_argument("--force", action="store_true", help="replace the file of --plot")
    parser.add_argument(
        "--dry-run", action="store_true", help="show what would be done, and do nothing"
    )
    parser.add_argument("--yes", action="store_true", help="move without asking")
    graph_options(rare)
    rare.add_argument(
        "--frequencies",
        nargs=2,
        type=float,
        default=(0.1, 2.5),
        metavar=("LOW", "HIGH"),
        help="of the sines in Hz (0.1 2.5)",
    )
    rare.add_argument("--velocity", type=float, metavar="V", help="at most, in rad/s or m/s")
    rare.add_argument(
        "--acceleration", type=float, metavar="A", help="at most, in rad/s^2 or m/s^2"
    )
    rare.add_argument(
        "--tolerance",
        type=float,
        default=0.0,
        metavar="E",
        help="stop a joint that is further from its reference, in rad or m (half its amplitude)",
    )
    rare.add_argument("--seed", type=int, default=0, help="of the sines' phases (0)")


def identify(parser: Parser) -> None:
    parser.describe(
        "BAG",
        "Find what each joint's motor moves and what holds it back, from recorded positions and "
        "efforts, with 95 % intervals, and say what the recording cannot tell. With --urdf the "
        "links' masses are known, and rotors, friction and the effort's scale are sought; "
        "without, each joint is taken for itself, as if the others were at rest.",
        {
            "hpid identify my_bag --urdf arm.urdf -o found.yaml": "for --urdf of others",
            "hpid identify my_bag --joint elbow --plot elbow.png": "look at one joint",
        },
        "Exit code 1 if nothing could be found of any joint.",
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="bag folder or file")
    parser.add_argument(
        "--urdf",
        metavar="FILE",
        help="the robot: a URDF, or an experiment file (.yaml); its base stands still, and its "
        "own rotors and friction do not count",
    )
    joint_options(parser)
    parser.add_argument(
        "--effort-unit",
        choices=("si", "any"),
        default="si",
        help="any: efforts are in a unit of their own, as of current, which the masses of --urdf "
        "fix (si: N m and N)",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="what was found, as YAML that experiment files extend and that --urdf and --inertia "
        "of other commands take",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="every number")
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="predicted and measured efforts: .png, .pdf or .svg",
    )
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    rare = parser.rare()
    topics_options(rare)
    times_options(rare)
    rare.add_argument(
        "--cutoff", type=float, metavar="HZ", help="of the low pass (by each joint's noise)"
    )
    rare.add_argument(
        "--longest-delay", type=float, default=0.1, metavar="S", help="to look for (0.1 s)"
    )


def check_gains(parser: Parser) -> None:
    parser.describe(
        "[FILE]",
        "Check gains given as options, in a controller parameter file or experiment, or of the "
        "controllers that run. Exit code 0 only if every joint is certified.",
        {
            "hpid check-gains my.yaml --urdf arm.urdf": "of a file",
            "hpid check-gains --live --inertia 0.2": "of what runs",
            "hpid check-gains --p 40 --i 130 --d 4 --mu -0.2 --inertia 0.2": "one",
        },
    )
    parser.add_argument(
        "file",
        nargs="?",
        type=Path,
        metavar="FILE",
        help="parameter file, experiment, or certificates.json of a result, to verify",
    )
    parser.add_argument("--live", action="store_true", help="of all running joint controllers")
    for name, parameter in GAIN_OPTIONS.items():
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            type=str if name == "norm" else float,
            help=f"as {parameter}",
        )
    robot_options(parser, parser.rare())
    parser.add_argument("--json", action="store_true", help="everything, with the certificates")


def margins(parser: Parser) -> None:
    parser.describe(
        "FILE",
        "Compute the margins of every joint's loop as it is sampled and held, over the inertia "
        "and, for the homogeneous law, over the multipliers that it reaches, each frozen in turn; "
        "beside them what is certified of the law itself. docs/margins.md defines every number.",
        {
            "hpid margins my.yaml --urdf arm.urdf --delay 0.002": "all",
            "hpid margins my.yaml --joint elbow --plot elbow.png": "one, drawn",
        },
        "Exit code 0 if every frozen loop is stable, 1 if one is not.",
    )
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="parameter file of controllers, or experiment"
    )
    joint_options(parser)
    parser.add_argument(
        "--controller", metavar="LABEL", help="only this controller of an experiment (all)"
    )
    rare = parser.rare()
    robot_options(parser, rare)
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
        "--bag",
        type=Path,
        help="recorded excitation: the measured frequency response is compared and drawn",
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
    rare.add_argument(
        "--norm-max",
        type=float,
        metavar="N",
        help="largest norm that the loops reach (norm.cap, or 2 where there is none)",
    )
    rare.add_argument(
        "--coherence",
        type=float,
        default=0.95,
        metavar="C",
        help="frequencies of the bag with less are left out (0.95)",
    )


def upgrade(parser: Parser) -> None:
    parser.describe(
        "FILE|BAG",
        "Of a parameter FILE: choose norm and degree for the gains of a PID, inside the certified "
        "interval, and write a controller parameter file with a comment on every number. Of a BAG "
        "with --urdf: identify the robot, check the PID that ran, propose, predict in simulation "
        "what that will bring, and write parameters, a page and the prediction. A joint keeps its "
        "PID where there is nothing to gain.",
        {
            "hpid upgrade my_bag --urdf arm.urdf": "upgrade.yaml and .html",
            "hpid upgrade pid.yaml --goal fast --urdf arm.urdf": "upgraded.yaml",
            "hpid upgrade --verify before_bag after_bag": "did the prediction hold?",
        },
        "Exit code 1 if a joint could not be upgraded (the file holds it as it was, with the "
        "reason), if the simulated PID is nothing like the recorded one (only the page is "
        "written), or if a prediction did not hold.",
    )
    parser.add_argument(
        "file",
        nargs="?",
        type=Path,
        metavar="FILE|BAG",
        help="parameter file of the PID, or a bag that was recorded under it",
    )
    parser.add_argument(
        "--goal",
        choices=("smooth", "fast", "balanced"),
        help="smooth lowers the variation of the effort, fast shortens transients; balanced does "
        "both for the robot as a whole, by one norm in N m for all joints, and needs a "
        "recording. A FILE needs it, of a BAG it is balanced",
    )
    rare = parser.rare()
    robot_options(parser, rare)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="new file (upgraded.yaml; of a BAG upgrade.yaml, .html and .json)",
    )
    parser.add_argument("--force", action="store_true", help="replace existing files")
    parser.add_argument(
        "--verify",
        nargs=2,
        type=Path,
        metavar=("BEFORE", "AFTER"),
        help="hold the prediction against two bags of the same motion",
    )
    rare.add_argument(
        "--bag",
        type=Path,
        help="beside FILE: recorded under the PID; gives scales and floor and, with --urdf, the "
        "poses for the inertias, unless --poses asks for others",
    )
    rare.add_argument(
        "--params",
        type=Path,
        metavar="FILE",
        help="beside BAG: parameters of the controllers that ran, if the bag does not hold them",
    )
    rare.add_argument(
        "--prediction",
        type=Path,
        metavar="FILE",
        help="with --verify: what upgrade BAG has written (upgrade.json)",
    )


def autotune(parser: Parser) -> None:
    parser.describe(
        "--live [--joint NAME]",
        "Have a relay drive one joint of a running robot for some cycles, inside its own "
        "controller and under all of its limits, record it, and propose SIMC gains and the "
        "homogeneous PID with them. It asks before the joint moves and before it writes a file, "
        "and never sets parameters. Ctrl-C, a reference, parameters, a missing state end the "
        "relay; so does the controller, after 30 s at the latest. Have a hand at the emergency "
        "stop.",
        {
            "hpid autotune --live --joint elbow --dry-run": "nothing moves",
            "hpid autotune --live --joint elbow -o elbow.yaml": "",
        },
    )
    parser.add_argument(
        "--live", action="store_true", help="on the robot that runs (there is no other way yet)"
    )
    parser.add_argument("--joint", metavar="NAME", help="which (the only one that runs)")
    parser.add_argument(
        "--effort",
        type=float,
        default=0.0,
        metavar="A",
        help="amplitude of the relay in N m (--share)",
    )
    parser.add_argument(
        "--share", type=float, default=0.2, help="of what the load leaves of the limits (0.2)"
    )
    parser.add_argument(
        "--amplitude", type=float, default=0.05, metavar="A", help="of the motion in rad (0.05)"
    )
    parser.add_argument("--cycles", type=int, default=8, metavar="N", help="(8)")
    parser.add_argument(
        "--inertia", type=float, metavar="M", help="about, to choose the relay (by the gains)"
    )
    parser.add_argument(
        "--closed-loop-time", type=float, metavar="S", help="of SIMC (four effective delays)"
    )
    parser.add_argument(
        "--goal", choices=("smooth", "fast"), default="fast", help="of the upgrade (fast)"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="controller file")
    parser.add_argument("--bag", type=Path, help="new folder (autotune-TIME)")
    parser.add_argument("--force", action="store_true", help="replace the file of -o")
    parser.add_argument("--dry-run", action="store_true", help="show the relay, and do nothing")
    parser.add_argument("--yes", action="store_true", help="move and write without asking")
    graph_options(parser.rare())


def live(parser: Parser) -> None:
    parser.describe(
        "",
        "Serve a page for the controllers that run, and open it in the browser: see joints, "
        "retune them within what is certified, try motions, stop. Ctrl-C ends the page, and "
        "changes nothing on the robot.",
        {"hpid live": "", "hpid live --no-browser --port 0": "print the address alone"},
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="where to listen (127.0.0.1: this computer alone); another one needs --token",
    )
    parser.add_argument(
        "--port", type=int, default=8080, metavar="N", help="0 chooses a free one (8080)"
    )
    parser.add_argument(
        "--token", default="", metavar="TEXT", help="what opens the page (drawn anew each time)"
    )
    parser.add_argument("--no-browser", action="store_true", help="print the address alone")
    parser.add_argument(
        "--rate", type=float, default=30.0, metavar="HZ", help="frames a second, 5 to 60 (30)"
    )
    parser.add_argument(
        "--button-timeout",
        type=float,
        default=0.4,
        metavar="S",
        help="joints stop when nothing was heard of a held button for so long, 0.2 to 2 (0.4)",
    )


def export(parser: Parser) -> None:
    parser.describe(
        "FILE (--c | --ros2-control) -o DIR",
        "Write the loop of each joint as self-contained C99, with a program that replays what "
        "Python answers to a thousand states; or all loops as a package for ros2_control, with "
        "certificates of the gains around theirs.",
        {
            "hpid export my.yaml --c -o c_code": "for a microcontroller",
            "hpid export my.yaml --ros2-control -o my_arm": "for colcon build",
        },
        "--urdf gives the joints' limits, too, and the inertias that nothing else says. "
        "docs/export.md says what the code holds and what stays with the node.",
    )
    kinds = parser.add_mutually_exclusive_group(required=True)
    kinds.add_argument("--c", action="store_true", help="in C99")
    kinds.add_argument(
        "--ros2-control", action="store_true", help="a plugin for controller_manager"
    )
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="parameter file of controllers, or experiment"
    )
    joint_options(parser)
    parser.add_argument(
        "--controller",
        metavar="LABEL",
        help="of an experiment (its first with a homogeneous loop)",
    )
    parser.add_argument(
        "--precision",
        choices=("double", "single"),
        default="double",
        help="of the numbers in C (double); a macro in the header can say another",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder to write into; its name is that of the package",
    )
    parser.add_argument("--force", action="store_true", help="replace existing files")
    robot_options(parser, parser.rare())

"""What the subcommands of ``hpid`` take that run experiments, and those about the tool itself."""

from __future__ import annotations

import argparse

from hpid_bench.cli.parser import Parser
from hpid_bench.cli.shared_arguments import (
    comma_separated,
    engine_options,
    experiment_options,
    jobs_options,
    output_options,
    process_options,
)


def compare(parser: Parser) -> None:
    parser.describe(
        "[FILE]",
        "Run the controllers of an experiment on the ROS 2 graph, one node per joint, record "
        "everything, and leave the table, the bags and a report.",
        {
            "hpid compare": "the paper's comparison",
            "hpid compare --in-process --engine mujoco": "the same numbers, in seconds",
            "hpid compare my.yaml -o mine --figures png": "your own, with figures",
        },
    )
    experiment_options(parser)
    engine_options(parser)
    output_options(parser, "NAME")
    how_it_runs = process_options(parser)
    how_it_runs.add_argument(
        "--in-process", action="store_true", help="without ROS; the numbers are the same"
    )
    parser.add_argument(
        "--figures",
        type=comma_separated,
        default=(),
        metavar="FORMAT,...",
        help="also draw figures for print: png, pdf, svg or none; hpid figures does so later "
        "(none)",
    )
    parser.add_argument(
        "--no-figures", dest="figures", action="store_const", const=(), help=argparse.SUPPRESS
    )
    parser.add_argument(
        "--animation",
        action="store_true",
        help="animate the robot, in animation.webp and in the report (hpid render has more)",
    )


def run(parser: Parser) -> None:
    parser.describe(
        "[FILE]",
        "Run one controller of an experiment on the ROS 2 graph, record it, and end with its "
        "indices and with a table of periods, compute times, latencies and losses.",
        {
            "hpid run": "the homogeneous PID of the paper",
            "hpid run my.yaml --controller PID": "another one",
            "hpid run --realtime --composed": "real time, controllers in one process",
        },
    )
    experiment_options(parser)
    engine_options(parser)
    parser.add_argument(
        "--controller", metavar="LABEL", help="which of its controllers (the last one)"
    )
    process_options(parser)
    parser.add_argument(
        "--realtime", action="store_true", help="paced by the wall clock, not in lock-step"
    )
    parser.add_argument(
        "--no-trial",
        action="store_true",
        help="with --realtime: begin at once, without a second in lock-step that tells what rate "
        "the machine holds",
    )
    parser.add_argument(
        "--realtime-priority",
        type=int,
        default=0,
        metavar="N",
        help="SCHED_FIFO priority of the control loop, 1 to 99",
    )
    parser.add_argument("--no-record", action="store_true", help="leave no bag and no indices")
    output_options(parser, "NAME")


def sweep(parser: Parser) -> None:
    parser.describe(
        "[FILE] --vary NAME=VALUES",
        "Run one controller of an experiment over a grid of parameters and seeds, without ROS, "
        "and compare every point with the experiment's first controller.",
        {
            "hpid sweep --vary mu=-0.3:0.3:7": "the degree",
            "hpid sweep --vary mu=-.2,0 --vary payload=0,2": "a grid",
        },
        "A point that a loop refuses stays in the table with the reason; a run that fails is "
        "named there, the others go on, and the exit code is 1. An interrupt ends at once and "
        "leaves what was run.",
    )
    experiment_options(parser)
    engine_options(parser)
    parser.add_argument(
        "--vary",
        action="append",
        required=True,
        default=[],
        metavar="NAME=VALUES",
        help="START:STOP:COUNT or VALUE,VALUE,... of a controller parameter, or of payload, "
        "physics_steps or encoder_counts; several make a grid",
    )
    parser.add_argument(
        "--controller", metavar="LABEL", help="which (the first after the baseline)"
    )
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="NAME",
        help="vary and judge this joint only; may be repeated",
    )
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="runs of each point (20)"
    )
    jobs_options(parser)
    output_options(parser, "NAME-sweep")
    parser.add_argument(
        "--format", choices=("table", "csv", "json"), default="table", help="of the output (table)"
    )


def study(parser: Parser) -> None:
    parser.describe(
        "[FILE ...]",
        "Run every controller of every experiment with many seeds, without ROS: medians with "
        "quartiles, ratios to each experiment's first controller, and whether the paper's claims "
        "hold.",
        {
            "hpid study": "all experiments of this package",
            "hpid study my.yaml --seeds 50 -o mine": "your own",
            "hpid study -o mine --resume": "carry on after an interrupt",
        },
        "A run that fails is named, the others go on, and the exit code is 1.",
    )
    parser.add_argument(
        "experiments",
        nargs="*",
        metavar="FILE",
        help="experiment files (all of this package but the bricks)",
    )
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="NAME",
        help="judge this joint; may be repeated (those that each experiment judges)",
    )
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="runs of each controller (20)"
    )
    engine_options(parser)
    jobs_options(parser)
    output_options(parser, "study")
    parser.add_argument(
        "--resume", action="store_true", help="carry on the study in the output folder"
    )
    parser.add_argument(
        "--format",
        choices=("table", "docs", "csv", "json"),
        default="table",
        help="of the output (table); docs is Markdown",
    )
    parser.add_argument(
        "--table",
        dest="format",
        choices=("text", "docs", "csv", "json"),
        metavar="FORMAT",
        help=argparse.SUPPRESS,
    )


def tune(parser: Parser) -> None:
    parser.describe(
        "[FILE] --law pid|hpid",
        "Search the free parameters of a controller for the least cost, without ROS, on every "
        "core. pid scales the baseline's gains, hpid chooses degree and norm with three numbers "
        "and leaves the gains alone. The cost is the geometric mean over IVC, IAVC, ITAE, ||u|| "
        "and ||e|| of the ratio to the experiment's first controller, or as --limit says.",
        {
            "hpid tune --law hpid": "the paper's robot",
            "hpid tune my.yaml --law pid --per-joint": "then each joint on its own",
            "hpid tune --law hpid --weight itae=1": "your own cost",
        },
        "Unstable gains and uncertified degrees are refused. The same options give the same "
        "result with any number of jobs. An interrupt leaves what was found.",
    )
    experiment_options(parser)
    engine_options(parser)
    parser.add_argument(
        "--law", choices=("pid", "hpid"), required=True, help="of the controller that is sought"
    )
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="NAME",
        help="judge this joint; may be repeated (those that the experiment judges)",
    )
    parser.add_argument(
        "--evaluations", type=int, default=150, metavar="N", help="points of the search (150)"
    )
    parser.add_argument(
        "--per-joint",
        action="store_true",
        help="then refine each judged joint on its own, with as many points again",
    )
    parser.add_argument(
        "--weight",
        action="append",
        default=[],
        metavar="INDEX=WEIGHT",
        help="of ivc, iavc, itae, effort_l2 or error_l2 in the cost (1 each); once one is given, "
        "the others are 0",
    )
    parser.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="INDEX=RATIO",
        help="wanted of the same indices; the cost is then the largest of ratio/limit, and at 1 "
        "all that are given are kept",
    )
    jobs_options(parser)
    output_options(parser, "NAME-tune-LAW")
    rare = parser.rare()
    rare.add_argument(
        "--bounds",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH",
        help="of a free parameter: bandwidth, damping, integral, distribution; mu, error_scale, "
        "rate_weight, effort_scale, floor",
    )
    rare.add_argument(
        "--settle",
        type=float,
        metavar="RAD",
        help="refuse larger errors in the last second, in rad; in m where a joint slides",
    )
    rare.add_argument(
        "--uncertified", action="store_true", help="accept degrees that are not certified"
    )
    rare.add_argument(
        "--seeds", type=int, default=3, metavar="K", help="training seeds of each point (3)"
    )
    rare.add_argument(
        "--search-seed", type=int, default=1, metavar="S", help="of the search itself (1)"
    )
    rare.add_argument("--label", help="name of what is found (best PID, best hPID)")


def gains(parser: Parser) -> None:
    parser.describe(
        "[FILE] --rule RULE --closed-loop-time T",
        "Compute every joint's gains by a published rule on its effective inertia, and print them "
        "as a part of an experiment file, with the margins of hpid margins and certified degrees. "
        "simc: S. Skogestad, J. Process Control 13 (2003), for a double integrating process. "
        "pole-placement: three poles in one place.",
        {
            "hpid gains my.yaml --rule simc --closed-loop-time 0.05": "a robot",
            "hpid gains --inertia 0.2 --rule simc --closed-loop-time 0.05": "a joint",
        },
        "Inertias are 1 / (M^-1)_jj in the experiment's initial pose; a wheel's is that of the "
        "robot that rolls on it, where the experiment says robot.base. Velocity filter, norm and "
        "degree are those of the experiment's first homogeneous controller. Exit code 0 only if "
        "every joint is certified.",
    )
    experiment_options(parser)
    parser.add_argument(
        "--inertia", type=float, metavar="M", help="of one joint without a robot [kg m^2]"
    )
    parser.add_argument("--period", type=float, metavar="S", help="its control period [s] (0.001)")
    parser.add_argument(
        "--rule", choices=("simc", "pole-placement"), required=True, help="by which"
    )
    parser.add_argument(
        "--closed-loop-time",
        type=float,
        required=True,
        metavar="T",
        help="tau_c, time constant of the closed loop [s]",
    )
    parser.add_argument(
        "--delay",
        type=float,
        default=0.0,
        metavar="D",
        help="of the loop [s] (0); in the margins an experiment's drives add theirs",
    )


def play(parser: Parser) -> None:
    parser.describe(
        "[FILE]",
        "Start the simulated robot of an experiment in real time, its controllers and the live "
        "page, in the engine's window where there is a display. Its nodes can be retuned and "
        "watched from other terminals of this computer. Ctrl-C ends all.",
        {
            "hpid play": "the paper's robot",
            "hpid play config/experiments/panda.yaml --engine mujoco": "an arm",
        },
        "Nodes stay on this computer unless the environment chooses otherwise "
        "(ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS, ROS_DISCOVERY_SERVER).",
    )
    experiment_options(parser)
    engine_options(parser)
    parser.add_argument(
        "--controller", metavar="LABEL", help="which of its controllers (the last one)"
    )
    parser.add_argument("--no-window", action="store_true", help="without the engine's window")
    parser.add_argument("--no-page", action="store_true", help="without the live page")
    parser.add_argument("--no-browser", action="store_true", help="print the page's address alone")
    parser.add_argument(
        "--port",
        type=int,
        default=8080,
        metavar="N",
        help="of the page; 0 chooses a free one (8080)",
    )


def schema(parser: Parser) -> None:
    parser.describe(
        "",
        "Print the JSON Schema (draft 2020-12) with which editors complete and check experiment "
        "files. An editor with a YAML language server does so for a file whose first line is "
        "# yaml-language-server: $schema=experiment.schema.json",
        {"hpid schema > experiment.schema.json": ""},
    )


def doctor(parser: Parser) -> None:
    parser.describe(
        "",
        "Look whether this machine has what hpid needs, one line each, with what to do where it "
        "does not: Python, ROS, the middleware, two nodes that find each other, shared memory, "
        "real-time priority, engines, an OpenGL, the page.",
        {"hpid doctor": "", "hpid doctor --json": "for an issue"},
        "Exit code 0 if nothing is missing that controllers or the simulated robot need.",
    )
    parser.add_argument("--json", action="store_true", help="machine-readable")


def completion(parser: Parser) -> None:
    parser.describe(
        "SHELL",
        "Print what lets a shell complete subcommands, options and files.",
        {
            'eval "$(hpid completion bash)"': "in ~/.bashrc",
            'eval "$(hpid completion zsh)"': "in ~/.zshrc",
            "hpid completion fish | source": "in config.fish",
        },
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="of the user")

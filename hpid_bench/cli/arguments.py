"""What subcommands of ``hpid`` take: argparse alone, so that no help waits for a library.

Here are those that take an experiment or its result, in :mod:`robot_arguments` the others.
"""

from __future__ import annotations

import argparse
import inspect
import re
import shutil
import textwrap
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

GROUPS = {
    "compare controllers in simulation": {
        "compare": "all controllers of an experiment, once, one node per joint",
        "run": "one of them, and how its time was spent",
        "study": "all of them over many seeds: medians, and the paper's claims",
        "sweep": "one of them over a grid of its parameters",
    },
    "find gains": {
        "gains": "by a published rule from the inertia: where there are none yet",
        "upgrade": "keep those of a tuned PID, and add norm and degree",
        "tune": "by a search in simulation, for a cost that you choose",
        "autotune": "of a joint that runs, by relay feedback",
    },
    "prove what they do": {
        "check-gains": "for which degrees are they certified stable?",
        "margins": "how far from instability: gain, phase, delay, disk",
    },
    "look at recordings and results": {
        "metrics": "compute the indices of bags, and compare them",
        "replay": "compute every command again: equal to the last bit?",
        "repair": "save what can be read of a bag that was cut off",
        "figures": "draw the figures of a result for print",
        "render": "draw its robot as it moved, side by side, animated",
    },
    "know and drive a robot": {
        "play": "the simulated robot, its controllers and the page, to try",
        "robot": "joints, inertias, and what the URDF lacks",
        "excite": "move joints so that a recording tells what they are",
        "identify": "find inertia, friction, load and delay in a bag",
        "live": "a page to see, retune and stop controllers that run",
        "export": "joints' loops as C, or as a plugin for ros2_control",
    },
    "tools": {
        "doctor": "does everything work on this machine? if not, what to do",
        "schema": "the JSON Schema of experiment files, for editors",
        "completion": "let the shell complete commands and options",
    },
}
"""The subcommands by task, each with what it is for."""
COMMANDS = {name: text for group in GROUPS.values() for name, text in group.items()}

_NAMES = max(map(len, COMMANDS))
_FIRST = {
    "hpid doctor": "does everything work on this machine?",
    "hpid play": "a simulated robot to play with",
    "hpid compare": "PID against homogeneous PID, simulated",
    "hpid metrics my_bag": "how well were its joints controlled?",
    "hpid upgrade my_bag --urdf arm.urdf": "from its PID to a homogeneous one",
}


def overview() -> str:
    """Return what ``hpid`` can do, by task, and what to do first."""
    lines = ["usage: hpid COMMAND [options]", ""]
    lines += ["Linear and homogeneous PID, joint by joint, on ROS 2.", "", "first:"]
    lines += _listed(_FIRST, "  # ")
    for title, commands in GROUPS.items():
        lines += ["", f"{title}:", *_listed(commands, "  ")]
    lines += ["", "hpid COMMAND --help says what it takes; hpid --version which version this is."]
    return "\n".join(lines) + "\n"


def _listed(texts: Mapping[str, str], between: str) -> list[str]:
    width = max(_NAMES, *map(len, texts))
    return [
        f"  {name:{width}}{between}{text}" if text else f"  {name}" for name, text in texts.items()
    ]


class Parser(argparse.ArgumentParser):
    """A subcommand, whose help is one screen: what is rarely needed is shown by ``--help-all``."""

    shows_all = True

    def __init__(self, **how: Any) -> None:
        how["formatter_class"] = partial(
            argparse.RawDescriptionHelpFormatter, max_help_position=23, width=_columns()
        )
        super().__init__(**how)

    def describe(self, usage: str, what: str, examples: Mapping[str, str], note: str = "") -> None:
        """Say what follows the command's name, what it does, and examples with what they do."""
        self.usage = f"{self.prog} {usage} [options]".replace("  ", " ")
        shown = "\n".join(_listed(examples, "  # "))
        self.description = f"{_filled(what)}\n\nexamples:\n{shown}"
        self.epilog = _filled(note) if note else None
        self._all = self.add_argument("--help-all", action="help", help=argparse.SUPPRESS)

    def rare(self) -> Any:
        """Return the group of options that are rarely needed."""
        self._all.help = "show also what is rarely needed"
        if self.shows_all:
            return self.add_argument_group("rarely needed")
        group = self.add_argument_group()
        vars(group)["is_hidden"] = True
        return group


def _columns() -> int:
    return min(shutil.get_terminal_size().columns, 100) - 2


def _filled(text: str) -> str:
    return textwrap.fill(text, _columns())


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


def options(place: Any, text: str, **how: Any) -> None:
    """Add options, and positional arguments, as help lists them: ``-o --output FILE  what for``.

    Further lines of one are indented; without a placeholder it is a flag, with dots after that it
    may be repeated, without a purpose it is an earlier name, which help leaves out. Keywords say
    by its name what else there is of one: its type, a default of that type, the choices (the first
    is the default), or arguments of ``add_argument``.
    """
    for entry in re.split(r"\n(?=\S)", inspect.cleandoc(text)):
        usage, _, purpose = entry.partition("  ")
        names = [word for word in usage.split() if word.startswith("-")] or usage.split()[:1]
        values = usage.split()[len(names) :]
        name = names[-1].strip("-").replace("-", "_")
        extra = how.get(name, {} if values or name in how else {"action": "store_true"})
        if isinstance(extra, type):
            extra = {"type": extra}
        elif isinstance(extra, tuple) and isinstance(extra[0], str):
            extra = {"choices": extra, "default": extra[0]}
        elif not isinstance(extra, dict):
            kind = type(extra[0] if isinstance(extra, tuple) else extra)
            extra = {"type": kind, "default": extra}
        if values[-1:] == ["..."]:
            extra = {"action": "append", "default": [], **extra}
            del values[-1]
        if len(values) > 1:
            extra = {"nargs": len(values), **extra}
        if values:
            extra["metavar"] = tuple(values) if len(values) > 1 else values[0]
        is_hidden = not purpose or "is_hidden" in vars(place)
        shown = argparse.SUPPRESS if is_hidden else " ".join(purpose.split())
        place.add_argument(*names, help=shown, **extra)


def comma_separated(text: str) -> tuple[str, ...]:
    return tuple(each.strip().lower() for each in text.split(",") if each.strip())


def experiment_options(parser: Parser) -> None:
    text = """
        experiment FILE  experiment file (the paper's comparison)
    """
    options(parser, text, experiment={"nargs": "?"})


def jobs_options(parser: Parser) -> None:
    text = """
        -j --jobs N  processes (one for each processor)
        --scheduler ADDRESS  of a Dask scheduler whose workers run everything, tcp://HOST:PORT
    """
    options(parser.add_mutually_exclusive_group(), text, jobs=int)


def topics_options(group: Any) -> None:
    text = """
        --namespace NAME  which of several robots
        --states TOPIC ...  of the joint states; once for each topic of one robot
        --commands TOPIC  of the efforts. effort: take *_controller/commands as efforts; the topic
            of the states: use the measured ones; none: read no efforts (found by name and type,
            else the measured ones)
        --command-topic JOINT=TOPIC[INDEX] ...  of one joint's efforts; may be repeated
        --sender NUMBER  which sender of the states where several send the same joints: its number
            in the warning, its rate (50Hz) or its layout (names in their order) (the one that goes
            on)
    """
    options(group, text)


def times_options(group: Any) -> None:
    text = """
        --clock CLOCK  header or receive (header)
        --start S  seconds after the first state
        --end S  seconds after the first state
    """
    options(group, text, clock="header", start=float, end=float)


def robot_options(parser: Parser, rare: Any) -> None:
    text = """
        --inertia M ...  of every joint: M, or LOW HIGH; of one: JOINT=M or JOINT=LOW:HIGH, also
            with --urdf; or a file of hpid identify (.yaml)
        --urdf FILE  inertias over the ranges of this robot: a URDF, or an experiment file (.yaml)
    """
    options(parser, text, inertia={"nargs": "+"})
    text = """
        --payload KG  largest payload, with --urdf
        --poses N  sampled over the joints' ranges, with --urdf (200)
    """
    options(rare, text, payload=0.0, poses=int)


def graph_options(place: Any) -> None:
    text = """
        --namespace NS  only controllers below this namespace
        --states TOPIC  of the states (joint_states)
    """
    options(place, text, states="joint_states")


def engine_options(parser: Parser) -> None:
    options(parser, "--engine ENGINE  of the physics: pybullet or mujoco (as the file says)")


def output_options(parser: Parser, name: str) -> None:
    options(parser, f"-o --output FOLDER  folder (results/{name}-TIME)", output=Path)
    options(parser, "--force  replace an existing result")


def process_options(parser: Parser) -> Any:
    """Add over how many processes a run on the graph is spread; return their exclusive group."""
    text = """
        --separate  each controller in a process of its own: the default with a core for each
        --composed  all controllers in one process: the default with fewer cores
        --single-process  controllers and robot in one process
    """
    kinds = {"separate": "each", "composed": "composed", "single_process": "single"}
    either = parser.add_mutually_exclusive_group()
    settings = {
        option: {"dest": "processes", "action": "store_const", "const": kind}
        for option, kind in kinds.items()
    }
    options(either, text, **settings)
    return either


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
    options(process_options(parser), "--in-process  without ROS; the numbers are the same")
    text = """
        --figures FORMAT,...  also draw figures for print: png, pdf, svg or none; hpid figures does
            so later (none)
        --no-figures
        --animation  animate the robot, in animation.webp and in the report (hpid render has more)
    """
    options(
        parser,
        text,
        figures={"type": comma_separated, "default": ()},
        no_figures={"dest": "figures", "action": "store_const", "const": ()},
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
    text = """
        result RESULT  folder of hpid compare or run
        --formats FORMAT,...  png, pdf, svg (png)
        --force  replace figures that exist
    """
    options(parser, text, result=Path, formats={"type": comma_separated, "default": ("png",)})


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
    options(parser, "--controller LABEL  which of its controllers (the last one)")
    process_options(parser)
    text = """
        --realtime  paced by the wall clock, not in lock-step
        --no-trial  with --realtime: begin at once, without a second in lock-step that tells what
            rate the machine holds
        --realtime-priority N  SCHED_FIFO priority of the control loop, 1 to 99
        --no-record  leave no bag and no indices
    """
    options(parser, text, realtime_priority=0)
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
    text = """
        --vary NAME=VALUES ...  START:STOP:COUNT or VALUE,VALUE,... of a controller parameter, or
            of payload, physics_steps or encoder_counts; several make a grid
        --controller LABEL  which (the first after the baseline)
        --joint NAME ...  vary and judge this joint only; may be repeated
        --seeds N  runs of each point (20)
    """
    options(parser, text, vary={"required": True}, seeds=20)
    jobs_options(parser)
    output_options(parser, "NAME-sweep")
    options(parser, "--format  of the output (table)", format=("table", "csv", "json"))


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
    text = """
        experiments FILE  experiment files (all of this package but the bricks)
        --joint NAME ...  judge this joint; may be repeated (those that each experiment judges)
        --seeds N  runs of each controller (20)
    """
    options(parser, text, experiments={"nargs": "*"}, seeds=20)
    engine_options(parser)
    jobs_options(parser)
    output_options(parser, "study")
    text = """
        --resume  carry on the study in the output folder
        --format  of the output (table); docs is Markdown
        --table FORMAT
    """
    options(
        parser,
        text,
        format=("table", "docs", "csv", "json"),
        table={"dest": "format", "choices": ("text", "docs", "csv", "json")},
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
    text = """
        --law  of the controller that is sought
        --joint NAME ...  judge this joint; may be repeated (those that the experiment judges)
        --evaluations N  points of the search (150)
        --per-joint  then refine each judged joint on its own, with as many points again
        --weight INDEX=WEIGHT ...  of ivc, iavc, itae, effort_l2 or error_l2 in the cost (1 each);
            once one is given, the others are 0
        --limit INDEX=RATIO ...  wanted of the same indices; the cost is then the largest of
            ratio/limit, and at 1 all that are given are kept
    """
    options(parser, text, law={"choices": ("pid", "hpid"), "required": True}, evaluations=150)
    jobs_options(parser)
    output_options(parser, "NAME-tune-LAW")
    rare = parser.rare()
    text = """
        --bounds NAME=LOW:HIGH ...  of a free parameter: bandwidth, damping, integral,
            distribution; mu, error_scale, rate_weight, effort_scale, floor
        --settle RAD  refuse larger errors in the last second, in rad; in m where a joint slides
        --uncertified  accept degrees that are not certified
        --seeds K  training seeds of each point (3)
        --search-seed S  of the search itself (1)
        --label LABEL  name of what is found (best PID, best hPID)
    """
    options(rare, text, seeds=3, settle=float, search_seed=1)


def gains(parser: Parser) -> None:
    parser.describe(
        "[FILE] --rule RULE --closed-loop-time T",
        "Compute every joint's gains by a published rule on its effective inertia, and print them "
        "as a part of an experiment file, with the margins of hpid margins and certified degrees. "
        "simc: S. Skogestad, "
        "J. Process Control 13 (2003), for a double integrating process. pole-placement: three "
        "poles in one place.",
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
    text = """
        --inertia M  of one joint without a robot [kg m^2]
        --period S  its control period [s] (0.001)
        --rule  by which
        --closed-loop-time T  tau_c, time constant of the closed loop [s]
        --delay D  of the loop [s] (0); in the margins an experiment's drives add theirs
    """
    options(
        parser,
        text,
        inertia=float,
        period=float,
        rule={"choices": ("simc", "pole-placement"), "required": True},
        closed_loop_time={"required": True, "type": float},
        delay=0.0,
    )


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
    text = """
        result RESULT  folder of hpid compare or run
        -o --output FILE  (animation.webp in RESULT)
        --report  put the animation into RESULT's report.html, too
        --from S  first instant, in s (0)
        --to S  last instant, in s (the end)
        --at S  one picture, of this instant in s
        --speed X  seconds shown in one (1, or more for runs of more than 10 s)
        --joint NAME  draw its position, not the error's norm over all joints
        --controller LABEL ...  show this run; may be repeated (all, at most 4)
        --force  replace an existing file
    """
    options(
        parser,
        text,
        result=Path,
        output=Path,
        **{"from": {"dest": "start", "type": float, "default": 0.0}},
        to=float,
        at=float,
        speed=float,
    )
    text = """
        --size WxH  in pixels (720x450)
        --fps N  pictures in a second (12.5)
        --view AZIMUTH ELEVATION  where the camera stands, in degrees (-50 16)
        --engine ENGINE  kept from earlier versions, pybullet or mujoco: MuJoCo draws, which needs
            OpenGL but no screen
    """
    options(parser.rare(), text, size="720x450", fps=12.5, view=(-50.0, 16.0))


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
    text = """
        --controller LABEL  which of its controllers (the last one)
        --no-window  without the engine's window
        --no-page  without the live page
        --no-browser  print the page's address alone
        --port N  of the page; 0 chooses a free one (8080)
    """
    options(parser, text, port=8080)


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
    options(parser, "--json  machine-readable")


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
    options(parser, "shell  of the user", shell={"choices": ("bash", "zsh", "fish")})

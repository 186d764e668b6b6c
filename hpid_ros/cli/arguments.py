"""What subcommands of ``hpid`` take: argparse alone, so that no help waits for a library.

Here are those that take an experiment or its result, in :mod:`robot_arguments` the others.
"""

from __future__ import annotations

import inspect
import re
from argparse import ArgumentParser as Parser
from argparse import RawDescriptionHelpFormatter
from pathlib import Path
from typing import Any

COMMANDS = {
    "compare": "run the controllers of an experiment, one process per joint, and compare them",
    "run": "run one controller of an experiment and show how its time was spent",
    "sweep": "run a controller over a grid of its parameters, without ROS, on every core",
    "study": "run experiments over many seeds and hold the paper's claims to them",
    "metrics": "compute the indices of recorded bags and compare them",
    "excite": "move joints of a running robot so that a recording tells what they are",
    "identify": "find inertia, friction, load and delay of joints in a bag",
    "replay": "compute every command of a recording again, and compare to the last bit",
    "repair": "save what can be read of a bag that was cut off or damaged",
    "figures": "draw the figures of a result for print",
    "render": "draw the robot of a result as it moved, side by side, animated",
    "gains": "compute gains by a published tuning rule",
    "check-gains": "say for which degrees gains are certified stable",
    "margins": "say how far loops are from instability: gain, phase, delay, disk",
    "tune": "search the best gains of a PID, or the best degree and norm, for one cost",
    "autotune": "find a running joint's gains by relay feedback, and its homogeneous PID",
    "live": "open a page on which running controllers are seen, retuned and stopped",
    "upgrade": "turn a PID into a homogeneous PID: from its parameter file, or from a bag of it",
    "export": "write joints' loops as C for a microcontroller",
    "robot": "show a robot: its joints, their inertias, and what its URDF lacks",
    "schema": "print the JSON Schema of experiment files, for editors",
}
"""The subcommands in the order of the help, each with what it is for."""

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
    may be repeated. Keywords say by its name what else there is of one: its type, a default of
    that type, the choices (the first is the default), or arguments of ``add_argument``.
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
        place.add_argument(*names, help=" ".join(purpose.split()) or None, **extra)


def comma_separated(text: str) -> tuple[str, ...]:
    return tuple(each.strip().lower() for each in text.split(",") if each.strip())


def experiment_options(parser: Parser) -> None:
    text = """
        experiment FILE  experiment file (the paper's comparison)
    """
    options(parser, text, experiment={"nargs": "?"})


def jobs_options(parser: Parser) -> None:
    either = parser.add_mutually_exclusive_group()
    text = """
        -j --jobs N  processes (one for each processor)
        --scheduler ADDRESS  of a Dask scheduler whose workers run everything, tcp://HOST:PORT
    """
    options(either, text, jobs=int)


def topics_options(group: Any) -> None:
    text = """
        --namespace NAME  which of several robots
        --states TOPIC ...  of the joint states; once for each topic of one robot
        --commands TOPIC  of the efforts; effort: *_controller/commands are efforts, the topic of
            the states: measured ones, none: none (found by name and type, else the measured ones)
        --command-topic JOINT=TOPIC[INDEX] ...  of one joint's efforts; may be given several times
    """
    options(group, text)


def times_options(group: Any) -> None:
    text = """
        --clock CLOCK  header or receive (header)
        --start S  seconds after the first state
        --end S  seconds after the first state
    """
    options(group, text, clock="header", start=float, end=float)


def robot_options(parser: Parser) -> None:
    text = """
        --inertia M ...  of every joint: M, or LOW HIGH; of one: JOINT=M or JOINT=LOW:HIGH, also
            where --urdf says that of the others; or a file that hpid identify wrote (.yaml)
        --urdf FILE  compute inertias over the joints' ranges from this robot: a URDF, or an
            experiment file (.yaml) with what it knows better
        --payload KG  largest payload, with --urdf
        --poses N  sampled over the joints' ranges, with --urdf (200)
    """
    options(parser, text, inertia={"nargs": "+"}, payload=0.0, poses=int)


def graph_options(parser: Parser) -> None:
    text = """
        --namespace NS  only controllers below this namespace
        --states TOPIC  of the states (joint_states)
    """
    options(parser, text, states="joint_states")


def engine_options(parser: Parser, names: str = "pybullet or mujoco") -> None:
    options(parser, f"--engine ENGINE  who computes the physics, {names} (as the file says)")


def output_options(parser: Parser, name: str) -> None:
    options(parser, f"-o --output FOLDER  folder (results/{name}-TIME)", output=Path)
    options(parser, "--force  replace an existing result")


def compare(parser: Parser) -> None:
    parser.description = (
        "Run the controllers of an experiment on the real ROS 2 graph, one process per joint, "
        "record everything, and leave tables, figures and a report."
    )
    experiment_options(parser)
    engine_options(parser, "pybullet, mujoco, or both to compare them")
    output_options(parser, "NAME")
    text = """
        --in-process  run without ROS; the numbers are the same
        --figures FORMAT,...  also draw figures for print, png, pdf, svg or none; hpid figures does
            so later (none)
        --no-figures  the same as --figures none
        --animation  animate the robot, in animation.webp and in the report (hpid render has more)
    """
    options(
        parser,
        text,
        figures={"type": comma_separated, "default": ()},
        no_figures={"dest": "figures", "action": "store_const", "const": ()},
    )


def figures(parser: Parser) -> None:
    parser.description = (
        "Draw the figures of a result for print: positions, errors, efforts, norms, spectra, "
        "phase portraits, gain multipliers, error against effort, the end effector's path."
    )
    text = """
        result RESULT  folder of hpid compare or run
        --formats NAME,...  png, pdf, svg (png)
        --force  replace figures that exist
    """
    options(parser, text, result=Path, formats={"type": comma_separated, "default": ("png",)})


def run(parser: Parser) -> None:
    parser.description = (
        "Run one controller of an experiment on the real ROS 2 graph, record it, and end with its "
        "indices and with a table of periods, compute times, latencies and losses."
    )
    experiment_options(parser)
    engine_options(parser)
    options(parser, "--controller LABEL  which of its controllers (the last one)")
    parser.set_defaults(processes="each")
    either = parser.add_mutually_exclusive_group()
    text = """
        --composed  all controllers in one process, not one each
        --single-process  controllers and robot in one process
    """
    options(
        either,
        text,
        composed={"dest": "processes", "action": "store_const", "const": "composed"},
        single_process={"dest": "processes", "action": "store_const", "const": "single"},
    )
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
    parser.description = (
        "Run one controller of an experiment over a grid of parameters and seeds, without ROS, "
        "and compare every point with the experiment's first controller as it stands. The numbers "
        "are those of hpid compare, to the last bit."
    )
    parser.epilog = (
        "A point that a loop refuses stays in the table with the reason; a run that fails is "
        "named there, the others go on, and the exit code is 1. An interrupt ends at once and "
        "leaves what was run."
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
    options(parser, "--format  of the output", format=("table", "csv", "json"))


def study(parser: Parser) -> None:
    parser.description = (
        "Run every controller of every experiment with many seeds, without ROS, on every core. "
        "Prints medians with quartiles, ratios to each experiment's first controller, and for "
        "every claim of the paper whether it holds."
    )
    parser.epilog = (
        "A run that fails is named, the others go on, and the exit code is 1. An interrupt leaves "
        "what was run; --resume carries on. The numbers are those of hpid compare, to the last "
        "bit, with any number of jobs."
    )
    text = """
        experiments FILE  experiment files (all of this package but the bricks)
        --joint NAME ...  judge this joint; may be repeated (those that each experiment judges)
        --seeds N  runs of each controller (20)
    """
    options(parser, text, experiments={"nargs": "*"}, seeds=20)
    engine_options(parser, "pybullet, mujoco, or both to compare them")
    jobs_options(parser)
    output_options(parser, "study")
    text = """
        --resume  carry on the study in the output folder
        --shard K/N  make only the K-th of N parts of the runs (all)
        --merge FOLDER ...  run nothing: put the shards of the same study together; once for each
        --table  of the output; docs is Markdown
    """
    options(parser, text, merge=Path, table=("text", "docs", "csv", "json"))


def tune(parser: Parser) -> None:
    parser.description = (
        "Search the free parameters of a controller for the least cost, without ROS, on every "
        "core. pid scales the baseline's gains (bandwidth, damping, integral, and how the "
        "bandwidth is distributed over the joints), hpid chooses degree and norm with three "
        "numbers and leaves the gains alone. The cost is the geometric mean over IVC, IAVC, ITAE, "
        "||u|| and ||e|| of the ratio to the experiment's first controller, or what --limit makes "
        "of it."
    )
    parser.epilog = (
        "Unstable gains and uncertified degrees are refused. The same options give the same "
        "result with any number of jobs. An interrupt leaves what was found."
    )
    experiment_options(parser)
    engine_options(parser)
    text = """
        --law
        --joint NAME ...  judge this joint; may be repeated (those that the experiment judges)
        --evaluations N  points of the search (150)
        --per-joint  then refine each judged joint on its own, with as many points again
        --seeds K  training seeds of each point (3)
        --weight INDEX=WEIGHT ...  of ivc, iavc, itae, effort_l2 or error_l2 in the cost (1 each);
            once one is given, the others are 0
        --limit INDEX=RATIO ...  wanted of the same indices; the cost is then the largest of
            ratio/limit, and at 1 all that are given are kept
        --bounds NAME=LOW:HIGH ...  of a free parameter: bandwidth, damping, integral,
            distribution; mu, error_scale, rate_weight, effort_scale, floor
        --settle RAD  refuse larger errors in the last second, in rad; in m where a joint slides
        --uncertified  accept degrees that are not certified
        --search-seed S  of the search itself (1)
        --label LABEL  name of what is found (best PID, best hPID)
    """
    options(
        parser,
        text,
        law={"choices": ("pid", "hpid"), "required": True},
        evaluations=150,
        seeds=3,
        settle=float,
        search_seed=1,
    )
    jobs_options(parser)
    output_options(parser, "NAME-tune-LAW")


def gains(parser: Parser) -> None:
    parser.description = (
        "Compute every joint's gains by a published rule on its effective inertia, and print them "
        "as a part of an experiment file, with robustness margins and certified degrees beside "
        "them. simc: S. Skogestad, J. Process Control 13 (2003), for a double integrating "
        "process. pole-placement: three poles in one place."
    )
    parser.epilog = (
        "Inertias are 1 / (M^-1)_jj in the experiment's initial pose; a wheel's is that of the "
        "robot that rolls on it, where the experiment says robot.base. Velocity filter, norm and "
        "degree are those of the experiment's first homogeneous controller. Exit code 0 only if "
        "every joint is certified."
    )
    experiment_options(parser)
    text = """
        --inertia M  of one joint without a robot [kg m^2]
        --rule
        --closed-loop-time T  tau_c, time constant of the closed loop [s]
        --delay D  of the loop [s] (0)
    """
    options(
        parser,
        text,
        inertia=float,
        rule={"choices": ("simc", "pole-placement"), "required": True},
        closed_loop_time={"required": True, "type": float},
        delay=0.0,
    )


def render(parser: Parser) -> None:
    parser.description = (
        "Draw the robot of a result as it was recorded, under each controller side\n"
        "by side, above the error over time; green is where the references are."
    )
    parser.epilog = """\
examples:
  hpid render results/mine                      animation.webp in that folder
  hpid render results/mine --report             and in its report.html
  hpid render results/mine -o arm.gif --size 480x300 --fps 10
  hpid render results/mine --from 3 --to 4 --speed 0.2 --joint arm_joint_4
  hpid render results/mine --at 3.3 -o arm.png  one picture

The suffix of FILE is the format: .webp (small), .gif, .png (lossless, moving
with several pictures); of one picture also .jpg.
"""
    parser.formatter_class = RawDescriptionHelpFormatter
    text = """
        result RESULT  folder of hpid compare or run
        -o --output FILE  (animation.webp in RESULT)
        --size WxH  in pixels (720x450)
        --fps N  pictures in a second (12.5)
        --from S  first instant, in s (0)
        --to S  last instant, in s (the end)
        --at S  one picture, of this instant in s
        --speed X  seconds shown in one (1, or more for runs of more than 10 s)
        --joint NAME  draw its position, not the error's norm over all joints
        --controller LABEL ...  show this run; may be repeated (all, at most 4)
        --view AZIMUTH ELEVATION  where the camera stands, in degrees (-50 16)
        --engine ENGINE  kept from earlier versions, pybullet or mujoco: MuJoCo draws, which needs
            OpenGL but no screen
        --report  put the animation into RESULT's report.html, too
        --force  replace an existing file
    """
    options(
        parser,
        text,
        result=Path,
        output=Path,
        size="720x450",
        fps=12.5,
        **{"from": {"dest": "start", "type": float, "default": 0.0}},
        to=float,
        at=float,
        speed=float,
        view=(-50.0, 16.0),
    )


def schema(parser: Parser) -> None:
    parser.description = (
        "Print the JSON Schema (draft 2020-12) with which editors complete and\n"
        "check experiment files."
    )
    parser.epilog = """\
examples:
  hpid schema > experiment.schema.json

An editor with a YAML language server completes and checks a file whose first
line is
  # yaml-language-server: $schema=experiment.schema.json
"""
    parser.formatter_class = RawDescriptionHelpFormatter

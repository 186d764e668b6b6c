"""``hpid``: the umbrella command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from hpid_ros import __version__
from hpid_ros.base.errors import HpidError, RunError
from hpid_ros.base.processes import heed_interrupts, optional_libraries
from hpid_ros.cli.commands import BAD_INPUT, FAILED, INTERRUPTED, UNREAD

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


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    args = sys.argv[1:] if args is None else list(args)
    options = _parser(args).parse_args(args)
    from hpid_ros.base.console import guarded_output

    heed_interrupts()
    # What renders asks for OpenGL itself. MuJoCo would ask another process for the version of a
    # library that does, in each worker; interrupted then, that process writes a traceback.
    os.environ.setdefault("MUJOCO_GL", "disable")
    with guarded_output():
        return _run(options)


def _run(options: argparse.Namespace) -> int:
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        with optional_libraries():
            code = command(options)
        sys.stdout.flush()
        return code
    except RunError as error:
        print(f"hpid: {error}", file=sys.stderr)
        return FAILED
    except HpidError as error:
        print(f"hpid: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("hpid: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of the output has read enough, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return UNREAD


def _parser(args: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser for a command line, with the options of its subcommand alone."""
    parser = argparse.ArgumentParser(
        prog="hpid", description="Linear and homogeneous PID, joint by joint, on ROS 2."
    )
    parser.add_argument("--version", action="version", version=f"hpid_ros {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        if name in args[:1]:  # its module alone is imported
            import_module(f"hpid_ros.cli.commands.{name.replace('-', '_')}").add(commands)
        else:
            commands.add_parser(name, help=text)
    return parser


if __name__ == "__main__":
    sys.exit(main())

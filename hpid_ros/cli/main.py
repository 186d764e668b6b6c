"""``hpid``: the umbrella command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence

from hpid_ros import __version__
from hpid_ros.base.console import guarded_output
from hpid_ros.base.errors import HpidError, RunError
from hpid_ros.base.interrupts import heed_interrupts
from hpid_ros.base.libraries import optional_libraries
from hpid_ros.cli.commands import (
    BAD_INPUT,
    FAILED,
    INTERRUPTED,
    UNREAD,
    compare,
    export,
    robot,
    run,
    schema,
    study,
    sweep,
)
from hpid_ros.cli.commands.live import autotune, excite
from hpid_ros.cli.commands.metrics import command as metrics
from hpid_ros.cli.commands.recordings import identify, repair, replay
from hpid_ros.cli.commands.tuning import check_gains, gains, margins, tune, upgrade


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        args: Arguments after the program's name; None for those of the process.
    """
    options = _parser().parse_args(args)
    heed_interrupts()
    # No command renders; MuJoCo would ask another process for the version of a library that does,
    # in each worker, and an interrupt at that time has that process write a traceback.
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
    except BrokenPipeError:  # whoever read the output has read enough, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return UNREAD


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hpid", description="Linear and homogeneous PID, joint by joint, on ROS 2."
    )
    parser.add_argument("--version", action="version", version=f"hpid_ros {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for each in (
        *(compare, run, sweep, study, metrics, excite, identify, replay, repair),
        *(gains, check_gains, margins, tune, autotune, upgrade, export, robot, schema),
    ):
        each.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())

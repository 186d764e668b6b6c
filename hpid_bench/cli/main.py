"""``hpid``: the umbrella command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module

from hpid_bench.cli import experiment_arguments, recording_arguments, robot_arguments
from hpid_bench.cli.commands import BAD_INPUT, DONE, FAILED, INTERRUPTED, UNREAD
from hpid_bench.cli.parser import SUBCOMMANDS, Parser, overview
from hpid_ros import __version__
from hpid_ros.base.errors import HpidError, RunError
from hpid_ros.base.libraries import optional_libraries, require_ros
from hpid_ros.base.processes import heed_interrupts
from hpid_ros.base.text import shown

# Which function declares what a subcommand takes.
_DECLARATIONS: Mapping[str, Callable[[Parser], None]] = {
    "compare": experiment_arguments.compare,
    "run": experiment_arguments.run,
    "sweep": experiment_arguments.sweep,
    "study": experiment_arguments.study,
    "tune": experiment_arguments.tune,
    "gains": experiment_arguments.gains,
    "play": experiment_arguments.play,
    "schema": experiment_arguments.schema,
    "doctor": experiment_arguments.doctor,
    "completion": experiment_arguments.completion,
    "metrics": recording_arguments.metrics,
    "replay": recording_arguments.replay,
    "repair": recording_arguments.repair,
    "figures": recording_arguments.figures,
    "render": recording_arguments.render,
    "robot": robot_arguments.robot,
    "excite": robot_arguments.excite,
    "identify": robot_arguments.identify,
    "check-gains": robot_arguments.check_gains,
    "margins": robot_arguments.margins,
    "upgrade": robot_arguments.upgrade,
    "autotune": robot_arguments.autotune,
    "live": robot_arguments.live,
    "export": robot_arguments.export,
}

# Subcommands that share a module, with their functions; every other one is ``run`` of its own.
_TOGETHER = {
    "run": ("compare", "run_one"),
    "repair": ("replay", "repair"),
    "gains": ("check_gains", "gains"),
    **{name: ("batches", name) for name in ("sweep", "study", "tune")},
    **{name: ("motions", name) for name in ("excite", "autotune")},
}


def main(args: Sequence[str] | None = None) -> int:
    args = sys.argv[1:] if args is None else list(args)
    if "_ARGCOMPLETE" in os.environ:  # the shell asks what could come next
        import argcomplete

        argcomplete.autocomplete(_parser(list(SUBCOMMANDS)))
    if not args:
        print(overview(), end="")
        return DONE
    options = _parser(args).parse_args(args)
    if options.command == "completion":
        from argcomplete.shell_integration import shellcode

        print(shellcode(["hpid"], shell=options.shell))
        return DONE
    from hpid_ros.base.console import guarded_output

    heed_interrupts()
    # What renders asks for OpenGL itself. MuJoCo would ask another process for the version of a
    # library that does, in each worker; interrupted then, that process writes a traceback.
    os.environ.setdefault("MUJOCO_GL", "disable")
    with guarded_output():
        return _run(options)


def _run(options: argparse.Namespace) -> int:
    try:
        with optional_libraries():
            if options.command in ("compare", "run") and not vars(options).get("in_process"):
                how = " without --in-process" if options.command == "compare" else ""
                require_ros(f"hpid {options.command}{how}")
                from hpid_bench.experiment.processes import require_shared_memory, warm_up

                require_shared_memory()  # before a folder is made
                warm_up()
            own = (options.command.replace("-", "_"), "run")
            name, function = _TOGETHER.get(options.command, own)
            module = import_module(f"hpid_bench.cli.commands.{name}")
            code: int = getattr(module, function)(options)
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
    except OSError as error:  # of a path or a disk, whoever looked at it
        where = f"{error.filename}: " if error.filename else ""
        print(shown(f"hpid: {where}{error.strerror or error}"), file=sys.stderr)
        try:
            sys.stdout.flush()
        except OSError:  # it was that of the output, which the interpreter would flush again
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return BAD_INPUT


class _Umbrella(argparse.ArgumentParser):
    def format_help(self) -> str:
        return overview()


def _parser(args: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser for a command line, with the options of the subcommands in it alone."""
    parser = _Umbrella(prog="hpid", usage="hpid COMMAND [options]")
    parser.add_argument("--version", action="version", version=f"hpid_ros {__version__}")
    commands = parser.add_subparsers(
        required=True, prog="hpid", metavar="COMMAND", dest="command", parser_class=Parser
    )
    for name in SUBCOMMANDS:
        command = commands.add_parser(name)
        if name in args:
            command.shows_all = "--help-all" in args
            _DECLARATIONS[name](command)
    return parser


if __name__ == "__main__":
    sys.exit(main())

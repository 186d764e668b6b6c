"""The parser of ``hpid``: its subcommands, the overview, and a help of one screen.

argparse alone, so that no help waits for a library.
"""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol

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
SUBCOMMANDS = {name: text for group in GROUPS.values() for name, text in group.items()}

_NAMES = max(map(len, SUBCOMMANDS))
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


class Arguments(Protocol):
    """Where arguments are declared: a parser, or a group of one."""

    def add_argument(self, *names: str, **settings: Any) -> Any: ...


class _WithoutHelp:
    """A group whose options are taken, but neither listed by ``--help`` nor completed."""

    def __init__(self, group: Arguments) -> None:
        self._group = group

    def add_argument(self, *names: str, **settings: Any) -> Any:
        return self._group.add_argument(*names, **{**settings, "help": argparse.SUPPRESS})


class Parser(argparse.ArgumentParser):
    """A subcommand, whose help is one screen: what is rarely needed is shown by ``--help-all``."""

    shows_all = True  # what is rarely needed, too

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

    def rare(self) -> Arguments:
        """Return the place for options that are rarely needed."""
        self._all.help = "show also what is rarely needed"
        if self.shows_all:
            return self.add_argument_group("rarely needed")
        return _WithoutHelp(self.add_argument_group())


def _columns() -> int:
    return min(shutil.get_terminal_size().columns, 100) - 2


def _filled(text: str) -> str:
    return textwrap.fill(text, _columns())

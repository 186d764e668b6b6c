"""The help of an executable."""

from __future__ import annotations

import os
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

_WIDTH = 96
_HELP = ("-h", "--help")


@dataclass(frozen=True)
class Usage:
    """An executable in a few lines."""

    name: str  # of the executable
    about: str  # what it does, in one sentence
    needs: str = ""  # parameters that must be given, as an example, for instance -p joint:=elbow
    parameters: Sequence[str] = ()  # names of all parameters; motor.* is a group of them
    listens: Sequence[str] = ()  # topics that it subscribes to
    tells: Sequence[str] = ()  # topics that it publishes
    serves: Sequence[str] = ()  # services beside those of every node

    def tell(self) -> None:
        """Print all of it; whoever reads it may have read enough after some lines, as head has."""
        try:
            print(self.text(), flush=True)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    def text(self) -> str:
        """Return all of it."""
        needs = f" {self.needs}" if self.needs else ""
        lists = {
            "parameters": self.parameters,
            "subscribes to": self.listens,
            "publishes": self.tells,
            "services": self.serves,
        }
        return "\n".join(
            [
                f"usage: {self.name} --ros-args{needs} [-p NAME:=VALUE]... "
                "[--params-file FILE]... [-r __ns:=/NAMESPACE]",
                "",
                self.about,
                "",
                *(_wrapped(what, names) for what, names in lists.items() if names),
                "",
                "ros2 param describe tells of a running node what each parameter is; "
                "docs/interfaces.md has all of them.",
            ]
        )


def is_asked_for(arguments: Sequence[str]) -> bool:
    """Tell whether arguments ask for help."""
    return any(argument in _HELP for argument in arguments)


def _wrapped(what: str, names: Sequence[str]) -> str:
    return textwrap.fill(
        f"{what}: {', '.join(names)}",
        _WIDTH,
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    )

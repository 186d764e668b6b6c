"""``hpid completion``: what lets a shell complete subcommands, options and files."""

from __future__ import annotations

import argparse

from hpid_ros.cli.commands import DONE


def run(options: argparse.Namespace) -> int:
    """Print what the shell is to execute."""
    from argcomplete.shell_integration import shellcode

    print(shellcode(["hpid"], shell=options.shell))
    return DONE

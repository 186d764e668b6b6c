"""Measures the package: ``python -m benchmarks [FIGURE ...] [--rounds N] [--quick]``.

Prints every figure beside its limit or peer and writes them to ``benchmarks/results/``. Exit
codes: 0 measured, 1 a figure could not be measured, 2 unusable arguments, 130 interrupted.
Targets that are missed are shown, and no failure: the figures are those of this machine.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks import results
from benchmarks.figures import Group, Outcome
from benchmarks.measuring import figures_of
from benchmarks.processes import ROOT
from benchmarks.table import print_table, wide_console
from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.processes import heed_interrupts

ROUNDS, ROUNDS_QUICK = 5, 2
RESULTS = ROOT / "benchmarks" / "results"

_FAILED, _BAD_INPUT, _INTERRUPTED = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the arguments name.

    Args:
        arguments: Those of the command line; None for the process's own.

    Returns:
        The exit code.
    """
    options = _parser().parse_args(arguments)
    console, errors = wide_console(), Console(stderr=True)
    heed_interrupts()
    outcomes: list[Outcome] = []
    try:
        groups = all_groups(options.quick)
        wanted = _wanted(options.figures, groups)
        rounds = _rounds(options.rounds, options.quick)
        is_complete = _measure(groups, wanted, rounds, outcomes, errors)
    except (ImportError, SettingError) as error:
        errors.print(str(error), highlight=False, soft_wrap=True)
        return _BAD_INPUT
    except KeyboardInterrupt:
        errors.print("interrupted; what was measured before is shown and not written")
        print_table(console, outcomes)
        return _INTERRUPTED
    print_table(console, outcomes)
    if outcomes:
        end = "_quick" if options.quick else ""
        file = options.output / f"{results.slug()}{end}.json"
        results.write(file, outcomes)
        console.print(f"\nwritten: {file}", highlight=False, soft_wrap=True)
    return 0 if is_complete else _FAILED


def _measure(
    groups: Sequence[Group],
    wanted: set[str],
    rounds: int,
    outcomes: list[Outcome],
    errors: Console,
) -> bool:
    """Measure the wanted figures into ``outcomes``, and tell whether none of them failed."""
    is_complete = True
    with errors.status("measuring") as status:
        tell = status.update if errors.is_terminal else errors.print
        for group in groups:
            for each in figures_of(group, wanted, rounds, tell):
                if isinstance(each, Outcome):
                    outcomes.append(each)
                else:
                    is_complete = False
                    errors.print(each, style="red", highlight=False, markup=False, soft_wrap=True)
    return is_complete


def all_groups(quick: bool) -> list[Group]:
    """Return every group of figures.

    Args:
        quick: Whether short measurements will do.

    Raises:
        ImportError: A library that the benchmarks need is not installed.
    """
    try:
        from benchmarks import (
            answers,
            compensation,
            engine,
            laws,
            loops,
            reading,
            recording,
            waiting,
        )
    except ImportError as error:
        raise ImportError(f"{error}; make bench installs what the benchmarks need") from error
    return [
        laws.group(quick),
        compensation.group(quick),
        engine.group(quick),
        recording.group(quick),
        reading.group(quick),
        *loops.groups(quick),
        waiting.group(quick),
        answers.group(quick),
    ]


def _wanted(names: Sequence[str], groups: Sequence[Group]) -> set[str]:
    """Return the figures that are named, in full or by their first part."""
    known = [figure.name for group in groups for figure in group.figures]
    wanted = set()
    for name in names:
        found = {each for each in known if each == name or each.startswith(f"{name}.")}
        if not found:
            raise SettingError(unknown_name("figure", name, known))
        wanted |= found
    return wanted or set(known)


def _rounds(given: int | None, quick: bool) -> int:
    if given is None:
        return ROUNDS_QUICK if quick else ROUNDS
    if given < 1:
        raise SettingError(f"--rounds must be a whole number >= 1, not {given}")
    return given


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "figures", nargs="*", metavar="FIGURE", help="for instance law or loop.processes; all"
    )
    parser.add_argument(
        "--rounds", type=int, help=f"measurements of each side, {ROUNDS} if not given"
    )
    parser.add_argument("--quick", action="store_true", help="short and few: does it run at all?")
    parser.add_argument(
        "--output", type=Path, default=RESULTS, metavar="FOLDER", help="where the file goes"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())

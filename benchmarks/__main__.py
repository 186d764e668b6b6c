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
from rich.table import Table

from benchmarks import results
from benchmarks.figures import Group, Middle, Outcome
from benchmarks.measuring import figures_of
from benchmarks.processes import ROOT
from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.processes import heed_interrupts

ROUNDS, ROUNDS_QUICK = 5, 2
RESULTS = ROOT / "benchmarks" / "results"

_FAILED, _BAD_INPUT, _INTERRUPTED = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the arguments name."""
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
    """Return every group of figures."""
    try:
        from benchmarks import (
            answers,
            compensation,
            engine,
            large_recordings,
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
        large_recordings.group(quick),
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


_VERDICTS = {True: "met", False: "MISSED", None: ""}
_STYLES = {True: "green", False: "bold red", None: ""}
_PERCENT = 100.0
_WIDTH = 120


def wide_console() -> Console:
    """Return a console that holds the table.

    A narrower terminal wraps its lines: a table whose numbers are cut off says nothing.
    """
    console = Console()
    return console if console.width >= _WIDTH else Console(width=_WIDTH)


def print_table(console: Console, outcomes: Sequence[Outcome]) -> None:
    """Print one row for each figure, and beneath them what was measured beside."""
    table = Table(box=None, header_style="dim", padding=(0, 2, 0, 0))
    for heading in ("figure", "ours", "±", "reference", "±", "unit", "ratio", "target", ""):
        is_text = heading in ("figure", "unit", "target", "")
        table.add_column(heading, justify="left" if is_text else "right", no_wrap=True)
    for outcome in outcomes:
        verdict = outcome.is_met
        table.add_row(
            outcome.figure.name,
            *_cells(outcome.ours),
            *_cells(outcome.reference),
            outcome.figure.unit,
            f"{outcome.ratio.median:.3g}",
            ", ".join(str(bound) for bound in outcome.figure.bounds),
            f"[{_STYLES[verdict]}]{_VERDICTS[verdict]}[/]" if verdict is not None else "",
        )
    console.print(table)
    console.print()
    for outcome in outcomes:
        console.print(
            _explained(outcome), style="dim", highlight=False, markup=False, soft_wrap=True
        )


def _cells(values: Middle) -> tuple[str, str]:
    return _number(values.median), f"{_PERCENT * values.spread:.0f} %"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _explained(outcome: Outcome) -> str:
    figure = outcome.figure
    line = f"{figure.name}: {figure.ours.contender} / {figure.reference.contender}"
    rounds = f"{outcome.rounds} round{'s' if outcome.rounds > 1 else ''}"
    line += f" ({figure.against}), {rounds}"
    beside = "; ".join(f"{name} {_number(value)}" for name, value in outcome.beside.items())
    return f"{line}; {beside}" if beside else line


if __name__ == "__main__":
    sys.exit(main())

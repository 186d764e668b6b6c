"""The figures as a person reads them."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from benchmarks.figures import Middle, Outcome

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
    """Print one row for each figure, and beneath them what was measured beside.

    Args:
        console: The terminal.
        outcomes: What was measured.
    """
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

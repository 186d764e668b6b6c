"""A table of texts: for a terminal, as plain text, and as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from rich.box import SIMPLE
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from hpid_ros.base.console import plain_console
from hpid_ros.report.tables.wide_table import UNLIMITED_WIDTH, TableColumn, WideTable

_TEXTS = ("joint", "controller", "verdict", "certified")  # columns that may fold


class Grid(NamedTuple):
    """One table."""

    key: str  # its name in files
    title: str  # what it shows
    headings: tuple[str, ...]  # of the columns; the first column is text
    rows: tuple[tuple[str, ...], ...]  # the cells
    note: str = ""  # what must be known to read it

    def markdown(self) -> str:
        """Return the table as Markdown, without its title."""
        lines = [_row(self.headings), _row(["---", *["---:"] * (len(self.headings) - 1)])]
        lines += [_row(cells) for cells in self.rows]
        return "\n".join(lines) + "\n" + (f"\n{self.note}\n" if self.note else "")

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        columns = [
            TableColumn(heading, cells, is_text=not place or heading in _TEXTS)
            for place, (heading, cells) in enumerate(
                zip(self.headings, zip(*self.rows, strict=True), strict=True)
            )
        ]
        names = 1 + (self.headings[1:2] in (("joint",), ("controller",)))
        yield WideTable(columns[:names], columns[names:], title=self.title, box=SIMPLE)
        if self.note:
            yield Text(self.note, style="dim")
        yield ""


def grids_text(grids: Iterable[Grid]) -> str:
    """Return tables as plain text, one line a row however long it is."""
    console = plain_console(UNLIMITED_WIDTH)
    with console.capture() as capture:
        for grid in grids:
            console.print(grid)
    lines = (line.rstrip() for line in capture.get().splitlines())
    return "\n".join(lines).strip("\n") + "\n"


def grids_markdown(grids: Iterable[Grid]) -> str:
    """Return tables as Markdown, each between comments that name it."""
    parts = []
    for grid in grids:
        body = f"### {grid.title}\n\n{grid.markdown()}"
        parts.append(f"<!-- begin {grid.key} -->\n{body}<!-- end {grid.key} -->\n")
    return "\n".join(parts)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

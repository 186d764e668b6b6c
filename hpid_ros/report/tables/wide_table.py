"""Tables whose numbers are whole at any width.

A column of numbers never shrinks, and a number is never broken over two lines. A table that is
wider than the terminal is broken into blocks below each other, each with the names of its rows, or
with their numbers where the names leave no room; texts fold. Where nothing limits the width, as in
a pipe, a table has one block.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rich.box import Box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

UNLIMITED_WIDTH = 10_000
_LEAST_NAME = 8  # columns that a name of a row keeps, where there are as many
_LEAST_TEXT = 20


class TableColumn(NamedTuple):
    """One column of a table."""

    heading: str
    cells: Sequence[str | Text]  # one for each row
    is_text: bool = False  # whether it is text, which may fold; else its cells are numbers

    @property
    def width(self) -> int:
        """How wide it is, unfolded."""
        return max(Text(self.heading).cell_len, *map(_width, self.cells), 1)

    @property
    def least_width(self) -> int:
        """How wide it is at least."""
        return min(self.width, _LEAST_TEXT) if self.is_text else self.width


class WideTable:
    """A table as a rich renderable that suits itself to the width it gets."""

    def __init__(
        self,
        names: Sequence[TableColumn],
        columns: Sequence[TableColumn],
        *,
        title: str = "",
        box: Box | None = None,
        header_style: str = "bold",
        padding: int = 1,
    ) -> None:
        self._names, self._columns = tuple(names), tuple(columns)
        self._title, self._box, self._header_style = title, box, header_style
        self._padding = padding

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if self._title:
            yield Text(self._title, style="bold")
        width, gap = options.max_width, self._padding + (self._box is not None)
        names, columns = self._names, self._columns
        least = sum(min(each.width, _LEAST_NAME) if each.is_text else each.width for each in names)
        widest = max((each.least_width for each in columns), default=0)
        if least + gap * len(names) + widest > width:  # the rows have numbers instead
            rows = len(names[0].cells)
            names = (TableColumn("#", [str(k + 1) for k in range(rows)]),)
            columns = (*self._names, *self._columns)
        for place, block in enumerate(pieces(names, columns, width, gap)):
            if place:
                yield ""
            yield self._block([*names, *block], _limits(names, block, width, gap))

    def _block(self, columns: Sequence[TableColumn], limits: Sequence[int]) -> Table:
        table = Table(
            box=self._box,
            show_edge=False,
            padding=(0, self._padding, 0, 0),
            pad_edge=False,
            header_style=self._header_style,
        )
        for column, limit in zip(columns, limits, strict=True):
            table.add_column(
                Text(column.heading),
                justify="left" if column.is_text else "right",
                width=limit,
                no_wrap=not column.is_text,
                overflow="fold",
            )
        for row in zip(*(column.cells for column in columns), strict=True):
            table.add_row(*(cell if isinstance(cell, Text) else Text(cell) for cell in row))
        return table


def pieces(
    names: Sequence[TableColumn], columns: Sequence[TableColumn], width: int, gap: int
) -> list[list[TableColumn]]:
    """Return the columns, broken where those of a block and the names fill the width."""
    taken = sum(each.width + gap for each in names)
    found: list[list[TableColumn]] = [[]]
    used = taken
    for column in columns:
        if found[-1] and used + column.least_width > width:
            found.append([])
            used = taken
        found[-1].append(column)
        used += column.least_width + gap
    return found


def _limits(
    names: Sequence[TableColumn], block: Sequence[TableColumn], width: int, gap: int
) -> list[int]:
    """Return the columns' widths: texts give way first, then the names that are texts."""
    columns = [*names, *block]
    widths = [each.width for each in columns]
    excess = sum(widths) + gap * (len(widths) - 1) - width
    order = [*range(len(names), len(columns)), *reversed(range(len(names)))]
    for k in (k for k in order if columns[k].is_text):
        least = _LEAST_NAME if k < len(names) else _LEAST_TEXT
        given = min(max(excess, 0), max(widths[k] - least, 0))
        widths[k] -= given
        excess -= given
    return widths


def _width(cell: str | Text) -> int:
    text = cell if isinstance(cell, Text) else Text(cell)
    return max((line.cell_len for line in text.split("\n")), default=0)

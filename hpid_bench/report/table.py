"""Tables for a terminal, text and Markdown: the paper's Table I for our runs, wide tables.

Blocks of one index each stand side by side as in the paper, as many as the width allows. A
ratio carries a mark besides its colour, so that better and worse read without it.

A column of numbers never shrinks, and a number is never broken over two lines. A table that is
wider than the terminal is broken into blocks below each other, each with the names of its rows, or
with their numbers where the names leave no room; texts fold. Where nothing limits the width, as in
a pipe, a table has one block.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from rich.box import SIMPLE, Box
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from hpid_bench.report.console import plain_console
from hpid_ros.base.text import shown
from hpid_ros.metrics.comparison import (
    Comparison,
    Verdict,
)
from hpid_ros.metrics.quantities import Quantity
from hpid_ros.metrics.texts import (
    MARKS,
    SIGNIFICANT_DIGITS,
    Cell,
    cells_of,
    footnotes,
    headings_of,
    legend_of,
    total_name,
    verdicts_of,
)

NO_NUMBER = "-"  # where a table of runs over seeds has no number


UNLIMITED_WIDTH = 10_000
_LEAST_NAME = 8  # columns that a name of a row keeps, where there are as many
_LEAST_TEXT = 20


class TableColumn(NamedTuple):
    heading: str
    cells: Sequence[str | Text]  # one for each row
    is_text: bool = False  # whether it is text, which may fold; else its cells are numbers

    @property
    def width(self) -> int:
        return max(Text(self.heading).cell_len, *map(_width, self.cells), 1)

    @property
    def least_width(self) -> int:
        return min(self.width, _LEAST_TEXT) if self.is_text else self.width


def columns_of(
    headings: Sequence[str], rows: Iterable[Iterable[str | Text]], texts: Collection[str] = ()
) -> list[TableColumn]:
    """Return the columns of a table that is given by its rows; texts are headings of such."""
    cells = list(zip(*rows, strict=True)) or [()] * len(headings)
    return [TableColumn(h, each, h in texts) for h, each in zip(headings, cells, strict=True)]


@dataclass(frozen=True)
class WideTable:
    """A table as a rich renderable that suits itself to the width it gets."""

    names: Sequence[TableColumn]  # of the rows
    columns: Sequence[TableColumn]
    title: str = ""  # what it shows
    note: str = ""  # what must be known to read it
    key: str = ""  # its name in files
    box: Box | None = None
    header_style: str = "bold"
    padding: int = 1

    @classmethod
    def of_rows(
        cls,
        headings: Sequence[str],
        rows: Iterable[Iterable[str | Text]],
        *,
        names: int = 1,
        texts: int = 1,
        **look: Any,
    ) -> WideTable:
        """Return the table of some rows, whose first cells are their names, and texts."""
        columns = columns_of(headings, rows, headings[:texts])
        return cls(columns[:names], columns[names:], **look)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if self.title:
            yield Text(self.title, style="bold")
        width, gap = options.max_width, self.padding + (self.box is not None)
        names, columns = self.names, self.columns
        least = sum(min(each.width, _LEAST_NAME) if each.is_text else each.width for each in names)
        widest = max((each.least_width for each in columns), default=0)
        if least + gap * len(names) + widest > width:  # the rows have numbers instead
            rows = len(names[0].cells)
            names = (TableColumn("#", [str(k + 1) for k in range(rows)]),)
            columns = (*self.names, *self.columns)
        for place, block in enumerate(pieces(names, columns, width, gap)):
            if place:
                yield ""
            yield self._block([*names, *block], _limits(names, block, width, gap))
        if self.note:
            yield Text(self.note, style="dim")

    def markdown(self) -> str:
        """Return the table as Markdown, without its title."""
        columns = [*self.names, *self.columns]
        lines = [
            _markdown_row([each.heading for each in columns]),
            _markdown_row(["---", *["---:"] * (len(columns) - 1)]),
            *map(_markdown_row, zip(*(each.cells for each in columns), strict=True)),
        ]
        return "\n".join(lines) + "\n" + (f"\n{self.note}\n" if self.note else "")

    def _block(self, columns: Sequence[TableColumn], limits: Sequence[int]) -> Table:
        table = Table(
            box=self.box,
            show_edge=False,
            padding=(0, self.padding, 0, 0),
            pad_edge=False,
            header_style=self.header_style,
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


def spaced(tables: Iterable[WideTable]) -> Iterator[RenderableType]:
    """Yield tables with an empty line below each."""
    for table in tables:
        yield table
        yield ""


def tables_text(tables: Iterable[RenderableType], width: int = UNLIMITED_WIDTH) -> str:
    """Return tables as plain text without colours; one line a row however long it is."""
    console = plain_console(width)
    with console.capture() as capture:
        for table in tables:
            console.print(table)
    lines = (line.rstrip() for line in capture.get().splitlines())
    return "\n".join(lines).strip("\n") + "\n"


def tables_markdown(tables: Iterable[WideTable]) -> str:
    """Return tables as Markdown, each between comments that name it."""
    parts = []
    for table in tables:
        body = f"### {table.title}\n\n{table.markdown()}"
        parts.append(f"<!-- begin {table.key} -->\n{body}<!-- end {table.key} -->\n")
    return "\n".join(parts)


def _markdown_row(cells: Iterable[str | Text]) -> str:
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"


ASCII_MARKS: Mapping[Verdict, str] = {**MARKS, Verdict.BETTER: "v", Verdict.WORSE: "^"}
STYLES = {
    Verdict.BETTER: "green",
    Verdict.WORSE: "red",
    Verdict.EQUAL: "dim",
    Verdict.UNKNOWN: "dim",
}
# Spaces between blocks and digits of the largest number, from roomy to tight.
TABLE_LAYOUTS = ((3, 5), (2, 5), (1, 5), (1, 4))


def styled(cell: Cell, marks: Mapping[Verdict, str]) -> Text:
    """Return a cell as text, with the mark and the colour of its verdict."""
    if cell.verdict is None:
        return Text(cell.text)
    return Text(f"{cell.text}{marks[cell.verdict]}", style=STYLES[cell.verdict])


@dataclass(frozen=True)
class ComparisonTable:
    """The table as a rich renderable that suits itself to the width it gets."""

    comparison: Comparison
    is_ascii: bool = False  # whether it has signs of ASCII alone, as on a terminal without others

    @property
    def marks(self) -> Mapping[Verdict, str]:
        return ASCII_MARKS if self.is_ascii else MARKS

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = replace(self, is_ascii=options.ascii_only)
        if self.comparison.indices:
            yield from table._indices(console, options)
            yield ""
        if self.comparison.norms:
            yield table._norms()
            yield ""
        lines = table._legend()
        lines += [Text(line, style="bold") for line in verdicts_of(self.comparison)]
        for text in lines:
            yield Text(text.plain.replace("–", "-"), text.style) if table.is_ascii else text

    def _indices(self, console: Console, options: ConsoleOptions) -> RenderResult:
        unlimited = options.update_width(UNLIMITED_WIDTH)

        def fits(table: Table) -> bool:
            return Measurement.get(console, unlimited, table).maximum <= options.max_width

        for gap, digits in TABLE_LAYOUTS:
            wide = self._side_by_side(self.comparison.indices, gap, digits)
            if fits(wide):
                yield wide
                return
        waiting = list(self.comparison.indices)
        gap, digits = TABLE_LAYOUTS[0]
        while waiting:
            count = len(waiting)
            while count > 1 and not fits(self._side_by_side(waiting[:count], gap, digits)):
                count -= 1
            if count == 1:
                yield self._index(waiting[0], options.max_width)
            else:
                yield self._side_by_side(waiting[:count], gap, digits)
            del waiting[:count]
            if waiting:
                yield ""

    def _side_by_side(self, quantities: Sequence[Quantity], gap: int, digits: int) -> Table:
        """Return the paper's table: the joints' names, then the blocks of some indices."""
        grid = Table.grid(padding=(0, gap, 0, 0), pad_edge=False)
        grid.add_row(
            _block(" ", [self._names(quantities)]),
            *(_block(self._title(q), self._columns(q, digits)) for q in quantities),
        )
        return grid

    def _index(self, quantity: Quantity, width: int) -> Table | WideTable:
        """Return one index alone: the joints' names, then its runs and ratios."""
        names, numbers = self._names([quantity]), self._columns(quantity, SIGNIFICANT_DIGITS)
        if len(pieces([names], numbers, width, 1)) > 1:
            return WideTable([names], numbers, title=self._title(quantity), box=SIMPLE)
        return _block(self._title(quantity), [names, *numbers])

    def _norms(self) -> WideTable:
        """Return what is shown over all joints alone, one row each."""
        norms = self.comparison.norms
        are_l2 = all("L2" in quantity.meaning for quantity in norms)
        names = TableColumn(
            "L2, all joints" if are_l2 else "all joints",
            [self._title(quantity) for quantity in norms],
            is_text=True,
        )
        columns = self._cells([cells_of(self.comparison, each, (None,))[0] for each in norms])
        return WideTable([names], columns, box=SIMPLE, header_style="table.header")

    def _legend(self) -> list[Text]:
        """Return what symbols and marks mean, and why numbers are not there."""
        comparison = self.comparison
        dim = [Text(line, style="dim") for line in legend_of(comparison, self.marks)]
        return [*dim, *(Text(line) for line in (*comparison.notes, *footnotes(comparison)))]

    def _names(self, quantities: Sequence[Quantity]) -> TableColumn:
        names = [Text(shown(name)) for name in self.comparison.joint_names]
        return TableColumn("joint", [*names, Text(total_name(quantities))], is_text=True)

    def _title(self, quantity: Quantity) -> str:
        return f"{quantity.symbol} [{self.comparison.unit(quantity)}]"

    def _columns(self, quantity: Quantity, digits: int) -> list[TableColumn]:
        joints = (*self.comparison.joint_names, None)
        return self._cells(cells_of(self.comparison, quantity, joints, digits))

    def _cells(self, rows: Sequence[Sequence[Cell]]) -> list[TableColumn]:
        texts = ([styled(each, self.marks) for each in row] for row in rows)
        return columns_of(headings_of(self.comparison), texts)


def table_text(comparison: Comparison, width: int = 100) -> str:
    """Return the table as plain text without colours or trailing spaces."""
    return tables_text([ComparisonTable(comparison)], width)


def _block(title: str, columns: Sequence[TableColumn]) -> Table:
    """Return columns under a common title, their last cells below a line of their own."""
    block = Table(
        title=Text(title, style="bold"),
        box=SIMPLE,
        show_edge=False,
        show_footer=True,
        padding=0,
        min_width=len(title),
    )
    for heading, cells, is_text in columns:
        total = Text("").append(cells[-1])
        total.stylize("bold")
        justify: JustifyMethod = "left" if is_text else "right"
        block.add_column(Text(heading), footer=total, justify=justify, overflow="fold")
    for row in zip(*(column.cells[:-1] for column in columns), strict=True):
        block.add_row(*row)
    return block

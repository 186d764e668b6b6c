"""The paper's Table I for our runs, for a terminal and as plain text.

Blocks of one index each stand side by side as in the paper, as many as the width allows. A
ratio carries a mark besides its colour, so that better and worse read without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rich.box import SIMPLE
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from hpid_ros.analysis.comparison import THRESHOLD, Comparison, Verdict, verdict, verdict_lines
from hpid_ros.analysis.quantities import PAPER, Fold, Quantity
from hpid_ros.analysis.results import RunIndices
from hpid_ros.base.console import plain_console
from hpid_ros.base.foreign_text import shown
from hpid_ros.report.tables.numbers import (
    SIGNIFICANT_DIGITS,
    footnotes,
    format_quartiles,
    format_ratio,
    format_values,
)
from hpid_ros.report.tables.wide_table import UNLIMITED_WIDTH, TableColumn, WideTable, pieces

MARKS = {Verdict.BETTER: "▼", Verdict.WORSE: "▲", Verdict.EQUAL: "=", Verdict.UNKNOWN: " "}
ASCII_MARKS = {**MARKS, Verdict.BETTER: "v", Verdict.WORSE: "^"}
STYLES = {
    Verdict.BETTER: "green",
    Verdict.WORSE: "red",
    Verdict.EQUAL: "dim",
    Verdict.UNKNOWN: "dim",
}
# Spaces between blocks and digits of the largest number, from roomy to tight.
LAYOUTS = ((3, 5), (2, 5), (1, 5), (1, 4))


class ComparisonTable:
    """The table as a rich renderable that suits itself to the width it gets."""

    def __init__(self, comparison: Comparison) -> None:
        self.comparison = comparison

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        ascii_only = options.ascii_only
        blocks = _Blocks(self.comparison, ASCII_MARKS if ascii_only else MARKS)
        if self.comparison.indices:
            yield from self._indices(blocks, console, options)
            yield ""
        if self.comparison.norms:
            yield blocks.of_norms()
            yield ""
        lines = [*blocks.legend(), *blocks.verdicts()]
        for text in lines:
            yield Text(text.plain.replace("–", "-"), text.style) if ascii_only else text

    def _indices(self, blocks: _Blocks, console: Console, options: ConsoleOptions) -> RenderResult:
        unlimited = options.update_width(UNLIMITED_WIDTH)

        def fits(table: Table) -> bool:
            return Measurement.get(console, unlimited, table).maximum <= options.max_width

        for gap, digits in LAYOUTS:
            wide = blocks.side_by_side(self.comparison.indices, gap, digits)
            if fits(wide):
                yield wide
                return
        waiting = list(self.comparison.indices)
        gap, digits = LAYOUTS[0]
        while waiting:
            count = len(waiting)
            while count > 1 and not fits(blocks.side_by_side(waiting[:count], gap, digits)):
                count -= 1
            if count == 1:
                yield blocks.of_index(waiting[0], options.max_width)
            else:
                yield blocks.side_by_side(waiting[:count], gap, digits)
            del waiting[:count]
            if waiting:
                yield ""


def table_text(comparison: Comparison, width: int = 100) -> str:
    """Return the table as plain text without colours or trailing spaces."""
    console = plain_console(width)
    with console.capture() as capture:
        console.print(ComparisonTable(comparison))
    lines = (line.rstrip() for line in capture.get().splitlines())
    return "\n".join(lines).strip("\n") + "\n"


class _Blocks:
    """The pieces of one comparison's table: names, one block an index, norms, legend."""

    def __init__(self, comparison: Comparison, marks: dict[Verdict, str]) -> None:
        self._comparison = comparison
        self._marks = marks

    def side_by_side(self, quantities: Sequence[Quantity], gap: int, digits: int) -> Table:
        """Return the paper's table: the joints' names, then the blocks of some indices."""
        grid = Table.grid(padding=(0, gap, 0, 0), pad_edge=False)
        grid.add_row(
            _block(" ", [self.names(quantities)]),
            *(_block(self._title(q), self._columns(q, digits)) for q in quantities),
        )
        return grid

    def of_index(self, quantity: Quantity, width: int) -> Table | WideTable:
        """Return one index alone: the joints' names, then its runs and ratios."""
        columns = [self.names([quantity]), *self._columns(quantity, SIGNIFICANT_DIGITS)]
        names, *numbers = (
            TableColumn(each.heading, each.cells, each.justify == "left") for each in columns
        )
        if len(pieces([names], numbers, width, 1)) > 1:
            return WideTable([names], numbers, title=self._title(quantity), box=SIMPLE)
        return _block(self._title(quantity), columns)

    def of_norms(self) -> WideTable:
        """Return what is shown over all joints alone, one row each."""
        are_l2 = all("L2" in quantity.meaning for quantity in self._comparison.norms)
        norms = self._comparison.norms
        names = TableColumn(
            "L2, all joints" if are_l2 else "all joints",
            [self._title(quantity) for quantity in norms],
            is_text=True,
        )
        headings: list[str] = []
        for k, run in enumerate(self._comparison.runs):
            headings += [heading_of(run), *_quartiles_heading(run), *(["ratio"] if k else [])]
        rows = [self._norm_row(quantity) for quantity in norms]
        cells = zip(*rows, strict=True)
        columns = [TableColumn(each, cell) for each, cell in zip(headings, cells, strict=True)]
        return WideTable([names], columns, box=SIMPLE, header_style="table.header")

    def legend(self) -> list[Text]:
        """Return what symbols and marks mean, and why numbers are not there."""
        comparison = self._comparison
        shown = comparison.indices or comparison.norms
        lines = [", ".join(f"{q.symbol} {q.meaning}" for q in shown) + "."]
        if any(run.spread for run in comparison.runs):
            lines.append("(n): median of n runs, with the first and third quartile.")
        if comparison.others:
            marks, baseline = self._marks, heading_of(comparison.baseline)
            lines.append(
                f"Ratio: run / {baseline}; {marks[Verdict.BETTER]} lower, which "
                f"is better, {marks[Verdict.WORSE]} higher, {marks[Verdict.EQUAL]} equal "
                f"{THRESHOLD}."
            )
        dim = [Text(line, style="dim") for line in lines]
        return [*dim, *(Text(line) for line in (*comparison.notes, *footnotes(comparison)))]

    def verdicts(self) -> list[Text]:
        """Return a line for each run beside the baseline, where the paper's numbers are shown."""
        comparison = self._comparison
        if not {*comparison.indices, *comparison.norms} >= set(PAPER):
            return []
        return [Text(line, style="bold") for line in verdict_lines(comparison)]

    def names(self, quantities: Sequence[Quantity]) -> _RunColumn:
        """Return the names of the rows."""
        names = [Text(shown(name)) for name in self._comparison.joint_names]
        return _RunColumn("joint", [*names, Text(total_name(quantities))], "left")

    def _title(self, quantity: Quantity) -> str:
        return f"{quantity.symbol} [{self._comparison.unit(quantity)}]"

    def _columns(self, quantity: Quantity, digits: int) -> list[_RunColumn]:
        joints = (*self._comparison.joint_names, None)
        runs = self._comparison.runs
        values = [run.value(quantity, joint) for run in runs for joint in joints]
        texts = [Text(text) for text in format_values(values, digits)]
        columns: list[_RunColumn] = []
        for k, run in enumerate(runs):
            cells = texts[k * len(joints) : (k + 1) * len(joints)]
            columns.append(_RunColumn(heading_of(run), cells))
            for heading in _quartiles_heading(run):
                spreads = [Text(quartiles_of(run, quantity, joint)) for joint in joints]
                columns.append(_RunColumn(heading, spreads))
            if k:
                ratios = (self._comparison.ratio(run.label, quantity, joint) for joint in joints)
                columns.append(_RunColumn("ratio", [self._ratio(ratio) for ratio in ratios]))
        return columns

    def _norm_row(self, quantity: Quantity) -> list[Text]:
        runs = self._comparison.runs
        texts = format_values(run.value(quantity) for run in runs)
        row: list[Text] = []
        for k, (run, text) in enumerate(zip(runs, texts, strict=True)):
            row.append(Text(text))
            row += [Text(quartiles_of(run, quantity, None)) for _ in _quartiles_heading(run)]
            if k:
                row.append(self._ratio(self._comparison.ratio(run.label, quantity)))
        return row

    def _ratio(self, ratio: float) -> Text:
        kind = verdict(ratio)
        return Text(f"{format_ratio(ratio)}{self._marks[kind]}", style=STYLES[kind])


class _RunColumn(NamedTuple):
    heading: str
    cells: list[Text]  # one for each joint, then the total
    justify: JustifyMethod = "right"


def heading_of(run: RunIndices) -> str:
    """Return a run's label, with the number of its repeats where there are several."""
    label = shown(run.label)
    return label if run.spread is None else f"{label} ({run.spread.repeats})"


def quartiles_of(run: RunIndices, quantity: Quantity, joint: str | None) -> str:
    """Return the quartiles of a number of a run of repeats, as a text."""
    quartiles = {} if run.spread is None else run.spread.quartiles[joint]
    return format_quartiles(quartiles.get(quantity.key))


def total_name(quantities: Sequence[Quantity]) -> str:
    """Return what the last line of a table is called."""
    return "total" if all(quantity.fold is Fold.SUM for quantity in quantities) else "all"


def _quartiles_heading(run: RunIndices) -> list[str]:
    return [] if run.spread is None else ["quartiles"]


def _block(title: str, columns: Sequence[_RunColumn]) -> Table:
    """Return columns under a common title, their last cells below a line of their own."""
    block = Table(
        title=Text(title, style="bold"),
        box=SIMPLE,
        show_edge=False,
        show_footer=True,
        padding=0,
        min_width=len(title),
    )
    for heading, cells, justify in columns:
        total = cells[-1].copy()
        total.stylize("bold")
        block.add_column(Text(heading), footer=total, justify=justify, overflow="fold")
    for row in zip(*(column.cells[:-1] for column in columns), strict=True):
        block.add_row(*row)
    return block

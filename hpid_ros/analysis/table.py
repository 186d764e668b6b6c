"""The paper's Table I for our runs, for a terminal and as plain text.

Three forms of one table: side by side as in the paper while the width allows, else one block
for each index. A ratio carries a mark besides its colour, so that better and worse read
without it.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from rich.box import SIMPLE
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from hpid_ros.analysis.comparison import Comparison, Verdict, verdict
from hpid_ros.analysis.indices import INDICES, NORMS, Quantity

MARKS = {Verdict.BETTER: "▼", Verdict.WORSE: "▲", Verdict.EQUAL: "="}
ASCII_MARKS = {Verdict.BETTER: "v", Verdict.WORSE: "^", Verdict.EQUAL: "="}
STYLES = {Verdict.BETTER: "green", Verdict.WORSE: "red", Verdict.EQUAL: "dim"}
SIGNIFICANT_DIGITS = 5
# Beyond these a column is scientific: plain digits would be many, or zeros.
SMALLEST_PLAIN, LARGEST_PLAIN = 1e-3, 1e6
UNLIMITED_WIDTH = 10_000
# Spaces between blocks and digits of the largest number, from roomy to tight.
LAYOUTS = ((3, 5), (2, 5), (1, 5), (1, 4))


def format_values(values: Iterable[float], digits: int = SIGNIFICANT_DIGITS) -> list[str]:
    """Return numbers of one column with the same decimals, so that their points line up.

    The largest decides: it shows about `digits` digits. A number that would read as zero
    without being zero, and a column of very large or small numbers, are scientific.

    Args:
        values: The column.
        digits: Digits of the largest number, and the decimals' limit plus one.
    """
    column = list(values)
    largest = max((abs(value) for value in column), default=0.0)
    if largest and not SMALLEST_PLAIN <= largest < LARGEST_PLAIN:
        return [_scientific(value) for value in column]
    whole = max(1, math.floor(math.log10(largest)) + 1) if largest else 1
    decimals = max(0, digits - whole)
    smallest = 0.5 * 10.0**-decimals
    return [
        _scientific(value) if value and abs(value) < smallest else f"{value:.{decimals}f}"
        for value in column
    ]


def format_ratio(ratio: float) -> str:
    """Return a ratio in at most five characters or so: 0.612, 12.35, 1.2e5, inf.

    Args:
        ratio: A cost over the baseline's.
    """
    if math.isinf(ratio) or ratio < 10.0:
        return f"{ratio:.3f}"
    return f"{ratio:.4g}" if ratio < 1e4 else _scientific(ratio)


class ComparisonTable:
    """The table as a rich renderable that suits itself to the width it gets.

    Attributes:
        comparison: What it shows.
    """

    def __init__(self, comparison: Comparison) -> None:
        self.comparison = comparison

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        blocks = _Blocks(self.comparison, ASCII_MARKS if options.ascii_only else MARKS)
        unlimited = options.update_width(UNLIMITED_WIDTH)
        for gap, digits in LAYOUTS:
            wide = blocks.side_by_side(gap, digits)
            if Measurement.get(console, unlimited, wide).maximum <= options.max_width:
                yield wide
                break
        else:
            for quantity in INDICES:
                yield blocks.of_index(quantity)
                yield ""
        yield ""
        yield blocks.of_norms()
        yield ""
        yield blocks.legend()


def table_text(comparison: Comparison, width: int = 100) -> str:
    """Return the table as plain text without colours or trailing spaces.

    Args:
        comparison: What it shows.
        width: Columns at most; a table too wide for it is broken into blocks.
    """
    # A StringIO has no encoding of its own: the text is Unicode, whatever the terminal is.
    console = Console(
        file=io.StringIO(), width=width, color_system=None, legacy_windows=False, emoji=False
    )
    with console.capture() as capture:
        console.print(ComparisonTable(comparison))
    lines = (line.rstrip() for line in capture.get().splitlines())
    return "\n".join(lines).strip("\n") + "\n"


class _Blocks:
    """The pieces of one comparison's table: names, one block an index, norms, legend."""

    def __init__(self, comparison: Comparison, marks: dict[Verdict, str]) -> None:
        self._comparison = comparison
        self._marks = marks

    def side_by_side(self, gap: int, digits: int) -> Table:
        """Return the paper's table: the joints' names, then the blocks of all indices."""
        grid = Table.grid(padding=(0, gap, 0, 0), pad_edge=False)
        grid.add_row(
            _block(" ", [self.names()]),
            *(_block(_title(q), self._columns(q, digits)) for q in INDICES),
        )
        return grid

    def of_index(self, quantity: Quantity) -> Table:
        """Return one index alone: the joints' names, then its runs and ratios."""
        columns = [self.names(), *self._columns(quantity, SIGNIFICANT_DIGITS)]
        return _block(_title(quantity), columns)

    def of_norms(self) -> Table:
        """Return the L2 norms over all joints, one row each."""
        block = Table(box=SIMPLE, show_edge=False, padding=(0, 1, 0, 0))
        block.add_column(Text("L2, all joints"), overflow="fold")
        for k, run in enumerate(self._comparison.runs):
            block.add_column(Text(run.label), justify="right", overflow="fold")
            if k:
                block.add_column("ratio", justify="right", overflow="fold")
        for quantity in NORMS:
            block.add_row(Text(f"{quantity.symbol} [{quantity.unit}]"), *self._norm_row(quantity))
        return block

    def legend(self) -> Text:
        """Return what symbols and marks mean."""
        names = ", ".join(f"{q.symbol} {q.meaning}" for q in INDICES)
        if not self._comparison.others:
            return Text(f"{names}.", style="dim")
        marks = self._marks
        baseline = self._comparison.baseline.label
        return Text(
            f"{names}.\nRatio: run / {baseline}; {marks[Verdict.BETTER]} lower, which is better, "
            f"{marks[Verdict.WORSE]} higher, {marks[Verdict.EQUAL]} equal.",
            style="dim",
        )

    def names(self) -> _Column:
        """Return the names of the rows."""
        names = [Text(name) for name in self._comparison.joint_names]
        return _Column("joint", [*names, Text("total")], "left")

    def _columns(self, quantity: Quantity, digits: int) -> list[_Column]:
        joints = (*self._comparison.joint_names, None)
        runs = self._comparison.runs
        values = [run.value(quantity, joint) for run in runs for joint in joints]
        texts = [Text(text) for text in format_values(values, digits)]
        columns: list[_Column] = []
        for k, run in enumerate(runs):
            columns.append(_Column(run.label, texts[k * len(joints) : (k + 1) * len(joints)]))
            if k:
                ratios = (self._comparison.ratio(run.label, quantity, joint) for joint in joints)
                columns.append(_Column("ratio", [self._ratio(ratio) for ratio in ratios]))
        return columns

    def _norm_row(self, quantity: Quantity) -> list[Text]:
        runs = self._comparison.runs
        texts = format_values(run.value(quantity) for run in runs)
        row = [Text(texts[0])]
        for run, text in zip(runs[1:], texts[1:], strict=True):
            row += [Text(text), self._ratio(self._comparison.ratio(run.label, quantity))]
        return row

    def _ratio(self, ratio: float) -> Text:
        kind = verdict(ratio)
        return Text(f"{format_ratio(ratio)}{self._marks[kind]}", style=STYLES[kind])


class _Column(NamedTuple):
    heading: str
    cells: list[Text]  # one for each joint, then the total
    justify: JustifyMethod = "right"


def _title(quantity: Quantity) -> str:
    return f"{quantity.symbol} [{quantity.unit}]"


def _block(title: str, columns: Sequence[_Column]) -> Table:
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


def _scientific(value: float) -> str:
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"

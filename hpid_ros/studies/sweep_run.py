"""Running a sweep, and its table."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing

from rich.box import SIMPLE
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from hpid_ros.analysis.comparison import verdict
from hpid_ros.analysis.quantities import Quantity
from hpid_ros.base.console import plain_console
from hpid_ros.base.units import unit_over
from hpid_ros.experiment.result.folder import EXPERIMENT, ResultFolder
from hpid_ros.report.tables.numbers import format_ratio, format_values, slides_note
from hpid_ros.report.tables.table import ASCII_MARKS, MARKS, STYLES
from hpid_ros.report.tables.wide_table import UNLIMITED_WIDTH, TableColumn, WideTable
from hpid_ros.studies.batch import Outcome, Runner
from hpid_ros.studies.sweep import Row, Sweep, shown
from hpid_ros.studies.sweep_result import QUANTITIES, Quartiles, SweepResult

_NOTHING = "-"


class SweepTable:
    """Rows are points; columns are parameters, then median, quartiles and ratio of each index.

    Indices stand side by side as far as the width allows.
    """

    def __init__(self, result: SweepResult) -> None:
        self.result = result

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        sweep, is_ascii = self.result.sweep, options.ascii_only
        names = [TableColumn("controller", [_label(row) for row in sweep.rows], is_text=True)]
        for axis in sweep.axes:
            values = [row.values.get(axis.name) for row in sweep.rows]
            texts = [Text(_NOTHING if each is None else shown(each)) for each in values]
            names.append(TableColumn(axis.name, texts))
        columns = [
            TableColumn(*each)
            for quantity in QUANTITIES
            for each in self._columns(quantity, is_ascii)
        ]
        notes = [Text(self.result.note(place)) for place in range(len(sweep.rows))]
        if any(notes):
            columns.append(TableColumn("note", notes, is_text=True))
        yield WideTable(names, columns, box=SIMPLE)
        yield self._legend()

    def _columns(self, quantity: Quantity, is_ascii: bool) -> list[tuple[str, list[Text]]]:
        places = range(len(self.result.sweep.rows))
        own = [self.result.quartiles(place, quantity) for place in places]
        ratios = [self.result.ratios(place, quantity) for place in places]
        numbers = iter(format_values([x for each in own if each for x in each]))
        texts = [None if each is None else [next(numbers) for _ in each] for each in own]
        dash = "-" if is_ascii else "–"
        return [
            (self._heading(quantity), _cells(t[1] if t else None for t in texts)),
            ("quartiles", _cells(f"{t[0]}{dash}{t[2]}" if t else None for t in texts)),
            ("ratio", [_ratio(each, is_ascii) for each in ratios]),
        ]

    def _heading(self, quantity: Quantity) -> str:
        return f"{quantity.symbol} [{unit_over(quantity.unit, self.result.sweep.are_slides)}]"

    def _legend(self) -> Text:
        sweep = self.result.sweep
        count = len(sweep.seeds)
        joints = ", ".join(sweep.joints) or f"all {len(sweep.experiment.world.joints)} joints"
        note = slides_note(sweep.judged, sweep.experiment.slides)
        lines = [
            f"Medians and quartiles over {count} seed{'s' * (count > 1)}, totals over {joints}.",
            f"Ratio: run / {sweep.baseline} with the same seed on the same robot; median.",
            note,
        ]
        return Text("\n".join(filter(None, lines)), style="dim")


def sweep_text(result: SweepResult) -> str:
    """Return the table as plain text, one line a row however long it is."""
    console = plain_console(UNLIMITED_WIDTH)
    with console.capture() as capture:
        console.print(SweepTable(result))
    lines = (line.rstrip() for line in capture.get().splitlines())
    return "\n".join(lines).strip("\n") + "\n"


def _label(row: Row) -> Text:
    return Text(row.label if row.baseline is not None else f"{row.label} (baseline)")


def _cells(texts: Iterable[str | None]) -> list[Text]:
    return [Text(_NOTHING if each is None else each) for each in texts]


def _ratio(ratios: Quartiles | None, is_ascii: bool) -> Text:
    if ratios is None:
        return Text(_NOTHING)
    kind = verdict(ratios.median)
    marks = ASCII_MARKS if is_ascii else MARKS
    return Text(f"{format_ratio(ratios.median)}{marks[kind]}", style=STYLES[kind])


def run_sweep(
    sweep: Sweep, folder: ResultFolder, run: Runner, advanced: Callable[[Outcome], None]
) -> SweepResult:
    """Run every row with every seed, and save what was run, also when interrupted."""
    folder.write(EXPERIMENT, sweep.experiment.text)
    tasks = sweep.tasks()
    keys = tuple(tasks)
    outcomes: dict[tuple[int, int], Outcome] = {}
    result = SweepResult(sweep, outcomes)
    try:
        with closing(run(tuple(tasks.values()))) as batch:
            for outcome in batch:
                outcomes[keys[outcome.place]] = outcome
                advanced(outcome)
    finally:
        save(result, folder)
    return result


def save(result: SweepResult, folder: ResultFolder) -> None:
    """Write every run, the summary and the table."""
    folder.write("sweep.csv", result.runs_csv())
    folder.write("sweep.json", result.json())
    folder.write("table.txt", sweep_text(result))

"""The report's tables: indices, settings, losses, provenance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from hpid_ros.analysis.comparison import THRESHOLD, Comparison, Verdict, verdict
from hpid_ros.analysis.doubts import COLUMNS, quality_rows
from hpid_ros.analysis.quantities import QUANTITIES, Quantity
from hpid_ros.recordings.series import RunSeries
from hpid_ros.report.html.blocks import (
    Block,
    Cell,
    Details,
    Heading,
    IndexRow,
    IndexTable,
    Paragraph,
    PlainTable,
    Settings,
    Title,
    value_text,
)
from hpid_ros.report.tables.numbers import footnotes, format_ratio, format_values
from hpid_ros.report.tables.table import MARKS, heading_of, quartiles_of, total_name

# Settings by parameter name, of each joint, of each run's label.
Parameters = Mapping[str, Mapping[str, Mapping[str, object]]]


def index_table(comparison: Comparison) -> IndexTable:
    """Return the paper's Table I: joints by indices, runs and ratios, a total line."""
    headings = _run_headings(comparison)
    joints = (*comparison.joint_names, None)
    cells = [_index_cells(comparison, quantity, joints) for quantity in comparison.indices]
    total = total_name(comparison.indices)
    rows = [
        IndexRow(joint or total, [column[k] for column in cells]) for k, joint in enumerate(joints)
    ]
    return IndexTable(
        "Indices of each joint",
        "joint",
        headings,
        rows[:-1],
        rows[-1],
        [_title(comparison, quantity) for quantity in comparison.indices],
        len(headings) * len(comparison.indices),
    )


def norm_table(comparison: Comparison) -> IndexTable:
    """Return what the comparison shows over all joints alone: the L2 norms."""
    return _overall_table(comparison, comparison.norms, "L2 norms over all joints")


def legend(comparison: Comparison) -> Iterator[Block]:
    """Yield what symbols and marks of the tables mean, and why numbers are not there."""
    shown = comparison.indices or comparison.norms
    text = "; ".join(f"{quantity.symbol}: {quantity.meaning}" for quantity in shown) + "."
    if any(run.spread for run in comparison.runs):
        text += " A number in brackets: median of so many runs, with first and third quartile."
    if comparison.others:
        text += (
            f" Ratio: run / {comparison.baseline.label}; {MARKS[Verdict.BETTER]} lower, which "
            f"is better, {MARKS[Verdict.WORSE]} higher, {MARKS[Verdict.EQUAL]} equal "
            f"{THRESHOLD}."
        )
    yield Paragraph(text, is_soft=True)
    for line in footnotes(comparison):
        yield Paragraph(line)


def further_tables(comparison: Comparison) -> Iterator[Block]:
    """Yield every quantity that all runs have: over all joints, then each one by joint."""
    quantities = [
        quantity
        for quantity in QUANTITIES.values()
        if all(quantity in run.quantities for run in comparison.runs)
    ]
    yield _overall_table(comparison, quantities, "All indices over all joints")
    for quantity in quantities:
        yield Details(
            _title(comparison, quantity, quantity.meaning), _joint_table(comparison, quantity)
        )


def parameter_tables(parameters: Parameters) -> Iterator[Block]:
    """Yield for each run a heading, the settings that all joints share, and those that differ."""
    for label, joints in parameters.items():
        yield Heading(label)
        names = list(dict.fromkeys(name for settings in joints.values() for name in settings))
        names = [name for name in names if name != "joint"]  # the rows' own name
        texts = {
            name: [value_text(settings.get(name)) for settings in joints.values()]
            for name in names
        }
        shared = [name for name in names if len(joints) > 1 and len(set(texts[name])) == 1]
        own = [name for name in names if name not in shared]
        if own:
            rows = [(joint, *(texts[name][k] for name in own)) for k, joint in enumerate(joints)]
            yield PlainTable(f"Parameters of {label}", ("joint", *own), rows)
        if shared:
            yield Paragraph("The same for all joints:")
            yield Settings([(name, texts[name][0]) for name in shared])


def losses(runs: Sequence[RunSeries]) -> Iterator[Block]:
    """Yield for each run what went missing: a line if nothing did, else a table by joint."""
    for run in runs:
        counts = {(len(s.state_stamps_ns), len(s.command_stamps_ns)) for s in run.joints}
        if not any(run.losses.values()) and len(counts) == 1:
            states, commands = counts.pop()
            yield Paragraph(
                f"{run.label}: none. Each joint has {states} states and {commands} commands."
            )
            continue
        rows = [
            (
                series.joint,
                len(series.state_stamps_ns),
                len(series.command_stamps_ns),
                run.losses[series.joint].unanswered_states,
                run.losses[series.joint].repeated_commands,
            )
            for series in run.joints
        ]
        columns = ("joint", "states", "commands", "unanswered states", "repeated commands")
        yield Heading(run.label)
        yield PlainTable.of(f"Losses of {run.label}", columns, rows)


def retunes(runs: Sequence[RunSeries]) -> Iterator[Block]:
    """Yield a table of the changes of parameters while runs were recorded; nothing without one."""
    rows = [
        (run.label, f"{(each.stamp_ns - run.start_ns) / 1e9:.3f}", each.node, each.change)
        for run in runs
        for each in run.retunes
    ]
    if rows:
        yield Heading("Retuned while running")
        yield PlainTable("Changes of parameters", ("run", "t [s]", "node", "change"), rows)


def data_quality(runs: Sequence[RunSeries]) -> Iterator[Block]:
    """Yield for each run that was read from a recording what it was made of."""
    for run in runs:
        quality = run.quality
        if not quality.joints:
            continue
        yield Heading(f"Recording of {run.label}")
        for line in quality.lines:
            yield Paragraph(line)
        references = {each.reference for each in quality.joints.values()}
        yield Paragraph(f"Reference: {', '.join(sorted(references))}.")
        rows = [row for joint, each in quality.joints.items() for row in quality_rows(joint, each)]
        yield PlainTable.of(f"Recording of {run.label}", COLUMNS, rows)


def _overall_table(
    comparison: Comparison, quantities: Sequence[Quantity], name: str
) -> IndexTable:
    headings = _run_headings(comparison)
    rows = [
        IndexRow(
            _title(comparison, quantity, quantity.meaning),
            _index_cells(comparison, quantity, (None,)),
        )
        for quantity in quantities
    ]
    return IndexTable(name, "over all joints", headings, rows, columns=len(headings) + 2)


def _joint_table(comparison: Comparison, quantity: Quantity) -> IndexTable:
    joints = (*comparison.joint_names, None)
    headings = _run_headings(comparison)
    last = f"all: {quantity.fold.value}"
    *rows, total = (
        IndexRow(joint or last, [cells])
        for joint, cells in zip(joints, _index_cells(comparison, quantity, joints), strict=True)
    )
    name = f"{quantity.meaning} of each joint"
    return IndexTable(name, "joint", headings, rows, total, columns=len(headings))


def _title(comparison: Comparison, quantity: Quantity, meaning: str = "") -> Title:
    return Title(quantity.symbol, comparison.unit(quantity), meaning)


def _run_headings(comparison: Comparison) -> list[str]:
    headings: list[str] = []
    for run in comparison.runs:
        headings.append(heading_of(run))
        headings += [] if run.spread is None else ["quartiles"]
        headings += [] if run is comparison.baseline else ["ratio"]
    return headings


def _index_cells(
    comparison: Comparison, quantity: Quantity, joints: Sequence[str | None]
) -> list[list[Cell]]:
    """Return for each joint the cells of all runs and ratios of one quantity."""
    values = [run.value(quantity, joint) for joint in joints for run in comparison.runs]
    texts = iter(format_values(values))
    rows = []
    for joint in joints:
        cells: list[Cell] = []
        for run in comparison.runs:
            cells.append(Cell(next(texts)))
            cells += [] if run.spread is None else [Cell(quartiles_of(run, quantity, joint))]
            if run is not comparison.baseline:
                cells.append(_ratio(comparison.ratio(run.label, quantity, joint)))
        rows.append(cells)
    return rows


def _ratio(ratio: float) -> Cell:
    found = verdict(ratio)
    return Cell(format_ratio(ratio), MARKS[found], found)

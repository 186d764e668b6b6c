"""The report's sections as blocks without markup: indices, settings, losses, provenance.

Each kind of block has the template's macro of the same name in ``templates/blocks.html``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from hpid_ros.messages.series import RunSeries
from hpid_ros.metrics.comparison import Comparison, Verdict
from hpid_ros.metrics.folding import COLUMNS, quality_rows
from hpid_ros.metrics.measure import Parameters
from hpid_ros.metrics.quantities import QUANTITIES, Quantity
from hpid_ros.report.table import (
    MARKS,
    Cell,
    cells_of,
    footnotes,
    headings_of,
    ratio_legend,
    total_name,
)

_PRINTED_COLUMNS = (10, 14, 18, 26)  # the style sheet has a size of type for each of these

SPOKEN = {
    Verdict.BETTER: "lower",
    Verdict.WORSE: "higher",
    Verdict.EQUAL: "equal",
    Verdict.UNKNOWN: "not defined",
}
"""Verdicts in a word, for screen readers."""

NOTHING = "–"  # what stands in the place of a value that there is not


@dataclass(frozen=True)
class Heading:
    """A heading within a section."""

    kind: ClassVar = "heading"
    text: str


@dataclass(frozen=True)
class Paragraph:
    """A paragraph; what is said beside the matter is soft."""

    kind: ClassVar = "paragraph"
    text: str
    is_soft: bool = False


@dataclass(frozen=True)
class Steps:
    """What to do, one thing after the other."""

    kind: ClassVar = "steps"
    # each in words, with the lines of the commands that do it, if there are any
    entries: Sequence[tuple[str, Sequence[str]]]


@dataclass(frozen=True)
class PlainTable:
    """A table of texts and numbers with one line of headings."""

    kind: ClassVar = "plain_table"
    name: str  # what a screen reader calls it
    columns: Sequence[str]  # the headings
    rows: Sequence[Sequence[str]]  # the rows, each as long as the headings
    is_prose: bool = False  # whether the last column holds sentences, which are broken into lines

    @classmethod
    def of(cls, name: str, columns: Sequence[str], rows: Iterable[Iterable[object]]) -> PlainTable:
        """Return a table of values of any type."""
        return cls(name, columns, [[value_text(value) for value in row] for row in rows])

    @property
    def are_texts(self) -> list[bool]:
        """Which columns hold something else than numbers."""
        return [not all(_is_number(row[k]) for row in self.rows) for k in range(len(self.columns))]


@dataclass(frozen=True)
class Settings:
    """Names and values as a list, where they are many and short."""

    kind: ClassVar = "settings"
    entries: Sequence[tuple[str, str]]  # the pairs


@dataclass(frozen=True)
class Properties:
    """A table of names and values."""

    kind: ClassVar = "properties"
    name: str  # what a screen reader calls it
    entries: Sequence[tuple[str, str]]  # the pairs

    @classmethod
    def of(cls, name: str, entries: Mapping[str, object]) -> Properties:
        """Return a table of a mapping; nested entries get dotted names."""
        return cls(name, [(key, value_text(value)) for key, value in _flatten(entries)])


@dataclass(frozen=True)
class Title:
    """A quantity as a heading: its symbol, its unit, and what it means where that is said."""

    symbol: str
    unit: str
    meaning: str = ""


@dataclass(frozen=True)
class IndexRow:
    title: str | Title  # a joint, or a quantity
    groups: Sequence[Sequence[Cell]]  # cells that belong together, those of one quantity


@dataclass(frozen=True)
class IndexTable:
    """Rows by runs and ratios, for one quantity or for several beside each other."""

    kind: ClassVar = "index_table"
    name: str  # what a screen reader calls it
    corner: str  # heading of the rows' titles
    headings: Sequence[str]  # of the cells of one group
    rows: Sequence[IndexRow]
    total: IndexRow | None = None  # the last one, below a line; None if there is none
    groups: Sequence[Title] = ()  # quantities above the headings
    columns: int = 0  # beside the rows' titles, for the size of type on paper


@dataclass(frozen=True)
class Details:
    """A table that is shown when its title is clicked."""

    kind: ClassVar = "details"
    title: Title
    table: IndexTable


Block: TypeAlias = (
    Heading | Paragraph | Steps | PlainTable | Settings | Properties | IndexTable | Details
)


def value_text(value: object) -> str:
    """Return a setting or a fact as a text."""
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return ", ".join(value_text(item) for item in value)
    return str(value)


def printed_columns(columns: int) -> int:
    """Return how many columns the size of type on paper is chosen for."""
    return max((each for each in _PRINTED_COLUMNS if each <= columns), default=0)


def _flatten(entries: Mapping[str, object], prefix: str = "") -> Iterable[tuple[str, object]]:
    for name, value in entries.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _is_number(text: str) -> bool:
    if text == NOTHING:
        return True
    try:
        float(text)
    except ValueError:
        return False
    return True


def index_table(comparison: Comparison) -> IndexTable:
    """Return the paper's Table I: joints by indices, runs and ratios, a total line."""
    headings = headings_of(comparison)
    joints = (*comparison.joint_names, None)
    cells = [cells_of(comparison, quantity, joints) for quantity in comparison.indices]
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
        text += f" {ratio_legend(comparison.baseline.label, MARKS)}"
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
    headings = headings_of(comparison)
    rows = [
        IndexRow(
            _title(comparison, quantity, quantity.meaning), cells_of(comparison, quantity, (None,))
        )
        for quantity in quantities
    ]
    return IndexTable(name, "over all joints", headings, rows, columns=len(headings) + 2)


def _joint_table(comparison: Comparison, quantity: Quantity) -> IndexTable:
    joints = (*comparison.joint_names, None)
    headings = headings_of(comparison)
    last = f"all: {quantity.fold.value}"
    *rows, total = (
        IndexRow(joint or last, [cells])
        for joint, cells in zip(joints, cells_of(comparison, quantity, joints), strict=True)
    )
    name = f"{quantity.meaning} of each joint"
    return IndexTable(name, "joint", headings, rows, total, columns=len(headings))


def _title(comparison: Comparison, quantity: Quantity, meaning: str = "") -> Title:
    return Title(quantity.symbol, comparison.unit(quantity), meaning)

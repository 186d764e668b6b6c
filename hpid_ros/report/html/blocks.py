"""Blocks of the report's sections: headings, paragraphs and tables, without markup.

Each kind of block has the template's macro of the same name in ``templates/blocks.html``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from hpid_ros.analysis.comparison import Verdict

_PRINTED_COLUMNS = (10, 14, 18, 26)  # the style sheet has a size of type for each of these

_SPOKEN = {
    Verdict.BETTER: "lower",
    Verdict.WORSE: "higher",
    Verdict.EQUAL: "equal",
    Verdict.UNKNOWN: "not defined",
}

NOTHING = "–"
"""What stands in the place of a value that there is not."""


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

    @property
    def printed_columns(self) -> int:
        """How many columns the size of type on paper is chosen for."""
        return _printed(len(self.columns))


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
class Cell:
    """A number, or a ratio with its verdict."""

    text: str  # as it is printed
    mark: str = ""  # the verdict's sign; empty for a number
    verdict: Verdict | None = None  # which one; None for a number

    @property
    def style(self) -> str:
        """The verdict's class in the style sheet; empty for a number."""
        return "" if self.verdict is None else self.verdict.name.lower()

    @property
    def spoken(self) -> str:
        """The verdict in a word, for screen readers; empty for a number."""
        return "" if self.verdict is None else _SPOKEN[self.verdict]


@dataclass(frozen=True)
class IndexRow:
    """A row of an index table."""

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

    @property
    def printed_columns(self) -> int:
        """How many columns the size of type on paper is chosen for."""
        return _printed(self.columns)


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


def _printed(columns: int) -> int:
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

"""The report's page: its sections as blocks without markup, and the markup around them.

The answer stands first, then the table, the figures, what the controllers were set to, what
went missing, and where the numbers come from. The markup is in ``templates/``, which has a macro
for each kind of block, of the same name; style and program are in ``assets/``. Every text is
escaped where a template puts it into the page, by Jinja2, so that none can be forgotten; the
exceptions are :func:`style_sheet` and :func:`script`, which hold nothing of a recording.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from hpid_bench.report.figures import (
    GRID,
    INK,
    REFERENCE_COLOR,
    RUN_STYLES,
    Figure,
    Line,
    figures_of,
)
from hpid_ros.base.text import shown
from hpid_ros.messages.quality_lines import QUALITY_COLUMNS, quality_rows
from hpid_ros.messages.series import RunSeries, SeriesError
from hpid_ros.metrics.comparison import Comparison, Verdict, answer
from hpid_ros.metrics.gain_signals import RunGainSignals
from hpid_ros.metrics.measure import Parameters
from hpid_ros.metrics.quantities import QUANTITIES, Quantity
from hpid_ros.metrics.results import RunIndices
from hpid_ros.metrics.texts import (
    MARKS,
    Cell,
    cells_of,
    footnotes,
    headings_of,
    ratio_legend,
    total_name,
)

if TYPE_CHECKING:
    from hpid_ros.metrics.task import EndEffectorPath

_PRINTED_COLUMNS = (10, 14, 18, 26)  # the style sheet has a size of type for each of these

SPOKEN = {
    Verdict.BETTER: "lower",
    Verdict.WORSE: "higher",
    Verdict.EQUAL: "equal",
    Verdict.UNKNOWN: "not defined",
}
"""Verdicts in a word, for screen readers."""

NO_VALUE = "–"  # what stands in the place of a value that there is not


@dataclass(frozen=True)
class Heading:
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
        return NO_VALUE
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
    if text == NO_VALUE:
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
        references: dict[str, list[str]] = {}
        for joint, each in quality.joints.items():
            references.setdefault(each.reference, []).append(joint)
        listed = (
            text if len(references) == 1 else f"{text} ({', '.join(joints)})"
            for text, joints in sorted(references.items())
        )
        yield Paragraph(f"Reference: {'; '.join(listed)}.")
        rows = [row for joint, each in quality.joints.items() for row in quality_rows(joint, each)]
        yield PlainTable.of(f"Recording of {run.label}", QUALITY_COLUMNS, rows)


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


# The same hues as on paper, light enough for a dark page: line and tint of each run.
DARK_RUNS = (
    ("#6cb4ff", "#6cb4ff"),
    ("#ff9a52", "#7a4a2c"),
    ("#63d29b", "#2c5c47"),
    ("#c99bea", "#594070"),
    ("#ff8fa3", "#713d49"),
    ("#5fd4e6", "#2c5c66"),
    ("#d8bd5a", "#5d522a"),
    ("#aab6c4", "#4a525c"),
)

_UNKNOWN = Paragraph("The parameters of the controllers are not known.")
_NO_RECORDING = Paragraph("The numbers were saved without their recordings.")


def render_report(
    comparison: Comparison,
    runs: Sequence[RunSeries],
    provenance: Mapping[str, object],
    parameters: Parameters,
    *,
    warnings: Sequence[str] = (),
    repeats: Sequence[RunIndices] = (),
    gains: RunGainSignals | None = None,
    paths: Sequence[EndEffectorPath] = (),
) -> str:
    labels = [run.label for run in comparison.runs]
    if [run.label for run in runs] != [x for x in labels if x in {run.label for run in runs}]:
        raise SeriesError(
            f"the report's runs are {', '.join(run.label for run in runs)}, but the comparison's "
            f"are {', '.join(labels)}"
        )
    others, norms = " and ".join(labels[1:]), comparison.norms
    figures = page_figures(comparison, runs, repeats=repeats, gains=gains, paths=paths)
    sections: dict[str, Sequence[Block]] = {
        "Figures": () if figures else (_NO_RECORDING,),
        "All indices": [*further_tables(comparison)],
        "Parameters": [*parameter_tables(parameters)] or [_UNKNOWN],
        "Data": [Heading("Losses"), *losses(runs), *retunes(runs), *data_quality(runs)]
        if runs
        else [_NO_RECORDING],
        "Provenance": [Properties.of("Provenance", provenance)],
    }
    return render_page(
        f"{others} against {labels[0]}" if others else labels[0],
        answer(comparison),
        [*warnings, *_losses_warnings(runs)],
        [
            *([index_table(comparison)] if comparison.indices else []),
            *([_overall_table(comparison, norms, "L2 norms over all joints")] if norms else []),
            *legend(comparison),
        ],
        sections,
        figures,
        labels,
    )


def render_page(
    title: str,
    answer: str,
    warnings: Sequence[str],
    indices: Sequence[Block],
    sections: Mapping[str, Sequence[Block]],
    figures: Sequence[Figure],
    labels: Sequence[str],
) -> str:
    return template("page.html").render(
        title=title,
        answer=answer,
        warnings=warnings,
        indices=indices,
        sections=sections,
        figures=figures,
        data=page_data(figures, labels),
        style=style_sheet(),
        script=script(),
    )


SAMPLES = 150_000  # samples of all lines together: about 1.6 MB of text
LEAST_SAMPLES, MOST_SAMPLES = 200, 6000
PIXELS_PER_POINT = 4.0 / 3.0


def page_figures(
    comparison: Comparison,
    runs: Sequence[RunSeries],
    *,
    gains: RunGainSignals | None = None,
    **more: Any,
) -> list[Figure]:
    """Return :func:`.figures_of` runs, as detailed as keeps a page small."""
    joints = max((len(run.joint_names) for run in runs), default=1)
    lines = (3 + 2 * bool(gains)) * len(runs) * joints + joints
    samples = min(max(SAMPLES // lines, LEAST_SAMPLES), MOST_SAMPLES)
    return figures_of(comparison, runs, samples, gains=gains, **more)


def page_data(figures: Sequence[Figure], labels: Sequence[str]) -> dict[str, object]:
    """Return figures and runs as the page's program is given them, as JSON."""
    runs = [
        {
            "label": label,
            "style": k % len(RUN_STYLES),
            "dashes": [
                round(each * PIXELS_PER_POINT, 1)
                for each in RUN_STYLES[k % len(RUN_STYLES)].dashes or ()
            ],
        }
        for k, label in enumerate(labels)
    ]
    return {"runs": runs, "figures": [_packed(each) for each in figures]}


def _packed(figure: Figure) -> dict[str, object]:
    panels = [
        {
            "title": panel.caption,
            "lines": [line_data(line) for line in panel.lines],
            "level": panel.level,
            "marks": [{"run": run, "x": x} for run, x in panel.marks],
        }
        for panel in figure.panels
    ]
    return {
        "name": figure.name,
        "panels": panels,
        "caption": figure.caption.replace("^2", "²"),
        "group": figure.kind,
        "xName": figure.x,
        "xLog": figure.kind == "frequency",
        "yLog": figure.y_log,
        "free": figure.is_free,
        "points": figure.kind == "points",
        "mark": figure.mark if any(panel.marks for panel in figure.panels) else "",
    }


def line_data(line: Line) -> dict[str, object]:
    """Return a line with its numbers as base64 of little-endian float32."""
    x, y = (
        b64encode(np.asarray(each, dtype="<f4").tobytes()).decode() for each in (line.x, line.y)
    )
    return {"run": line.run, "x": x, "y": y}


def style_sheet() -> Markup:
    palette = template("palette.css")
    colors = palette.render(
        ink=INK,
        grid=GRID,
        reference=REFERENCE_COLOR,
        light_runs=[(style.color, style.tint) for style in RUN_STYLES],
        dark_runs=DARK_RUNS,
    )
    return Markup(colors + _asset("style.css"))


def script() -> Markup:
    """Return the page's program: no library, no network, nothing left in the global scope."""
    parts = "".join(_asset(name) for name in ("ticks.js", "chart.js", "page.js"))
    return Markup(f'"use strict";\n(() => {{\n{parts}}})();\n')


def template(name: str) -> Template:
    return _templates().get_template(name)


def _asset(name: str) -> str:
    return (files(__package__) / "assets" / name).read_text(encoding="utf-8")


@cache
def _templates() -> Environment:
    """Return the templates; whatever they print is made printable, and escaped."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_printable,
        keep_trailing_newline=True,
    )
    environment.filters["superscripts"] = _superscripts
    environment.filters["printed"] = printed_columns
    environment.globals["spoken"] = SPOKEN
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment


def _printable(value: object) -> object:
    return shown(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _superscripts(unit: str) -> Markup:
    """Return a unit with its powers raised."""
    return Markup(re.sub(r"\^([\d.]+)", r"<sup>\1</sup>", str(escape(shown(unit)))))


def _losses_warnings(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield one line for each run that lost something: its numbers are not the whole truth."""
    for run in runs:
        lost = {joint: loss for joint, loss in run.losses.items() if loss}
        if lost:
            unanswered = sum(loss.unanswered_states for loss in lost.values())
            repeated = sum(loss.repeated_commands for loss in lost.values())
            yield (
                f"{run.label} lost samples in {', '.join(lost)}: unanswered states {unanswered}, "
                f"repeated commands {repeated}; see Data."
            )


_BEGIN, _END = "<!-- animation -->", "<!-- end of animation -->"
"""Where it stands; no text of a recording can look like that, they are all escaped."""


def require_place(page: str) -> None:
    """Refuse a report that has no place for an animation."""
    if _END not in page.partition(_BEGIN)[2]:
        raise SeriesError("the report has no place for an animation: an earlier version wrote it")


def with_animation(page: str, moving: bytes, still: bytes, text: str) -> str:
    """Return a report with an animation below its answer, in the place of any that is there."""
    require_place(page)
    before, begin, rest = page.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    figure = template("animation.html").render(
        moving=b64encode(moving).decode(), still=b64encode(still).decode(), text=text
    )
    return f"{before}{begin}{figure}{end}{after}"

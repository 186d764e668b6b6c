"""The report of a comparison: one web page that needs nothing beside itself.

The answer stands first, then the table, the figures, what the controllers were set to, what
went missing, and where the numbers come from. Every text that is not this module's own is
escaped.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files

from hpid_ros.analysis.comparison import Comparison, answer
from hpid_ros.analysis.indices.task import EndEffectorPath
from hpid_ros.analysis.results import RunIndices
from hpid_ros.analysis.signals import Gains
from hpid_ros.base.foreign_text import html_text
from hpid_ros.recordings.series import RunSeries, SeriesError
from hpid_ros.report.figures.paths import path_data
from hpid_ros.report.figures.style import GRID, INK, REFERENCE, RUN_STYLES
from hpid_ros.report.html.data import Figure, figures_data, page_data
from hpid_ros.report.html.facts import (
    Parameters,
    data_quality,
    further_tables,
    index_table,
    legend,
    losses,
    norm_table,
    parameter_tables,
    provenance_table,
    retunes,
)

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

_LIGHT_VARIABLES = "".join(
    f"--run-{k}:{style.color};--tint-{k}:{style.tint};" for k, style in enumerate(RUN_STYLES)
)
_DARK_VARIABLES = "".join(
    f"--run-{k}:{color};--tint-{k}:{tint};" for k, (color, tint) in enumerate(DARK_RUNS)
)

_DARK = f"""
    --page: #14171c; --ink: #e6e9ee; --soft: #a2abb8; --line: #39404b; --panel: #1d2229;
    --grid: #2c323b; --reference: #5c6675; --better: #6fd198; --worse: #ff8f86;
    --selection: #6cb4ff44;
    {_DARK_VARIABLES}
"""

_PALETTE = f"""
:root {{
  color-scheme: light dark;
  --page: #ffffff; --ink: {INK}; --soft: #5b6472; --line: #d5d9e0; --panel: #f4f6f9;
  --grid: {GRID}; --reference: {REFERENCE}; --better: #14713d; --worse: #b3261e;
  --selection: #0b4a8f33;
  {_LIGHT_VARIABLES}
}}
@media screen and (prefers-color-scheme: dark) {{ :root:not([data-theme=light]) {{{_DARK}}} }}
@media screen {{ :root[data-theme=dark] {{{_DARK}}} }}
:root[data-theme=dark] {{ color-scheme: dark; }}
:root[data-theme=light] {{ color-scheme: light; }}
"""


def style_sheet() -> str:
    """Return the page's style sheet."""
    return _PALETTE + _asset("style.css")


def script() -> str:
    """Return the page's program: no library, no network, nothing left in the global scope."""
    parts = "".join(_asset(name) for name in ("ticks.js", "chart.js", "page.js"))
    return f'"use strict";\n(() => {{\n{parts}}})();\n'


def _asset(name: str) -> str:
    return (files(__package__) / "assets" / name).read_text(encoding="utf-8")


_UNKNOWN = "<p>The parameters of the controllers are not known.</p>"
_NO_RECORDING = "<p>The numbers were saved without their recordings.</p>"


def render_report(
    comparison: Comparison,
    runs: Sequence[RunSeries],
    provenance: Mapping[str, object],
    parameters: Parameters,
    *,
    warnings: Sequence[str] = (),
    repeats: Sequence[RunIndices] = (),
    gains: Gains | None = None,
    paths: Sequence[EndEffectorPath] = (),
) -> str:
    """Return the report as the text of an HTML file.

    Args:
        comparison: The numbers.
        runs: Recordings of the comparison's runs, in its order; some or all may be missing.
        provenance: Where they come from: versions, seed, hash, command; may be nested.
        parameters: What each controller was set to, by run, joint and parameter.
        warnings: What keeps the runs from being compared fairly, one line each.
        repeats: The single runs that the comparison's medians are of.
        gains: What the runs' laws did to their gains, of those for which it is known.
        paths: The paths of the end effector.

    Raises:
        SeriesError: If the runs are not those of the comparison.
    """
    labels = [run.label for run in comparison.runs]
    if [run.label for run in runs] != [x for x in labels if x in {run.label for run in runs}]:
        raise SeriesError(
            f"the report's runs are {', '.join(run.label for run in runs)}, but the comparison's "
            f"are {', '.join(labels)}"
        )
    others = " and ".join(labels[1:])
    title = f"{others} against {labels[0]}" if others else labels[0]
    figures = figures_data(runs, comparison, repeats, gains or {})
    if paths:
        figures.append(path_data(paths, labels))
    body = [
        f"<header><h1>{html_text(title)}</h1></header>",
        f'<p class="answer">{html_text(answer(comparison))}</p>',
        *(f'<p class="warning">{html_text(text)}</p>' for text in warnings),
        *_losses_warning(runs),
        "<h2>Indices</h2>",
        *([index_table(comparison)] if comparison.indices else []),
        *([norm_table(comparison)] if comparison.norms else []),
        legend(comparison),
    ]
    sections: dict[str, Iterable[str]] = {
        "Figures": _figures(figures),
        "All indices": further_tables(comparison),
        "Parameters": parameter_tables(parameters) if parameters else [_UNKNOWN],
        "Data": ["<h3>Losses</h3>", *losses(runs), *retunes(runs), *data_quality(runs)]
        if runs
        else [_NO_RECORDING],
        "Provenance": [provenance_table(provenance)],
    }
    for heading, parts in sections.items():
        name = heading.lower().replace(" ", "-")
        body += [f'<section id="{name}" data-tab="{heading}">', f"<h2>{heading}</h2>"]
        body += [*parts, "</section>"]
    return _page(title, "\n".join(body), page_data(figures, labels))


def _figures(figures: Sequence[Figure]) -> Iterator[str]:
    if not figures:
        yield _NO_RECORDING
        return
    yield "<noscript><p>The figures need JavaScript; the numbers do not.</p></noscript>"
    yield (
        '<p class="soft">Drag across a chart to zoom, double click for the whole. On a focused '
        "chart: arrows read values, shift and arrows move, + and − zoom, 0 shows the whole.</p>"
    )
    for figure in figures:
        yield (
            f'<figure id="{figure["name"]}">'
            f"<figcaption>{html_text(figure['caption'])}</figcaption></figure>"
        )


def _losses_warning(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield one line for each run that lost something: its numbers are not the whole truth."""
    for run in runs:
        lost = {joint: loss for joint, loss in run.losses.items() if loss}
        if lost:
            unanswered = sum(loss.unanswered_states for loss in lost.values())
            repeated = sum(loss.repeated_commands for loss in lost.values())
            text = (
                f"{run.label} lost samples in {', '.join(lost)}: unanswered states {unanswered}, "
                f"repeated commands {repeated}; see Data."
            )
            yield f'<p class="warning">{html_text(text)}</p>'


def _page(title: str, body: str, data: str) -> str:
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html_text(title)}</title>\n<style>{style_sheet()}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n"
        f'<script type="application/json" id="report-data">{data}</script>\n'
        f"<script>\n{script()}</script>\n</body>\n</html>\n"
    )

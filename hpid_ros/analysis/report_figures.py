"""The figures inside a web page: SVG that takes its colours from the page's style sheet."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import NamedTuple

from hpid_ros.analysis.plot_style import GRID, INK, REFERENCE, RUN_STYLES
from hpid_ros.analysis.plots import FIGURES, render
from hpid_ros.analysis.series import RunSeries

# A page is about as many pixels wide as this makes buckets across two panels.
BUCKETS = 400

CAPTIONS: Mapping[str, str] = {
    "positions": "Measured positions over the reference, joint by joint, in rad.",
    "efforts": "Efforts, joint by joint, in N m.",
    "errors": "Errors, reference minus measured position, joint by joint, in rad.",
    "effort_norm": "Euclidean norm of the effort over all joints, in N m.",
    "error_norm": "Euclidean norm of the error over all joints, in rad.",
}

# The variables that the style sheet defines for each theme, by the colour that is drawn.
COLOR_VARIABLES: Mapping[str, str] = {
    INK: "var(--ink)",
    GRID: "var(--grid)",
    REFERENCE: "var(--reference)",
    **{style.tint: f"var(--tint-{k})" for k, style in enumerate(RUN_STYLES)},
    **{style.color: f"var(--run-{k})" for k, style in enumerate(RUN_STYLES)},
}

_ID = re.compile(r' id="([^"]+)"')
_REFERENCE_TO_ID = re.compile(r'(url\(#|href="#)([^)"]+)')


class PageFigure(NamedTuple):
    """A figure for a page: its name, its caption and its markup."""

    name: str
    caption: str
    svg: str


def page_figures(runs: Sequence[RunSeries]) -> Iterator[PageFigure]:
    """Yield all figures of the runs, ready to stand in one page together.

    Args:
        runs: The runs, the baseline first.
    """
    labels = " and ".join(run.label for run in runs)
    for name, draw in FIGURES.items():
        markup = render(draw(runs, BUCKETS), "svg", transparent=True).decode()
        caption = CAPTIONS[name]
        alternative = f"{caption} Lines: {labels}, over {runs[0].duration:g} s."
        yield PageFigure(name, caption, _inline(markup, name, alternative))


def _inline(markup: str, name: str, alternative: str) -> str:
    """Return a file's SVG as an element of a page.

    Ids that something refers to get the figure's name in front, since a page has one space of
    ids; the others go. Colours become variables.
    """
    svg = markup[markup.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    used = {match[1] for match in _REFERENCE_TO_ID.findall(svg)}
    svg = _ID.sub(lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", svg)
    svg = _REFERENCE_TO_ID.sub(rf"\1{name}-\2", svg)
    for color, variable in COLOR_VARIABLES.items():
        svg = svg.replace(color, variable)
    head, rest = svg.split(">", maxsplit=1)
    head = re.sub(r' (width|height|xmlns:xlink|version)="[^"]*"', "", head)
    rest = rest.replace("xlink:href", "href")
    return f'{head} role="img" aria-label="{escape(alternative)}">{rest.rstrip()}'

"""The style sheet and the program of the report: files of ``assets``, with the runs' colours."""

from __future__ import annotations

from importlib.resources import files

from hpid_ros.report.figures.style import GRID, INK, REFERENCE, RUN_STYLES

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

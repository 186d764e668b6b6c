"""The report's page, and an animation put into one that exists.

The answer stands first, then the table, the figures, what the controllers were set to, what
went missing, and where the numbers come from. The markup is in ``templates/``, style and program
are in ``assets/``. Every text is escaped where a template puts it into the page, by Jinja2, so
that none can be forgotten; the exceptions are :func:`style_sheet` and :func:`script`, which hold
nothing of a recording.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from hpid_ros.base.text import shown
from hpid_ros.messages.series import RunSeries, SeriesError
from hpid_ros.metrics.comparison import Comparison, answer
from hpid_ros.metrics.measure import Parameters
from hpid_ros.metrics.quantities import Gains
from hpid_ros.metrics.results import RunIndices
from hpid_ros.report.blocks import (
    SPOKEN,
    Block,
    Heading,
    Paragraph,
    Properties,
    data_quality,
    further_tables,
    index_table,
    legend,
    losses,
    norm_table,
    parameter_tables,
    printed_columns,
    retunes,
)
from hpid_ros.report.figures import GRID, INK, REFERENCE, RUN_STYLES, Figure, Line, figures_of

if TYPE_CHECKING:
    from hpid_ros.metrics.task import EndEffectorPath

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
    gains: Gains | None = None,
    paths: Sequence[EndEffectorPath] = (),
) -> str:
    """Return the report as the text of an HTML file."""
    labels = [run.label for run in comparison.runs]
    if [run.label for run in runs] != [x for x in labels if x in {run.label for run in runs}]:
        raise SeriesError(
            f"the report's runs are {', '.join(run.label for run in runs)}, but the comparison's "
            f"are {', '.join(labels)}"
        )
    others = " and ".join(labels[1:])
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
            *([norm_table(comparison)] if comparison.norms else []),
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
    """Return a page as the text of an HTML file."""
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
    comparison: Comparison, runs: Sequence[RunSeries], *, gains: Gains | None = None, **more: Any
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
    """Return the page's style sheet."""
    palette = template("palette.css")
    colors = palette.render(
        ink=INK,
        grid=GRID,
        reference=REFERENCE,
        light_runs=[(style.color, style.tint) for style in RUN_STYLES],
        dark_runs=DARK_RUNS,
    )
    return Markup(colors + _asset("style.css"))


def script() -> Markup:
    """Return the page's program: no library, no network, nothing left in the global scope."""
    parts = "".join(_asset(name) for name in ("ticks.js", "chart.js", "page.js"))
    return Markup(f'"use strict";\n(() => {{\n{parts}}})();\n')


def template(name: str) -> Template:
    """Return one of the report's templates."""
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

"""Error against effort, one point a run: what each controller pays for its accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hpid_ros.analysis.comparison import Comparison
from hpid_ros.analysis.quantities import IAVC, ITAE, IVC, Quantity
from hpid_ros.analysis.results import RunIndices
from hpid_ros.base.foreign_text import figure_text
from hpid_ros.report.figures.panels import TICK_STEPS, add_legend, laid_out, plain_ticks
from hpid_ros.report.figures.style import (
    DOTS_PER_INCH,
    MARKERS,
    NORM_HEIGHT_IN,
    WIDTH_IN,
    RunStyle,
    figure_style,
    run_styles,
)
from hpid_ros.report.tables.table import heading_of

ERROR = ITAE
EFFORTS = (IVC, IAVC)
MARKER_SIZE = 8.0


def can_be_drawn(comparison: Comparison) -> bool:
    """Tell whether any run has both its error and its efforts."""
    return any(
        not any(math.isnan(run.value(quantity)) for quantity in (ERROR, *EFFORTS))
        for run in comparison.runs
    )


@figure_style()
def trade_off_figure(comparison: Comparison, repeats: Sequence[RunIndices] = ()) -> Figure:
    """Return the error over the effort's variation and over the effort spent.

    Medians carry bars from quartile to quartile; single repeats are small and hollow.
    """
    figure = Figure(figsize=(WIDTH_IN, NORM_HEIGHT_IN), dpi=DOTS_PER_INCH)
    styles = {
        run.label: (style, MARKERS[k % len(MARKERS)])
        for k, (run, style) in enumerate(zip(comparison.runs, run_styles(), strict=False))
    }
    for panel, effort in zip(figure.subplots(1, 2, sharey=True), EFFORTS, strict=True):
        for run in repeats:
            style, marker = styles[run.label]
            panel.plot(
                run.value(effort),
                run.value(ERROR),
                marker=marker,
                color=style.color,
                markerfacecolor="none",
                markersize=MARKER_SIZE / 2.0,
                linestyle="",
            )
        for run in comparison.runs:
            _draw_point(panel, run, effort, *styles[run.label])
        panel.margins(0.12)
        panel.set_xlabel(f"{effort.meaning}, {effort.symbol} [{comparison.unit(effort)}]")
        plain_ticks(panel.xaxis, MaxNLocator(6, steps=TICK_STEPS))
        plain_ticks(panel.yaxis, MaxNLocator(6, steps=TICK_STEPS))
    unit = comparison.unit(ERROR).replace("^2", "$^2$")
    figure.axes[0].set_ylabel(f"{ERROR.meaning}, {ERROR.symbol} [{unit}]")
    add_legend(
        figure,
        [_point(heading_of(run), *styles[run.label]) for run in comparison.runs],
    )
    return laid_out(figure)


def _draw_point(
    panel: Axes, run: RunIndices, effort: Quantity, style: RunStyle, marker: str
) -> None:
    x, y = run.value(effort), run.value(ERROR)
    if run.spread is not None:
        undefined = (math.nan, math.nan)
        quartiles = run.spread.quartiles[None]
        (left, right), (low, high) = (quartiles.get(q.key, undefined) for q in (effort, ERROR))
        if all(map(math.isfinite, (left, right, low, high))):
            panel.plot([left, right], [y, y], color=style.color, linewidth=style.width)
            panel.plot([x, x], [low, high], color=style.color, linewidth=style.width)
    panel.add_line(_point(run.label, style, marker, x, y))


def _point(
    label: str, style: RunStyle, marker: str, x: float | None = None, y: float | None = None
) -> Line2D:
    places = ([], []) if x is None or y is None else ([x], [y])
    return Line2D(
        *places,
        color=style.color,
        marker=marker,
        markersize=MARKER_SIZE,
        markeredgecolor="white",
        linestyle="",
        label=figure_text(label),
        zorder=4,
    )

"""What a search could trade: every point that it ran, and those that nothing beats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hpid_ros.analysis.panels import add_legend, laid_out
from hpid_ros.analysis.pareto import pareto_front
from hpid_ros.analysis.plot_style import (
    DOTS_PER_INCH,
    INK,
    MARKERS,
    NORM_HEIGHT_IN,
    WIDTH_IN,
    RunStyle,
    figure_style,
    run_styles,
)
from hpid_ros.analysis.quantities import ERROR_L2, IAVC, ITAE, IVC, Quantity
from hpid_ros.analysis.ratio_axis import ratio_ticks

PAIRS = ((IVC, ITAE), (IAVC, ITAE), (IVC, ERROR_L2))
"""What is drawn over what."""

SHOWN_UP_TO = 6.0
"""Points more than so many times worse than the baseline in either cost are left out."""


class SearchPoints(NamedTuple):
    """The points of one search.

    Attributes:
        label: Name of the search.
        ratios: Of each point, each index over the baseline's, by key.
        best: Place of the point that it chose; None if it chose none.
    """

    label: str
    ratios: Sequence[Mapping[str, float]]
    best: int | None


@figure_style()
def front_figure(searches: Sequence[SearchPoints], baseline: str = "PID") -> Figure:
    """Return the trade-offs of searches, as ratios to their baseline.

    Args:
        searches: With one and the same baseline.
        baseline: Its name.
    """
    figure = Figure(figsize=(WIDTH_IN, NORM_HEIGHT_IN), dpi=DOTS_PER_INCH)
    looks = [
        (search, style, MARKERS[k % len(MARKERS)])
        for k, (search, style) in enumerate(zip(searches, run_styles(), strict=False))
    ]
    for panel, (across, up) in zip(figure.subplots(1, len(PAIRS)), PAIRS, strict=True):
        panel.set(xscale="log", yscale="log")
        panel.plot(1.0, 1.0, marker="+", color=INK, markersize=11, linestyle="", zorder=5)
        for search, style, marker in looks:
            _draw(panel, search, (across, up), style, marker)
        panel.margins(0.06)
        for axis, quantity in ((panel.xaxis, across), (panel.yaxis, up)):
            axis.set_label_text(f"{quantity.symbol} / {quantity.symbol} of {baseline}")
            ratio_ticks(axis)
    handles = [
        Line2D([], [], color=style.color, marker=marker, markeredgecolor="white", label=each.label)
        for each, style, marker in looks
    ]
    base = Line2D([], [], color=INK, marker="+", markersize=9, linestyle="", label=baseline)
    add_legend(figure, [base, *handles])
    return laid_out(figure)


def _draw(
    panel: Axes,
    search: SearchPoints,
    pair: tuple[Quantity, Quantity],
    style: RunStyle,
    marker: str,
) -> None:
    """Draw all points of a search faintly, its front as steps, its choice large."""
    every = [(each[pair[0].key], each[pair[1].key]) for each in search.ratios]
    shown = [point for point in every if max(point) <= SHOWN_UP_TO and min(point) > 0.0]
    if shown:
        x, y = zip(*shown, strict=True)
        panel.plot(x, y, ".", color=style.color, alpha=0.3, markersize=4, zorder=1)
    front = [shown[k] for k in pareto_front(shown)]
    if front:
        x, y = zip(*front, strict=True)
        panel.step(x, y, where="post", color=style.color, linewidth=style.width, zorder=3)
    if search.best is not None:
        panel.plot(
            *every[search.best],
            marker=marker,
            color=style.color,
            markeredgecolor="white",
            markersize=9,
            zorder=6,
        )

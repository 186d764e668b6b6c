"""Figures of studies and searches: every index over the baseline's, and what nothing beats."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hpid_ros.metrics.quantities import EFFORT_L2, ERROR_L2, IAVC, ITAE, IVC, OVERSHOOT, Quantity
from hpid_ros.report.panels import add_legend, laid_out
from hpid_ros.report.style import (
    DOTS_PER_INCH,
    INK,
    MARKERS,
    NORM_HEIGHT_IN,
    WIDTH_IN,
    RunStyle,
    figure_style,
    ratio_ticks,
    run_styles,
)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the places of the points that no other point beats in both costs.

    Of equal points the first is there; one that is not finite is not.
    """
    finite = [k for k, point in enumerate(points) if all(map(math.isfinite, point))]
    front: list[int] = []
    least = math.inf
    for place in sorted(finite, key=lambda k: points[k]):
        if points[place][1] < least:
            front.append(place)
            least = points[place][1]
    return front


PAIRS = ((IVC, ITAE), (IAVC, ITAE), (IVC, ERROR_L2))
"""What is drawn over what."""

SHOWN_UP_TO = 6.0
"""Points more than so many times worse than the baseline in either cost are left out."""


class SearchPoints(NamedTuple):
    """The points of one search."""

    label: str  # name of the search
    ratios: Sequence[Mapping[str, float]]  # of each point, each index over the baseline's, by key
    best: int | None  # place of the point that it chose; None if it chose none


@figure_style()
def front_figure(searches: Sequence[SearchPoints], baseline: str = "PID") -> Figure:
    """Return the trade-offs of searches, as ratios to their baseline."""
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


SHOWN = (IVC, IAVC, EFFORT_L2, ITAE, ERROR_L2, OVERSHOOT)
PAPER: Mapping[str, float] = {"ivc": 0.575, "iavc": 0.79, "effort_l2": 0.777, "itae": 0.947}
"""What the paper's Table I has, over its PID."""

_ROW_HEIGHT_IN, _MARGIN_IN = 0.32, 1.6
_SPACE = 0.6  # of a row, for all its controllers


@figure_style()
def ratio_figure(study: Mapping[str, Any]) -> Figure:
    """Return medians with bars from quartile to quartile, one panel an index."""
    experiments: Mapping[str, Any] = study["experiments"]
    labels = _labels(experiments)
    looks = {
        label: (style, MARKERS[k % len(MARKERS)])
        for k, (label, style) in enumerate(zip(labels, run_styles(), strict=False))
    }
    height = 2.0 * (_MARGIN_IN + _ROW_HEIGHT_IN * len(experiments))
    figure = Figure(figsize=(WIDTH_IN, height), dpi=DOTS_PER_INCH)
    panels = figure.subplots(2, 3, sharey=True).flat
    for panel, quantity in zip(panels, SHOWN, strict=True):
        panel.axvline(1.0, color=INK, linewidth=0.8)
        if quantity.key in PAPER:
            panel.axvline(PAPER[quantity.key], color=INK, linewidth=0.8, dashes=(2.0, 2.0))
        for row, experiment in enumerate(experiments.values()):
            _draw_row(panel, row, experiment["controllers"], quantity, labels, looks)
        _label(panel, quantity, list(experiments))
    handles = [_point(style, marker, label) for label, (style, marker) in looks.items()]
    paper = Line2D([], [], color=INK, linewidth=0.8, dashes=(2.0, 2.0), label="the paper")
    add_legend(figure, [*handles, paper])
    return laid_out(figure)


def _labels(experiments: Mapping[str, Any]) -> list[str]:
    """Return the labels of all controllers but the baselines, in their order."""
    found: dict[str, None] = {}
    for experiment in experiments.values():
        others = [name for name in experiment["controllers"] if name != experiment["baseline"]]
        found |= dict.fromkeys(others)
    return list(found)


def _draw_row(
    panel: Axes,
    row: int,
    controllers: Mapping[str, Any],
    quantity: Quantity,
    labels: Sequence[str],
    looks: Mapping[str, tuple[RunStyle, str]],
) -> None:
    step = _SPACE / len(labels)
    for place, label in enumerate(labels):
        ratios = controllers.get(label, {}).get("ratios", {}).get(quantity.key)
        if ratios is None or not ratios["median"]:
            continue  # it has none, or one over zero
        style, marker = looks[label]
        y = row + (place - 0.5 * (len(labels) - 1)) * step
        low, middle, high = (ratios[name] for name in ("first", "median", "third"))
        panel.plot([low, high], [y, y], color=style.color, linewidth=2.5, alpha=0.5)
        panel.add_line(_point(style, marker, label, middle, y))


def _label(panel: Axes, quantity: Quantity, names: Sequence[str]) -> None:
    panel.set_xscale("log")
    panel.set_title(f"{quantity.symbol}, {quantity.meaning}")
    panel.set_ylim(len(names) - 0.5, -0.5)
    panel.set_yticks(range(len(names)), names)
    panel.grid(axis="y", visible=False)
    panel.margins(x=0.08)
    low, high = panel.get_xlim()
    panel.set_xlim(min(low, 0.5), max(high, 1.25))
    ratio_ticks(panel.xaxis)
    panel.set_xlabel("over the PID's")


def _point(
    style: RunStyle, marker: str, label: str, x: float | None = None, y: float | None = None
) -> Line2D:
    places = ([], []) if x is None or y is None else ([x], [y])
    return Line2D(
        *places,
        color=style.color,
        marker=marker,
        markersize=6.5,
        markeredgecolor="white",
        linestyle="",
        label=label,
        zorder=4,
    )

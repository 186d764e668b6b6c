"""Phase portraits, and error against effort, one point a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hpid_ros.base.text import figure_text
from hpid_ros.base.units import Numbers
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.indices import amplitude_density
from hpid_ros.metrics.quantities import IAVC, ITAE, IVC, Quantity
from hpid_ros.metrics.results import DEFAULT_CUTOFF, RunIndices
from hpid_ros.report.panels import (
    TICK_STEPS,
    add_legend,
    joint_names,
    laid_out,
    log_ticks,
    panel_grid,
    plain_ticks,
    run_handles,
    series_of,
    styled_line,
)
from hpid_ros.report.style import (
    DOTS_PER_INCH,
    INK,
    MARKERS,
    NORM_HEIGHT_IN,
    WIDTH_IN,
    JointUnits,
    RunStyle,
    figure_style,
    run_styles,
)
from hpid_ros.report.table import heading_of

RATE_WINDOW = 0.025
"""Time over which the error's rate is fitted, in [s]."""


LEAST_JUMP = 1e-3
"""Lower jumps of a reference are not told from its own resolution, in [rad]."""
JUMP_RATIO = 10.0
"""A reference jumps where it moves so many times further than in the periods before and after."""


class PhaseCurve(NamedTuple):
    """Error in [rad] and error rate in [rad/s] of a joint, (N,) each.

    The rate is NaN where the curve is torn: from one side of a jump of the reference to the other
    no joint has moved.
    """

    error: Numbers
    rate: Numbers


def phase_curve(series: JointSeries, points: int) -> PhaseCurve:
    """Return a joint's error and the rate of its error; nothing without a reference.

    The rate is the slope of a parabola fitted over 25 ms, since a bare difference of encoder
    counts would hide everything. A jump of the reference is in no fit.
    """
    if not series.has_reference:
        return PhaseCurve(np.empty(0), np.empty(0))
    t, error = series.time, series.error
    stride = max(1, -(-error.size // points))
    if error.size < 4 or t[-1] <= t[0]:
        return PhaseCurve(error[::stride], np.zeros_like(error[::stride]))
    smooth, rate = np.empty_like(error), np.empty_like(error)
    jumps = _jumps(series.reference)
    for first, stop in pairwise((0, *jumps, error.size)):
        smooth[first:stop], rate[first:stop] = _fitted(t[first:stop], error[first:stop])
    torn = {(at - 1) // stride for at in jumps}  # the last one shown before a jump
    smooth, rate = smooth[::stride], rate[::stride]
    rate[list(torn)] = np.nan
    return PhaseCurve(smooth, rate)


def _jumps(reference: Numbers) -> list[int]:
    """Return the first samples after the jumps of a reference."""
    moved = np.abs(np.diff(reference))
    beside = np.zeros_like(moved)
    beside[1:] = moved[:-1]
    beside[:-1] = np.maximum(beside[:-1], moved[1:])
    found = (moved >= LEAST_JUMP) & (moved > JUMP_RATIO * beside)
    return [int(at) + 1 for at in np.flatnonzero(found)]


def _fitted(t: Numbers, error: Numbers) -> tuple[Numbers, Numbers]:
    """Return an error and its rate, each smoothed over :data:`RATE_WINDOW`."""
    if error.size < 4 or t[-1] <= t[0]:
        return error, np.full_like(error, np.nan)
    from scipy.signal import savgol_filter  # slow to import, and only needed here

    period = float(t[-1] - t[0]) / (error.size - 1)
    half = max(1, min(round(0.5 * RATE_WINDOW / period), (error.size - 1) // 2))
    even = np.interp(np.linspace(t[0], t[-1], error.size), t, error)
    rate = savgol_filter(even, 2 * half + 1, min(2, 2 * half), deriv=1, delta=period)
    return savgol_filter(even, 2 * half + 1, min(2, 2 * half)), rate


DECADES_AT_MOST = 6.0


def spectrum_panels(runs: Sequence[RunSeries], cutoff: float = DEFAULT_CUTOFF) -> Figure:
    """Return the amplitude spectral density of the effort, one panel a joint, both axes log."""
    names = joint_names(runs)
    units, unit = JointUnits.of(runs), "N m / Hz$^{0.5}$"
    label = f"effort density [{units.over_all(unit)}]"
    figure, panels = panel_grid(names, "frequency [Hz]", label, suffixes=units.suffixes(unit))
    for name, panel in zip(names, panels, strict=True):
        panel.set_xscale("log")
        panel.set_yscale("log")
        highest = 0.0
        for series, style in zip(series_of(runs, name), run_styles(), strict=False):
            found = amplitude_density(series)
            if found is None:
                continue
            highest = max(highest, float(found.density.max(initial=0.0)))
            line = styled_line(style)
            line.set_data(found.frequency, found.density)
            panel.add_line(line)
        panel.axvline(cutoff, color=INK, linewidth=0.9, linestyle=":")
        panel.autoscale_view()
        if highest:
            low, high = panel.get_ylim()
            panel.set_ylim(max(low, high * 10.0**-DECADES_AT_MOST), high)
    for panel in panels:
        log_ticks(panel.xaxis)
        log_ticks(panel.yaxis)
    handles = run_handles([figure_text(run.label) for run in runs])
    mark = f"chatter above {cutoff:g} Hz"
    handles.append(Line2D([], [], color=INK, linewidth=0.9, linestyle=":", label=mark))
    add_legend(figure, handles)
    return laid_out(figure)


def phase_panels(runs: Sequence[RunSeries], points: int) -> Figure:
    """Return error rate over error, one panel a joint, each with ranges of its own."""
    names = joint_names(runs)
    units = JointUnits.of(runs)
    figure, panels = panel_grid(
        names,
        f"error [{units.over_all('rad')}]",
        f"error rate [{units.over_all('rad/s')}]",
        shares_x=False,
        suffixes=units.suffixes("rad, rad/s"),
    )
    for name, panel in zip(names, panels, strict=True):
        panel.axhline(0.0, color=INK, linewidth=0.5)
        panel.axvline(0.0, color=INK, linewidth=0.5)
        for series, style in zip(series_of(runs, name), run_styles(), strict=False):
            line = styled_line(style)
            line.set_data(*phase_curve(series, points))
            line.set_linewidth(0.9)
            panel.add_line(line)
        panel.margins(0.05)
        panel.autoscale_view()
        plain_ticks(panel.xaxis, MaxNLocator(7, steps=TICK_STEPS))
        plain_ticks(panel.yaxis, MaxNLocator(5, steps=TICK_STEPS))
    add_legend(figure, run_handles([figure_text(run.label) for run in runs]))
    return laid_out(figure)


ERROR = ITAE
EFFORTS = (IVC, IAVC)
MARKER_SIZE = 8.0


def can_be_drawn(comparison: Comparison) -> bool:
    """Return whether any run has both its error and its efforts."""
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

"""The figures drawn by matplotlib, for print: their look, and what is drawn.

Through its objects only: no pyplot, no figure that outlives its function, and the same bytes for
the same runs.
"""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from typing import Any, NamedTuple

import matplotlib
import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Drawing
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import (
    FixedLocator,
    Formatter,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
)

from hpid_bench.report.figures import (
    BACKGROUND,
    GRID,
    INK,
    NO_RUN,
    REFERENCE_COLOR,
    RUN_STYLES,
    Figure,
    Line,
    Panel,
    RunStyle,
)
from hpid_ros.base.text import figure_text
from hpid_ros.metrics.indices import total_variation
from hpid_ros.metrics.quantities import ERROR_L2, IAVC, ITAE, IVC, Quantity

DOTS_PER_INCH = 150
WIDTH_IN = 10.0
PANEL_HEIGHT_IN = 1.75
NORM_HEIGHT_IN = 4.0
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")

_RC = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 9,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.xmargin": 0.0,
    "figure.constrained_layout.use": False,
    "figure.labelsize": 10,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.fontsize": 9.5,
    "legend.frameon": False,
    "legend.handlelength": 3.2,
    "lines.scale_dashes": False,
    "pdf.fonttype": 42,
    "savefig.facecolor": BACKGROUND,
    "svg.fonttype": "none",
    "svg.hashsalt": "hpid_ros",
    "text.color": INK,
    "xtick.color": INK,
    "xtick.labelsize": 8.5,
    "ytick.color": INK,
    "ytick.labelsize": 8.5,
}


@contextmanager
def figure_style() -> Iterator[None]:
    """Apply this look within a ``with`` block, whatever the user's matplotlibrc says."""
    with matplotlib.style.context(["default", _RC]):
        yield


_WIDE, _NARROW = 12.0, 3.0
_SETS = {
    "few": (1.0, 2.0, 5.0),
    "some": (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
    "many": (1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0),
}


def ratio_ticks(axis: Axis) -> None:
    """Put ticks at round ratios within the axis's present limits."""
    low, high = sorted(axis.get_view_interval())
    span = high / low
    parts = _SETS["few" if span > _WIDE else "some" if span > _NARROW else "many"]
    decades = [10.0**power for power in range(-6, 7)]
    axis.set_major_locator(FixedLocator([decade * part for decade in decades for part in parts]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))


# Beyond these, zeros would crowd out the digits.
SMALLEST_PLAIN_TICK, LARGEST_PLAIN_TICK = 1e-4, 1e7
MOST_DECIMALS = 9


class TickLabels(Formatter):
    """As many decimals as tell the ticks of one axis apart, the same for all of them.

    matplotlib's own formatter would write an offset or a power of ten above the axis, where
    the joint's name is.
    """

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of one place, as for a cursor."""
        return _readable(f"{x:.9g}")

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        largest = max((abs(value) for value in values), default=0.0)
        step = min((abs(b - a) for a, b in itertools.pairwise(values)), default=largest)
        if step <= 0.0:
            return [self(value) for value in values]
        if SMALLEST_PLAIN_TICK <= largest < LARGEST_PLAIN_TICK:
            decimals = next(
                (d for d in range(MOST_DECIMALS) if abs(round(step, d) - step) < 1e-3 * step),
                MOST_DECIMALS,
            )
            return [_readable(f"{round(value, decimals) + 0.0:.{decimals}f}") for value in values]
        digits = math.ceil(math.log10(largest / step)) + 2
        # A tick at zero is rounding noise of the ones beside it.
        exact = [0.0 if abs(value) < 1e-6 * step else value for value in values]
        return [_readable(f"{value:.{digits}g}") for value in exact]


def _readable(text: str) -> str:
    return text.replace("e-0", "e-").replace("e+0", "e").replace("-", "−")


TICK_STEPS = (1, 2, 2.5, 5, 10)
PLAIN_DECADES = 2.0  # below, powers of ten are too few to read a logarithmic axis by


def plain_ticks(axis: Axis, most: int, *, are_whole: bool = False) -> None:
    """Give an axis ticks whose numbers stand for themselves."""
    axis.set_major_locator(MaxNLocator(most, steps=TICK_STEPS, integer=are_whole))
    axis.set_major_formatter(TickLabels())


def log_ticks(axis: Axis) -> None:
    """Give a logarithmic axis whose limits are final labelled ticks, however short it is."""
    low, high = sorted(axis.get_view_interval())
    if low <= 0.0:
        return  # nothing is drawn
    if math.log10(high / low) >= PLAIN_DECADES:
        axis.set_major_locator(LogLocator(10.0, numticks=6))
        axis.set_minor_locator(LogLocator(10.0, subs=range(2, 10), numticks=99))
        axis.set_minor_formatter(NullFormatter())
        return
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [m * 10.0**k for k in exponents for m in (1, 2, 5) if low <= m * 10.0**k <= high]
    locator = FixedLocator(ticks) if len(ticks) > 1 else MaxNLocator(4, steps=TICK_STEPS)
    axis.set_major_locator(locator)
    axis.set_major_formatter(TickLabels())
    axis.set_minor_locator(NullLocator())


# Width of a legend's character, and of a line with the air around it.
_CHARACTER_IN, _HANDLE_IN = 0.085, 0.85
_LEGEND_ROW_IN, _LEGEND_PAD_IN = 0.21, 0.13


def add_legend(drawing: Drawing, handles: Sequence[Line2D], columns_at_most: int = 8) -> None:
    """Put one legend above all panels, in as many columns as the width has room for."""
    widest = max(len(str(handle.get_label())) for handle in handles)
    room = int((WIDTH_IN - 0.4) / (_HANDLE_IN + _CHARACTER_IN * widest))
    columns = max(1, min(columns_at_most, len(handles), room))
    legend_outside(drawing, handles, "upper", columns)


def legend_outside(drawing: Drawing, handles: Sequence[Line2D], edge: str, columns: int) -> None:
    """Put a legend above (``edge`` is ``upper``) or below (``lower``) all panels, and beside none.

    Matplotlib before 3.7, and Ubuntu 24.04 has 3.6, keeps no room for it: there we do.
    """
    what: dict[str, Any] = {"handles": list(handles), "ncols": columns}
    try:
        drawing.legend(**what, **{"loc": f"outside {edge} center"})
    except ValueError:
        drawing.legend(**what, **{"loc": f"{edge} center"})
        rows = math.ceil(len(handles) / columns)
        share = (rows * _LEGEND_ROW_IN + _LEGEND_PAD_IN) / drawing.get_figheight()
        bottom = share if edge == "lower" else 0.0
        drawing.set_layout_engine(ConstrainedLayoutEngine(rect=(0.0, bottom, 1.0, 1.0 - share)))


def laid_out(drawing: Drawing) -> Drawing:
    """Fix the layout, so that all formats share one and it is computed once."""
    engine = drawing.get_layout_engine() or ConstrainedLayoutEngine()
    engine.execute(drawing)
    drawing.set_layout_engine("none")
    return drawing


def styled_line(style: RunStyle) -> Line2D:
    line = Line2D([], [], color=style.color, linewidth=style.width)
    if style.dashes is not None:
        line.set(linestyle=(0, style.dashes), gapcolor=style.tint, dash_capstyle="butt")
    return line


DECADES_AT_MOST = 6.0  # of a spectrum
MARKER_SIZE = 8.0
_PATH_HEIGHT_IN = 5.2
_MARGINS = {"curves": 0.05, "path": 0.06, "points": 0.12}  # around what is drawn, over its size

# Dates and versions would make two files of the same run differ.
_METADATA: Mapping[str, dict[str, Any]] = {
    "png": {"Software": None},
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
}


@figure_style()
def drawing_bytes(drawing: Drawing, form: str, transparent: bool = False) -> bytes:
    """Return a drawing as the bytes of a file; the same one gives the same bytes."""
    buffer = io.BytesIO()
    drawing.savefig(
        buffer, format=form, dpi=DOTS_PER_INCH, metadata=_METADATA[form], transparent=transparent
    )
    return buffer.getvalue()


@figure_style()
def drawn(figure: Figure, labels: Sequence[str]) -> Drawing:
    """Return a figure as matplotlib draws it; the labels are those of all runs."""
    count, is_time_like = len(figure.panels), not figure.is_free
    # Wide panels while they fit on a page.
    columns = 2 if 3 < count <= 12 or figure.kind in ("path", "points") else 1 if count < 4 else 3
    rows = math.ceil(count / columns)
    height = 0.8 + PANEL_HEIGHT_IN * rows if count > 1 else NORM_HEIGHT_IN
    height = {"path": _PATH_HEIGHT_IN, "points": NORM_HEIGHT_IN}.get(figure.kind, height)
    drawing = Drawing(figsize=(WIDTH_IN, height), dpi=DOTS_PER_INCH)
    axes = drawing.subplots(
        rows, columns, sharex=is_time_like, sharey=figure.kind == "points", squeeze=False
    ).flat
    for k, (panel, place) in enumerate(zip(figure.panels, axes[:count], strict=True)):
        draw_panel(place, figure, panel)
        # The last panel of each column carries the labels, also where the last row has gaps.
        place.tick_params(labelbottom=not is_time_like or k + columns >= count)
    for place in axes[count:]:
        place.set_visible(False)
    drawing.supxlabel(_with_powers(figure.x))
    drawing.supylabel(_with_powers(figure.y))
    handles = _handles(figure, labels)
    add_legend(drawing, handles, columns_at_most=2 if figure.labels and is_time_like else 8)
    return laid_out(drawing)


def draw_panel(place: Axes, figure: Figure, panel: Panel) -> None:
    place.set_title(figure_text(panel.title))
    place.set(xlabel=_with_powers(panel.x), ylabel=_with_powers(panel.y))
    if figure.kind == "frequency":
        place.set_xscale("log")
    if figure.y_log:
        place.set_yscale("log")
    if panel.level is not None:
        place.axhline(panel.level, color=INK, linewidth=0.5)
        if figure.is_free:
            place.axvline(panel.level, color=INK, linewidth=0.5)
    # The calmest on top, so that none is hidden.
    order = (lambda line: 0.0) if figure.is_free else (lambda line: -total_variation(line.y))
    for k, line in enumerate(sorted(panel.lines, key=order)):
        artist = _artist(figure, line)
        artist.set_data(line.x, line.y)
        artist.set_zorder(2 if line.run == NO_RUN else 3 + k)
        place.add_line(artist)
    for run, x in panel.marks:
        color = INK if run == NO_RUN else _style(run).color
        place.axvline(x, color=color, linewidth=0.9, linestyle=":", zorder=2)
    if figure.is_free:
        place.margins(_MARGINS[figure.kind])
    place.autoscale_view()
    if figure.kind == "path":
        place.set_aspect("equal", adjustable="datalim")
    _set_limits_and_ticks(place, figure, panel)


def _set_limits_and_ticks(place: Axes, figure: Figure, panel: Panel) -> None:
    if figure.kind == "time":
        most = max((float(each.x[-1]) for each in panel.lines if each.x.size), default=0.0)
        plain_ticks(place.xaxis, 10, are_whole=most >= 5.0)
    elif figure.kind == "frequency":
        highest = max((float(each.y.max(initial=0.0)) for each in panel.lines), default=0.0)
        if highest:
            low, high = place.get_ylim()
            place.set_ylim(max(low, high * 10.0**-DECADES_AT_MOST), high)
        log_ticks(place.xaxis)
    else:
        plain_ticks(place.xaxis, 7 if figure.kind == "curves" else 6)
    if figure.y_log:
        log_ticks(place.yaxis)
    else:
        plain_ticks(place.yaxis, 6 if figure.kind in ("path", "points") else 5)
    if len(figure.panels) == 1 and figure.labels:  # a norm
        place.set_ylim(bottom=0.0)


def _style(run: int) -> RunStyle:
    return RUN_STYLES[run % len(RUN_STYLES)]


def _artist(figure: Figure, line: Line) -> Line2D:
    """Return an empty line that looks like one of a figure's."""
    if line.run == NO_RUN:
        if figure.kind == "path":
            return Line2D([], [], color=REFERENCE_COLOR, linewidth=3.2, solid_capstyle="round")
        return Line2D([], [], color=REFERENCE_COLOR, linewidth=4.0, solid_capstyle="butt")
    style = _style(line.run)
    if figure.kind != "points":
        artist = styled_line(style)
        if figure.kind == "curves":
            artist.set_linewidth(0.9)
        return artist
    if len(line.x) > 1:
        return Line2D([], [], color=style.color, linewidth=style.width)
    artist = Line2D([], [], color=style.color, marker=MARKERS[line.run % len(MARKERS)])
    artist.set(linestyle="", markersize=MARKER_SIZE, markeredgecolor="white")
    if line.is_repeat:
        artist.set(markersize=MARKER_SIZE / 2.0, markeredgecolor=style.color)
        artist.set_markerfacecolor("none")
    return artist


def _handles(figure: Figure, labels: Sequence[str]) -> list[Line2D]:
    """Return the legend's lines: the runs in order, the reference, the marks."""
    last = {line.run: line for panel in figure.panels for line in panel.lines}  # no repeat
    handles = []
    for run in sorted(last, key=lambda run: (run == NO_RUN, run)):
        handle = _artist(figure, last[run])
        if run == NO_RUN:
            handle.set_label("reference")
        elif run in figure.labels:
            handle.set_label(_with_powers(figure.labels[run]))
        else:
            handle.set_label(figure_text(labels[run]))
        if run != NO_RUN and figure.kind != "points":
            handle.set_linewidth(_style(run).width + 0.5)
        handles.append(handle)
    if any(panel.marks for panel in figure.panels):
        handles.append(Line2D([], [], color=INK, linewidth=0.9, ls=":", label=figure.mark))
    return handles


def _with_powers(text: str) -> str:
    return re.sub(r"\^([\d.]+)", r"$^{\1}$", figure_text(text))


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the places of the finite points that no other beats in both costs, of equals one."""
    finite = [k for k, point in enumerate(points) if all(map(math.isfinite, point))]
    front: list[int] = []
    least = math.inf
    for place in sorted(finite, key=lambda k: points[k]):
        if points[place][1] < least:
            front.append(place)
            least = points[place][1]
    return front


PAIRS = ((IVC, ITAE), (IAVC, ITAE), (IVC, ERROR_L2))  # what is drawn over what

SHOWN_UP_TO = 6.0  # points so many times worse than the baseline in either cost are left out


class SearchPoints(NamedTuple):
    label: str  # name of the search
    ratios: Sequence[Mapping[str, float]]  # of each point, each index over the baseline's, by key
    best: int | None  # place of the point that it chose; None if it chose none


@figure_style()
def front_figure(searches: Sequence[SearchPoints], baseline: str = "PID") -> Drawing:
    """Return the trade-offs of searches, as ratios to their baseline."""
    figure = Drawing(figsize=(WIDTH_IN, NORM_HEIGHT_IN), dpi=DOTS_PER_INCH)
    looks = [
        (search, style, MARKERS[k % len(MARKERS)])
        for k, (search, style) in enumerate(zip(searches, cycle(RUN_STYLES), strict=False))
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

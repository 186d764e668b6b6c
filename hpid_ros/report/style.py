"""The look of the printed figures: fonts, sizes, ticks, legends."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import matplotlib.style
from matplotlib.axis import Axis
from matplotlib.figure import Figure
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

from hpid_ros.report.figures import GRID, INK, PAPER, RunStyle

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
    "savefig.facecolor": PAPER,
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
SMALLEST_PLAIN, LARGEST_PLAIN = 1e-4, 1e7
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
        """Return the labels of all ticks of an axis."""
        largest = max((abs(value) for value in values), default=0.0)
        step = min((abs(b - a) for a, b in itertools.pairwise(values)), default=largest)
        if step <= 0.0:
            return [self(value) for value in values]
        if SMALLEST_PLAIN <= largest < LARGEST_PLAIN:
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


def add_legend(figure: Figure, handles: Sequence[Line2D], columns_at_most: int = 8) -> None:
    """Put one legend above all panels, in as many columns as the width has room for."""
    widest = max(len(str(handle.get_label())) for handle in handles)
    room = int((WIDTH_IN - 0.4) / (_HANDLE_IN + _CHARACTER_IN * widest))
    columns = max(1, min(columns_at_most, len(handles), room))
    legend_outside(figure, handles, "upper", columns)


def legend_outside(figure: Figure, handles: Sequence[Line2D], edge: str, columns: int) -> None:
    """Put a legend above (``edge`` is ``upper``) or below (``lower``) all panels, and beside none.

    Matplotlib before 3.7, and Ubuntu 24.04 has 3.6, keeps no room for it: there we do.
    """
    what: dict[str, Any] = {"handles": list(handles), "ncols": columns}
    try:
        figure.legend(**what, **{"loc": f"outside {edge} center"})
    except ValueError:
        figure.legend(**what, **{"loc": f"{edge} center"})
        rows = math.ceil(len(handles) / columns)
        share = (rows * _LEGEND_ROW_IN + _LEGEND_PAD_IN) / figure.get_figheight()
        bottom = share if edge == "lower" else 0.0
        figure.set_layout_engine(ConstrainedLayoutEngine(rect=(0.0, bottom, 1.0, 1.0 - share)))


def laid_out(figure: Figure) -> Figure:
    """Fix the layout, so that all formats share one and it is computed once."""
    engine = figure.get_layout_engine() or ConstrainedLayoutEngine()
    engine.execute(figure)
    figure.set_layout_engine("none")
    return figure


def styled_line(style: RunStyle) -> Line2D:
    """Return an empty line of a run's style."""
    line = Line2D([], [], color=style.color, linewidth=style.width)
    if style.dashes is not None:
        line.set(linestyle=(0, style.dashes), gapcolor=style.tint, dash_capstyle="butt")
    return line

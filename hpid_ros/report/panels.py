"""The layout of runs on a figure: one panel a joint, or one panel for all of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import (
    FixedLocator,
    Formatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
)

from hpid_ros.base.text import figure_text
from hpid_ros.messages.series import JointSeries, RunSeries, SeriesError, seconds_since
from hpid_ros.metrics.indices import total_variation
from hpid_ros.metrics.quantities import Signal, envelope
from hpid_ros.report.style import (
    DOTS_PER_INCH,
    INK,
    NORM_HEIGHT_IN,
    PANEL_HEIGHT_IN,
    REFERENCE,
    WIDTH_IN,
    JointUnits,
    RunStyle,
    run_styles,
)

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


TIME_LABEL = "time [s]"
REFERENCE_LABEL = "reference"
RETUNE_LABEL = "retuned"
TICK_STEPS = (1, 2, 2.5, 5, 10)
PLAIN_DECADES = 2.0
"""Below so many decades powers of ten are too few to read a logarithmic axis by."""
# Width of a legend's character, and of a line with the air around it.
CHARACTER_IN, HANDLE_IN = 0.085, 0.85

SignalOf = Callable[[RunSeries, JointSeries], Signal]


def joint_panels(
    runs: Sequence[RunSeries],
    label: str,
    unit: str,
    signal_of: SignalOf,
    buckets: int,
    reference_of: SignalOf | None = None,
    level: float | None = 0.0,
    is_log: bool = False,
) -> Figure:
    """Return a figure with one panel a joint, the joints' names above, one legend for all."""
    names = joint_names(runs)
    units = JointUnits.of(runs)
    if unit:
        label = f"{label} [{units.over_all(unit)}]"
    suffixes = units.suffixes(unit) if unit else ()
    figure, panels = panel_grid(names, TIME_LABEL, label, suffixes=suffixes)
    for name, panel in zip(names, panels, strict=True):
        series = series_of(runs, name)
        if reference_of is not None:
            _draw_reference(panel, runs[0], reference_of(runs[0], series[0]), buckets)
        elif level is not None:
            panel.axhline(level, color=INK, linewidth=0.5)
        signals = [signal_of(run, joint) for run, joint in zip(runs, series, strict=True)]
        draw_runs(panel, runs, signals, buckets)
        if is_log:
            panel.set_yscale("log")
            log_ticks(panel.yaxis)
    handles = run_handles([figure_text(run.label) for run in runs])
    if reference_of is not None:
        handles.append(_reference_line(REFERENCE_LABEL))
    if any(run.retunes for run in runs):
        handles.append(_retune_line())
    add_legend(figure, handles)
    return laid_out(figure)


def single_panel(
    runs: Sequence[RunSeries],
    label: str,
    signals: Sequence[Signal],
    notes: Sequence[str],
    buckets: int,
) -> Figure:
    """Return a figure with one panel that holds one signal of each run."""
    joint_names(runs)
    figure = Figure(figsize=(WIDTH_IN, NORM_HEIGHT_IN), dpi=DOTS_PER_INCH)
    panel = figure.subplots()
    draw_runs(panel, runs, signals, buckets)
    panel.set_ylim(bottom=0.0)
    panel.set_xlabel(TIME_LABEL)
    panel.set_ylabel(label)
    handles = run_handles(
        [f"{figure_text(run.label)}: {n}" for run, n in zip(runs, notes, strict=True)]
    )
    if any(run.retunes for run in runs):
        handles.append(_retune_line())
    add_legend(figure, handles, columns_at_most=2)
    return laid_out(figure)


def panel_grid(
    names: Sequence[str],
    x_label: str,
    y_label: str,
    shares_x: bool = True,
    suffixes: Sequence[str] = (),
) -> tuple[Figure, list[Axes]]:
    """Return a figure with one titled panel for each name, and the panels."""
    rows, columns = _grid(len(names))
    figure = Figure(figsize=(WIDTH_IN, 0.8 + PANEL_HEIGHT_IN * rows), dpi=DOTS_PER_INCH)
    axes = figure.subplots(rows, columns, sharex=shares_x, squeeze=False)
    panels: list[Axes] = list(axes.flat[: len(names)])
    for k, (name, panel) in enumerate(zip(names, panels, strict=True)):
        panel.set_title(figure_text(name) + (suffixes[k] if suffixes else ""))
        # The last panel of each column carries the labels, also where the last row has gaps.
        panel.tick_params(labelbottom=not shares_x or k + columns >= len(names))
    for panel in axes.flat[len(names) :]:
        panel.set_visible(False)
    figure.supxlabel(x_label)
    figure.supylabel(y_label)
    return figure, panels


def draw_runs(
    panel: Axes, runs: Sequence[RunSeries], signals: Sequence[Signal], buckets: int
) -> None:
    """Draw one signal of each run into a panel, the calmest on top so that none is hidden."""
    roughness = [total_variation(signal.values) for signal in signals]
    back_to_front = sorted(range(len(runs)), key=lambda k: -roughness[k])
    for k, (run, signal, style) in enumerate(zip(runs, signals, run_styles(), strict=False)):
        stamps_ns, values = envelope(signal, buckets)
        line = styled_line(style)
        line.set_data(seconds_since(stamps_ns, run.start_ns), values)
        line.set_zorder(3 + back_to_front.index(k))
        panel.add_line(line)
        for retune in run.retunes:
            at = (retune.stamp_ns - run.start_ns) / 1e9
            panel.axvline(at, color=style.color, linewidth=0.9, linestyle=":", zorder=2)
    panel.autoscale_view()
    seconds = max(run.duration for run in runs)
    plain_ticks(panel.xaxis, MaxNLocator(10, steps=TICK_STEPS, integer=seconds >= 5.0))
    plain_ticks(panel.yaxis, MaxNLocator(5, steps=TICK_STEPS))


def plain_ticks(axis: Axis, locator: MaxNLocator) -> None:
    """Give an axis ticks whose numbers stand for themselves."""
    axis.set_major_locator(locator)
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


def series_of(runs: Sequence[RunSeries], joint: str) -> list[JointSeries]:
    """Return one joint's series of each run."""
    return [run.joints[run.joint_names.index(joint)] for run in runs]


def joint_names(runs: Sequence[RunSeries]) -> tuple[str, ...]:
    """Return the joints of the runs."""
    if not runs:
        raise SeriesError("a figure needs at least one run, got none")
    names = runs[0].joint_names
    for run in runs[1:]:
        if set(run.joint_names) != set(names):
            raise SeriesError(
                f"runs {runs[0].label!r} and {run.label!r} do not have the same joints: "
                f"{', '.join(names)} and {', '.join(run.joint_names)}"
            )
    return names


def run_handles(labels: Sequence[str]) -> list[Line2D]:
    """Return the legend's lines of the runs, in order."""
    handles = []
    for label, style in zip(labels, run_styles(), strict=False):
        handle = styled_line(style)
        handle.set(label=label, linewidth=style.width + 0.5)
        handles.append(handle)
    return handles


def add_legend(figure: Figure, handles: Sequence[Line2D], columns_at_most: int = 8) -> None:
    """Put one legend above all panels, in as many columns as the width has room for."""
    widest = max(len(str(handle.get_label())) for handle in handles)
    room = int((WIDTH_IN - 0.4) / (HANDLE_IN + CHARACTER_IN * widest))
    columns = max(1, min(columns_at_most, len(handles), room))
    legend_outside(figure, handles, "upper", columns)


_LEGEND_ROW_IN, _LEGEND_PAD_IN = 0.21, 0.13


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


def _draw_reference(panel: Axes, run: RunSeries, signal: Signal, buckets: int) -> None:
    stamps_ns, values = envelope(signal, buckets)
    line = _reference_line()
    line.set_data(seconds_since(stamps_ns, run.start_ns), values)
    panel.add_line(line)


def _grid(count: int) -> tuple[int, int]:
    """Return rows and columns for so many panels: wide ones while they fit on a page."""
    columns = 1 if count <= 3 else 2 if count <= 12 else 3
    return math.ceil(count / columns), columns


def _reference_line(label: str = "") -> Line2D:
    return Line2D([], [], color=REFERENCE, linewidth=4.0, solid_capstyle="butt", label=label)


def _retune_line() -> Line2D:
    return Line2D([], [], color=INK, linewidth=0.9, linestyle=":", label=RETUNE_LABEL)

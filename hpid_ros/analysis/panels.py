"""How runs are laid out on a figure: one panel a joint, or one panel for all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hpid_ros.analysis.indices import total_variation
from hpid_ros.analysis.plot_style import (
    DOTS_PER_INCH,
    INK,
    NORM_HEIGHT_IN,
    PANEL_HEIGHT_IN,
    REFERENCE,
    WIDTH_IN,
    RunStyle,
    run_styles,
)
from hpid_ros.analysis.series import JointSeries, RunSeries, SeriesError, seconds_since
from hpid_ros.analysis.signals import Signal, envelope
from hpid_ros.analysis.tick_labels import TickLabels

TIME_LABEL = "time [s]"
REFERENCE_LABEL = "reference"
TICK_STEPS = (1, 2, 2.5, 5, 10)

SignalOf = Callable[[JointSeries], Signal]


def joint_panels(
    runs: Sequence[RunSeries],
    label: str,
    signal_of: SignalOf,
    buckets: int,
    reference_of: SignalOf | None = None,
) -> Figure:
    """Return a figure with one panel a joint, the joints' names above, one legend for all.

    Args:
        runs: The runs, the baseline first.
        label: Name and unit of the signal.
        signal_of: The signal of a joint.
        buckets: Detail of each line, see :func:`~hpid_ros.analysis.signals.envelope`.
        reference_of: What is drawn behind the runs, from the first run.

    Raises:
        SeriesError: If there is no run, or the runs' joints differ.
    """
    names = _joint_names(runs)
    rows, columns = _grid(len(names))
    size = (WIDTH_IN, 0.8 + PANEL_HEIGHT_IN * rows)
    figure = Figure(figsize=size, dpi=DOTS_PER_INCH)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for k, name in enumerate(names):
        panel = axes[k // columns, k % columns]
        panel.set_title(name)
        series = [run.joints[run.joint_names.index(name)] for run in runs]
        if reference_of is not None:
            _draw_reference(panel, runs[0], reference_of(series[0]), buckets)
        else:
            panel.axhline(0.0, color=INK, linewidth=0.5)
        draw_runs(panel, runs, [signal_of(joint) for joint in series], buckets)
        # The last panel of each column carries the time, also where the last row has gaps.
        panel.tick_params(labelbottom=k + columns >= len(names))
    for panel in axes.flat[len(names) :]:
        panel.set_visible(False)
    figure.supxlabel(TIME_LABEL)
    figure.supylabel(label)
    handles = [_handle(run.label, style) for run, style in zip(runs, run_styles(), strict=False)]
    if reference_of is not None:
        handles.append(_reference_line(REFERENCE_LABEL))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return _laid_out(figure)


def single_panel(
    runs: Sequence[RunSeries],
    label: str,
    signals: Sequence[Signal],
    notes: Sequence[str],
    buckets: int,
) -> Figure:
    """Return a figure with one panel that holds one signal of each run.

    Args:
        runs: The runs, the baseline first.
        label: Name and unit of the signal.
        signals: One signal a run.
        notes: What the legend says of each run after its label.
        buckets: Detail of each line, see :func:`~hpid_ros.analysis.signals.envelope`.

    Raises:
        SeriesError: If there is no run, or the runs' joints differ.
    """
    _joint_names(runs)
    figure = Figure(figsize=(WIDTH_IN, NORM_HEIGHT_IN), dpi=DOTS_PER_INCH)
    panel = figure.subplots()
    draw_runs(panel, runs, signals, buckets)
    panel.set_ylim(bottom=0.0)
    panel.set_xlabel(TIME_LABEL)
    panel.set_ylabel(label)
    handles = [
        _handle(f"{run.label}: {note}", style)
        for run, note, style in zip(runs, notes, run_styles(), strict=False)
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=min(2, len(handles)))
    return _laid_out(figure)


def draw_runs(
    panel: Axes, runs: Sequence[RunSeries], signals: Sequence[Signal], buckets: int
) -> None:
    """Draw one signal of each run into a panel, the calmest on top so that none is hidden.

    Args:
        panel: Where.
        runs: The runs, the baseline first; each counts time from its own start.
        signals: One signal a run.
        buckets: Detail of each line.
    """
    roughness = [total_variation(signal.values) for signal in signals]
    back_to_front = sorted(range(len(runs)), key=lambda k: -roughness[k])
    for k, (run, signal, style) in enumerate(zip(runs, signals, run_styles(), strict=False)):
        stamps_ns, values = envelope(signal, buckets)
        line = _line(style)
        line.set_data(seconds_since(stamps_ns, run.start_ns), values)
        line.set_zorder(3 + back_to_front.index(k))
        panel.add_line(line)
    panel.autoscale_view()
    seconds = max(run.duration for run in runs)
    panel.xaxis.set_major_locator(MaxNLocator(10, steps=TICK_STEPS, integer=seconds >= 5.0))
    panel.yaxis.set_major_locator(MaxNLocator(5, steps=TICK_STEPS))
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter(TickLabels())


def _draw_reference(panel: Axes, run: RunSeries, signal: Signal, buckets: int) -> None:
    stamps_ns, values = envelope(signal, buckets)
    line = _reference_line()
    line.set_data(seconds_since(stamps_ns, run.start_ns), values)
    panel.add_line(line)


def _laid_out(figure: Figure) -> Figure:
    """Fix the layout, so that all formats share one and it is computed once."""
    ConstrainedLayoutEngine().execute(figure)
    return figure


def _joint_names(runs: Sequence[RunSeries]) -> tuple[str, ...]:
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


def _grid(count: int) -> tuple[int, int]:
    """Return rows and columns for so many panels: wide ones while they fit on a page."""
    columns = 1 if count <= 3 else 2 if count <= 12 else 3
    return math.ceil(count / columns), columns


def _line(style: RunStyle) -> Line2D:
    line = Line2D([], [], color=style.color, linewidth=style.width)
    if style.dashes is not None:
        line.set(linestyle=(0, style.dashes), gapcolor=style.tint, dash_capstyle="butt")
    return line


def _handle(label: str, style: RunStyle) -> Line2D:
    handle = _line(style)
    handle.set(label=label, linewidth=style.width + 0.5)
    return handle


def _reference_line(label: str = "") -> Line2D:
    return Line2D([], [], color=REFERENCE, linewidth=4.0, solid_capstyle="butt", label=label)

"""The figures of runs: the paper's five, the effort's spectrum, the phase portrait, and more.

matplotlib through its objects only: no pyplot, no figure that outlives its function, and the
same bytes for the same runs.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hpid_ros.base.errors import unknown_name
from hpid_ros.base.text import figure_text
from hpid_ros.messages.series import JointSeries, RunSeries, SeriesError
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.quantities import (
    EFFORT_L2,
    ERROR_L2,
    Data,
    Gains,
    Quantity,
    Signal,
    effort_of,
    error_of,
    has_any,
    norm_of_run,
    position_of,
    reference_of,
)
from hpid_ros.metrics.results import RunIndices, run_indices
from hpid_ros.metrics.task import EndEffectorPath
from hpid_ros.report.data import Figure as FigureData
from hpid_ros.report.data import Panel, figure_data, line_data
from hpid_ros.report.panels import (
    REFERENCE_LABEL,
    TICK_STEPS,
    add_legend,
    joint_panels,
    laid_out,
    plain_ticks,
    run_handles,
    single_panel,
    styled_line,
)
from hpid_ros.report.portraits import can_be_drawn, phase_panels, spectrum_panels, trade_off_figure
from hpid_ros.report.style import (
    DOTS_PER_INCH,
    REFERENCE,
    WIDTH_IN,
    JointUnits,
    figure_style,
    run_styles,
)

VIEWS = (("from above", 0, 1, "x [m]", "y [m]"), ("from the side", 0, 2, "x [m]", "z [m]"))
"""Title of a view, the axes that it shows, and their labels."""

_HEIGHT_IN = 5.2
_REFERENCE_WIDTH = 3.2  # [pt]: wide enough to be seen on both sides of a run's line


def path_figure(paths: Sequence[EndEffectorPath]) -> Figure:
    """Return both views, each with one scale for both of its axes."""
    if not paths:
        raise SeriesError("a figure of paths needs at least one, got none")
    figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN), dpi=DOTS_PER_INCH)
    panels = figure.subplots(1, len(VIEWS))
    for panel, (title, across, up, x_label, y_label) in zip(panels, VIEWS, strict=True):
        panel.set_title(title)
        panel.add_line(
            Line2D(
                paths[0].reference[:, across],
                paths[0].reference[:, up],
                color=REFERENCE,
                linewidth=_REFERENCE_WIDTH,
                solid_capstyle="round",
            )
        )
        for path, style in zip(paths, run_styles(), strict=False):
            line = styled_line(style)
            line.set_data(path.position[:, across], path.position[:, up])
            panel.add_line(line)
        panel.margins(0.06)
        panel.autoscale_view()
        panel.set_aspect("equal", adjustable="datalim")
        panel.set_xlabel(x_label)
        panel.set_ylabel(y_label)
        for axis in (panel.xaxis, panel.yaxis):
            plain_ticks(axis, MaxNLocator(6, steps=TICK_STEPS))
    handles = run_handles([figure_text(path.label) for path in paths])
    handles.append(
        Line2D([], [], color=REFERENCE, linewidth=_REFERENCE_WIDTH, label=REFERENCE_LABEL)
    )
    add_legend(figure, handles)
    return laid_out(figure)


def path_data(paths: Sequence[EndEffectorPath], labels: Sequence[str]) -> FigureData:
    """Return both views for the report."""
    panels: list[Panel] = []
    for title, across, up, x_label, y_label in VIEWS:
        lines = [line_data(-1, paths[0].reference[:, across], paths[0].reference[:, up])]
        lines += [
            line_data(labels.index(path.label), path.position[:, across], path.position[:, up])
            for path in paths
        ]
        title = f"{title}: {y_label} over {x_label}"
        panels.append({"title": title, "lines": lines, "level": None, "marks": []})
    caption = "Path of the end effector in the task frame, and its reference"
    return figure_data("end_effector", caption, panels, is_free=True)


# Zero has no place on a logarithmic axis.
LEAST_NORM = 1e-6


@figure_style()
def norm_figure(runs: Sequence[RunSeries], gains: Gains, buckets: int) -> Figure:
    """Return the homogeneous norm over time, one panel a joint, its axis logarithmic."""

    def norm_of(run: RunSeries, series: JointSeries) -> Signal:
        stamps_ns, values = gains[run.label][series.joint].norm
        return Signal(stamps_ns, np.maximum(values, LEAST_NORM))

    return joint_panels(runs, "homogeneous norm", "", norm_of, buckets, level=None, is_log=True)


@figure_style()
def multiplier_figure(runs: Sequence[RunSeries], gains: Gains, buckets: int) -> Figure:
    """Return the gain multiplier over time, one panel a joint; see :func:`norm_figure`."""

    def multiplier_of(run: RunSeries, series: JointSeries) -> Signal:
        return gains[run.label][series.joint].multiplier

    # One is the linear PID.
    return joint_panels(runs, "gain multiplier", "", multiplier_of, buckets, level=1.0)


FORMATS = ("png", "pdf", "svg")
# Detail of a line: three times the pixels of a panel in a PNG, so that a PDF can be enlarged.
BUCKETS = 2000

# Dates and versions would make two files of the same run differ.
_METADATA: Mapping[str, dict[str, Any]] = {
    "png": {"Software": None},
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
}


def _position(run: RunSeries, series: JointSeries) -> Signal:
    return position_of(series)


def _reference(run: RunSeries, series: JointSeries) -> Signal:
    return reference_of(series)


def _error(run: RunSeries, series: JointSeries) -> Signal:
    return error_of(series)


def _effort(run: RunSeries, series: JointSeries) -> Signal:
    return effort_of(series)


class DrawRuns(Protocol):
    """A function that draws runs at some detail; the first run is the baseline."""

    def __call__(self, runs: Sequence[RunSeries], buckets: int = BUCKETS) -> Figure:
        """Return the figure."""
        ...


@figure_style()
def positions_figure(runs: Sequence[RunSeries], buckets: int = BUCKETS) -> Figure:
    """Return measured positions over the first run's reference, one panel a joint, in [rad].

    Of joints that slide it is in [m], as all figures have [N] for [N m] of them; what stands over
    joints of both kinds names both units, and the panels their own.
    """
    return joint_panels(runs, "position", "rad", _position, buckets, _reference)


@figure_style()
def efforts_figure(runs: Sequence[RunSeries], buckets: int = BUCKETS) -> Figure:
    """Return efforts, one panel a joint, in [N m]; see :func:`positions_figure`."""
    return joint_panels(runs, "effort", "N m", _effort, buckets)


@figure_style()
def errors_figure(runs: Sequence[RunSeries], buckets: int = BUCKETS) -> Figure:
    """Return reference minus position by joint, in [rad]; see :func:`positions_figure`."""
    return joint_panels(runs, "error", "rad", _error, buckets)


@figure_style()
def effort_norm_figure(runs: Sequence[RunSeries], buckets: int = BUCKETS) -> Figure:
    """Return the effort's norm over joints, in [N m]; see :func:`positions_figure`."""
    return _norm_figure(runs, r"$\|u(t)\|_2$", "N m", effort_of, EFFORT_L2, buckets)


@figure_style()
def error_norm_figure(runs: Sequence[RunSeries], buckets: int = BUCKETS) -> Figure:
    """Return the error's norm over joints, in [rad]; see :func:`positions_figure`."""
    return _norm_figure(runs, r"$\|e(t)\|_2$", "rad", error_of, ERROR_L2, buckets)


@figure_style()
def spectrum_figure(runs: Sequence[RunSeries], buckets: int = BUCKETS) -> Figure:
    """Return the spectrum of the effort by joint, in [N m / Hz^0.5]."""
    return spectrum_panels(runs)


@figure_style()
def phase_figure(runs: Sequence[RunSeries], buckets: int = BUCKETS) -> Figure:
    """Return error rate over error by joint, in [rad/s], [rad]; see :func:`positions_figure`."""
    return phase_panels(runs, 4 * buckets)


FIGURES: Mapping[str, DrawRuns] = {
    "positions": positions_figure,
    "efforts": efforts_figure,
    "errors": errors_figure,
    "effort_norm": effort_norm_figure,
    "error_norm": error_norm_figure,
    "spectrum": spectrum_figure,
    "phase": phase_figure,
}
_NEEDED: Mapping[str, Data] = {
    **dict.fromkeys(("errors", "error_norm", "phase"), Data.REFERENCE),
    **dict.fromkeys(("efforts", "effort_norm", "spectrum"), Data.EFFORT),
}
"""What a figure shows nothing without."""


def save_figures(
    runs: Sequence[RunSeries],
    folder: Path,
    formats: Iterable[str] = ("png", "pdf"),
    *,
    comparison: Comparison | None = None,
    repeats: Sequence[RunIndices] = (),
    gains: Gains | None = None,
    paths: Sequence[EndEffectorPath] = (),
) -> list[Path]:
    """Draw all figures into a folder, which must exist; files of the same name are replaced.

    A figure that would be empty, for want of any reference or effort, is left out.
    """
    wanted = tuple(formats)
    for form in wanted:
        if form not in FORMATS:
            raise SeriesError(unknown_name("figure format", form, FORMATS))
    if not runs and comparison is None:
        raise SeriesError("figures need at least one run, got none")
    written: list[Path] = []
    drawings = _drawings(runs, comparison, repeats, gains or {})
    if paths:
        drawings["end_effector"] = partial(_path_figure, paths)
    for name, draw in drawings.items():
        figure = draw()
        for form in wanted:
            path = Path(folder) / f"{name}.{form}"
            path.write_bytes(render(figure, form))
            written.append(path)
    return written


@figure_style()
def _path_figure(paths: Sequence[EndEffectorPath]) -> Figure:
    return path_figure(paths)


def _drawings(
    runs: Sequence[RunSeries],
    comparison: Comparison | None,
    repeats: Sequence[RunIndices],
    gains: Gains,
) -> dict[str, Callable[[], Figure]]:
    """Return what can be drawn, by name."""
    drawings: dict[str, Callable[[], Figure]] = {}
    if runs:
        drawings = {
            name: partial(draw, runs)
            for name, draw in FIGURES.items()
            if name not in _NEEDED or has_any(runs, _NEEDED[name])
        }
    known = [run for run in runs if run.label in gains]
    if known:
        drawings["norm"] = partial(norm_figure, known, gains, BUCKETS)
        drawings["multiplier"] = partial(multiplier_figure, known, gains, BUCKETS)
    if comparison is not None and comparison.others and can_be_drawn(comparison):
        drawings["trade_off"] = partial(trade_off_figure, comparison, repeats)
    return drawings


@figure_style()
def render(figure: Figure, form: str, transparent: bool = False) -> bytes:
    """Return a figure as the bytes of a file; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(
        buffer,
        format=form,
        dpi=DOTS_PER_INCH,
        metadata=_METADATA[form],
        transparent=transparent,
    )
    return buffer.getvalue()


def _norm_figure(
    runs: Sequence[RunSeries],
    symbol: str,
    unit: str,
    signal_of: Callable[[JointSeries], Signal],
    quantity: Quantity,
    buckets: int,
) -> Figure:
    signals = [norm_of_run(run, signal_of) for run in runs]
    values = [run_indices(run).value(quantity) for run in runs]
    units = JointUnits.of(runs)
    of_norm = units.over_all(quantity.unit).replace("^0.5", "$^{0.5}$")
    of_norm = f"[{of_norm}]" if "," in of_norm else of_norm
    notes = [
        f"no {quantity.meaning}"
        if math.isnan(value)
        else f"{quantity.meaning} {value:.4g} {of_norm}"
        for value in values
    ]
    label = f"{symbol} over all joints [{units.over_all(unit)}]"
    return single_panel(runs, label, signals, notes, buckets)

"""Two other views of a run: the spectrum of the effort, and error rate over error."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hpid_ros.analysis.effort_figures import amplitude_density
from hpid_ros.analysis.indices import DEFAULT_CUTOFF
from hpid_ros.analysis.panels import (
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
from hpid_ros.analysis.phase import phase_curve
from hpid_ros.analysis.plot_style import INK, run_styles
from hpid_ros.analysis.series import RunSeries
from hpid_ros.foreign_text import figure_text

DECADES_AT_MOST = 6.0


def spectrum_panels(runs: Sequence[RunSeries], cutoff: float = DEFAULT_CUTOFF) -> Figure:
    """Return the amplitude spectral density of the effort, one panel a joint, both axes log.

    Args:
        runs: The runs, the baseline first.
        cutoff: The frequency above which effort counts as chatter, in [Hz]; it is marked.

    Raises:
        SeriesError: If there is no run, or the runs' joints differ.
    """
    names = joint_names(runs)
    figure, panels = panel_grid(names, "frequency [Hz]", "effort density [N m / Hz$^{0.5}$]")
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
    """Return error rate over error, one panel a joint, each with ranges of its own.

    Args:
        runs: The runs, the baseline first.
        points: Detail of each curve.

    Raises:
        SeriesError: If there is no run, or the runs' joints differ.
    """
    names = joint_names(runs)
    figure, panels = panel_grid(names, "error [rad]", "error rate [rad/s]", shares_x=False)
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

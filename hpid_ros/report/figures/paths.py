"""The path of the end effector in the task frame, from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hpid_ros.analysis.indices.task import EndEffectorPath
from hpid_ros.base.foreign_text import figure_text
from hpid_ros.recordings.series import SeriesError
from hpid_ros.report.figures.panels import (
    REFERENCE_LABEL,
    TICK_STEPS,
    add_legend,
    laid_out,
    plain_ticks,
    run_handles,
    styled_line,
)
from hpid_ros.report.figures.style import DOTS_PER_INCH, REFERENCE, WIDTH_IN, run_styles
from hpid_ros.report.html.data import Figure as FigureData
from hpid_ros.report.html.data import Panel, figure_data, line_data

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

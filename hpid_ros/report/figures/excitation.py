"""Where an excitation leads joints, how fast, and what they may not exceed."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.foreign_text import figure_text
from hpid_ros.excitation.plan import ExcitationPlan, PlannedJoint
from hpid_ros.report.figures.panels import TICK_STEPS, add_legend, laid_out, plain_ticks
from hpid_ros.report.figures.style import (
    DOTS_PER_INCH,
    INK,
    RUN_STYLES,
    WIDTH_IN,
    figure_style,
)

_ROW_HEIGHT_IN = 1.5
_REFERENCE, _LIMIT = RUN_STYLES[0].color, RUN_STYLES[1].color
_NEAR = 3.0  # a limit further away than so many times the motion is not drawn


@figure_style()
def excitation_figure(plan: ExcitationPlan) -> Figure:
    """Return a row for each joint: its position and its velocity, with limits that are near."""
    count = len(plan.joints)
    figure = Figure(figsize=(WIDTH_IN, _ROW_HEIGHT_IN * count + 1.0), dpi=DOTS_PER_INCH)
    grid = figure.subplots(count, 2, squeeze=False, sharex=True)
    for number, ((left, right), planned) in enumerate(zip(grid, plan.joints, strict=True)):
        bounds, at = planned.bounds, plan.positions[:, number]
        left.set_title(figure_text(bounds.joint))
        _draw(left, plan.times, at + bounds.position, (bounds.lower, bounds.upper))
        _draw(right, plan.times, plan.velocities[:, number], _velocities(planned))
        left.set_ylabel(f"position [{bounds.unit}]")
        right.set_ylabel(f"velocity [{bounds.unit}/s]")
    for panel in grid[-1]:
        panel.set_xlabel("time [s]")
    add_legend(figure, _handles())
    return laid_out(figure)


def _velocities(planned: PlannedJoint) -> tuple[float, float]:
    return -planned.velocity_stop, planned.velocity_stop


def _draw(panel: Axes, times: Numbers, values: Numbers, limits: tuple[float, float]) -> None:
    panel.plot(times, values, color=_REFERENCE, linewidth=0.9)
    span = float(np.ptp(values)) or 1.0
    middle = 0.5 * float(np.max(values) + np.min(values))
    for limit in limits:
        if math.isfinite(limit) and abs(limit - middle) < _NEAR * span:
            panel.axhline(limit, color=_LIMIT, linewidth=1.0, dashes=(7.0, 1.8))
    panel.spines["bottom"].set_color(INK)
    plain_ticks(panel.yaxis, MaxNLocator(4, steps=TICK_STEPS))


def _handles() -> list[Line2D]:
    return [
        Line2D([], [], color=_REFERENCE, linewidth=1.3, label="reference"),
        Line2D([], [], color=_LIMIT, linewidth=1.3, dashes=(7.0, 1.8), label="stopped beyond"),
    ]

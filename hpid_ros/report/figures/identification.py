"""Efforts that were measured beside those that an identified joint is predicted to need."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.foreign_text import figure_text
from hpid_ros.identification.results import Fit, JointIdentification
from hpid_ros.report.figures.panels import TICK_STEPS, add_legend, laid_out, plain_ticks
from hpid_ros.report.figures.style import (
    DOTS_PER_INCH,
    INK,
    REFERENCE,
    RUN_STYLES,
    WIDTH_IN,
    figure_style,
)

_ROW_HEIGHT_IN = 2.0
_BARE_HEIGHT_IN = 0.5
_SHARES = (2.3, 1.0)
_MEASURED, _PREDICTED, _RESIDUAL = REFERENCE, RUN_STYLES[0].color, RUN_STYLES[1].color
_LINE_LENGTH = 52  # characters of a reason


@figure_style()
def identification_figure(
    found: Sequence[JointIdentification], slides: Sequence[str] = ()
) -> Figure:
    """Return a row for each joint: its efforts, and beside them what its motion cannot tell."""
    heights = [_ROW_HEIGHT_IN if each.fit is not None else _BARE_HEIGHT_IN for each in found]
    figure = Figure(figsize=(WIDTH_IN, sum(heights) + 0.6), dpi=DOTS_PER_INCH)
    grid = figure.subplots(
        len(found), 2, squeeze=False, width_ratios=_SHARES, height_ratios=heights
    )
    for (left, right), each in zip(grid, found, strict=True):
        left.set_title(figure_text(each.joint))
        unit = "N" if each.joint in slides else "N m"
        if each.fit is None:
            left.set_axis_off()
        else:
            _draw(left, each.fit, unit)
        _tell(right, each)
    drawn = [axes for axes, each in zip(grid[:, 0], found, strict=True) if each.fit is not None]
    if drawn:
        drawn[-1].set_xlabel("time [s]")
    add_legend(figure, _handles())
    return laid_out(figure)


def _draw(panel: Axes, fit: Fit, unit: str) -> None:
    time = _packed(fit.time)
    panel.plot(time, fit.measured, color=_MEASURED, linewidth=3.0)
    predicted = np.where(fit.is_used, fit.predicted, np.nan)
    panel.plot(time, fit.predicted, color=_PREDICTED, linewidth=0.5, alpha=0.5)
    panel.plot(time, predicted, color=_PREDICTED, linewidth=1.3)
    residual = np.where(fit.is_used, fit.measured - fit.predicted, np.nan)
    panel.plot(time, residual, color=_RESIDUAL, linewidth=0.9)
    panel.axhline(0.0, color=INK, linewidth=0.5)
    panel.set_ylabel(f"effort [{unit}]")
    plain_ticks(panel.yaxis, MaxNLocator(4, steps=TICK_STEPS))
    plain_ticks(panel.xaxis, MaxNLocator(8, steps=TICK_STEPS))


def _packed(time: Numbers) -> Numbers:
    """Return times in which what lies between two spans is no longer than a tenth of all."""
    known = time[np.isfinite(time)]
    if not len(known):
        return np.asarray(time)
    steps = np.diff(known)
    usual = float(np.median(steps))
    length = float(np.sum(steps[steps < 4.0 * usual]))
    cut = np.concatenate([[0.0], np.cumsum(np.maximum(steps - max(0.1 * length, usual), 0.0))])
    packed = np.array(time)
    packed[np.isfinite(time)] = known - cut
    return packed


def _tell(panel: Axes, each: JointIdentification) -> None:
    panel.set_axis_off()
    lines = [line for remark in each.remarks for line in _wrapped(remark)]
    lines += [
        line
        for what, reason in each.untold.items()
        for line in _wrapped(reason if what == each.joint else f"{what}: {reason}")
    ]
    text = "\n".join(lines) if lines else "everything that was asked is told"
    panel.text(
        0.0, 1.0, figure_text_lines(text), va="top", fontsize=7.5, transform=panel.transAxes
    )


def figure_text_lines(text: str) -> str:
    """Return several lines, each as :func:`.figure_text`."""
    return "\n".join(figure_text(line) for line in text.split("\n"))


def _wrapped(text: str) -> list[str]:
    import textwrap

    return textwrap.wrap(text, _LINE_LENGTH, subsequent_indent="  ")


def _handles() -> list[Line2D]:
    return [
        Line2D([], [], color=_MEASURED, linewidth=3.0, label="measured"),
        Line2D([], [], color=_PREDICTED, linewidth=1.3, label="predicted"),
        Line2D([], [], color=_PREDICTED, linewidth=0.5, alpha=0.5, label="left out"),
        Line2D([], [], color=_RESIDUAL, linewidth=0.9, label="residual"),
    ]


def saved(figure: Figure, form: str) -> bytes:
    """Return a figure as the content of a file."""
    content = io.BytesIO()
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(form)
    figure.savefig(content, format=form, metadata=metadata)
    return content.getvalue()

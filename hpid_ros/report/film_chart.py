"""The chart below an animation: a signal of each run over time, once pale and once in full.

A frame shows the full one up to its instant and the pale one after it, so that matplotlib draws
twice for a whole animation.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib.image
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont
from numpy.typing import NDArray

from hpid_ros.base.errors import unknown_name
from hpid_ros.base.text import figure_text
from hpid_ros.base.units import Numbers
from hpid_ros.messages.series import RunSeries, SeriesError, seconds_since
from hpid_ros.metrics.quantities import Signal, error_of, norm_of_run, position_of, reference_of
from hpid_ros.report.figures import JointUnits
from hpid_ros.report.style import (
    REFERENCE,
    RUN_STYLES,
    figure_style,
    plain_ticks,
    run_styles,
    styled_line,
)

_DOTS_PER_INCH = 100
_PALE = 0.22
_AIR = 0.06  # of the axis beyond the curves, above and below


class FilmChart(NamedTuple):
    """A chart as pixels, and the numbers in it."""

    pale: NDArray[np.uint8]  # before anything happened, (rows, columns, 3)
    full: NDArray[np.uint8]  # with all that happens
    first: float  # first instant, seconds since each run's first state
    last: float  # last instant
    left: float  # column of the first instant
    right: float  # column of the last one
    top: int  # uppermost row of the panel
    bottom: int  # lowest row of it
    symbol: str  # what is read off, for instance |e|
    unit: str
    readings: tuple[Signal, ...]  # one signal a run: what is read off


class _Curves(NamedTuple):
    title: str
    symbol: str
    unit: str
    drawn: list[Signal]
    readings: list[Signal]
    reference: Signal | None


@figure_style()
def film_chart(
    runs: Sequence[RunSeries],
    joint: str | None,
    size: tuple[int, int],
    window: tuple[float, float],
) -> FilmChart:
    """Return the chart of some runs."""
    curves = _norms(runs) if joint is None else _positions(runs, joint)
    width, height = size
    inches = width / _DOTS_PER_INCH, height / _DOTS_PER_INCH
    figure = Figure(figsize=inches, dpi=_DOTS_PER_INCH)
    panel = figure.add_axes((58 / width, 34 / height, 1.0 - 76 / width, 1.0 - 60 / height))
    panel.set_title(curves.title, fontsize=8.5, fontweight="normal", pad=5)
    panel.tick_params(labelsize=8)
    panel.set_xlabel("time [s]", fontsize=8.5, labelpad=2)
    _draw(panel, runs, curves, window)
    full = _pixels(figure)
    for line in panel.lines:
        line.set_alpha(_PALE)
    box = panel.get_window_extent()
    return FilmChart(
        pale=_pixels(figure),
        full=full,
        first=window[0],
        last=window[1],
        left=box.x0,
        right=box.x1,
        top=round(height - box.y1),
        bottom=round(height - box.y0),
        symbol=curves.symbol,
        unit=curves.unit,
        readings=tuple(curves.readings),
    )


def run_color(place: int) -> str:
    """Return the colour of a run, as in the figures."""
    return RUN_STYLES[place % len(RUN_STYLES)].color


def font_file(*, is_bold: bool = False) -> str:
    """Return the file of the figures' font, which comes with matplotlib."""
    weight = "bold" if is_bold else "normal"
    return findfont(FontProperties(family="DejaVu Sans", weight=weight))


def _norms(runs: Sequence[RunSeries]) -> _Curves:
    signals = [norm_of_run(run, error_of) for run in runs]
    unit = JointUnits.of(runs).over_all("rad")
    return _Curves(
        f"error, norm over all joints [{unit}]; green: where the references are",
        "|e|",
        unit,
        signals,
        signals,
        None,
    )


def _positions(runs: Sequence[RunSeries], joint: str) -> _Curves:
    for run in runs:
        if joint not in run.joint_names:
            raise SeriesError(unknown_name("joint", joint, run.joint_names))
    series = [run.joints[run.joint_names.index(joint)] for run in runs]
    unit = "m" if any(each.is_slide for each in series) else "rad"
    return _Curves(
        *(
            f"{figure_text(joint)} and its reference, grey [{unit}]; green: all references",
            "e",
            unit,
        ),
        *([position_of(each) for each in series], [error_of(each) for each in series]),
        reference_of(series[0]),
    )


def _draw(
    panel: Axes, runs: Sequence[RunSeries], curves: _Curves, window: tuple[float, float]
) -> None:
    seen: list[Numbers] = []
    if curves.reference is not None and curves.reference.values.size:
        seen += _line(panel, runs[0], curves.reference, window, color=REFERENCE, linewidth=4.0)
    for run, signal, style in zip(runs, curves.drawn, run_styles(), strict=False):
        line = styled_line(style)
        look = {"color": style.color, "linestyle": line.get_linestyle(), "linewidth": 1.5}
        if style.dashes is not None:
            look |= {"linestyle": (0, style.dashes), "gapcolor": style.tint}
        seen += _line(panel, run, signal, window, **look)
    panel.set_xlim(*window)
    values = np.concatenate(seen) if seen else np.zeros(1)
    low, high = min(float(values.min()), 0.0), float(values.max())
    air = _AIR * (high - low) or 1.0
    panel.set_ylim(low - (air if low < 0.0 else 0.0), high + air)
    plain_ticks(panel.xaxis, 10)
    plain_ticks(panel.yaxis, 3)


def _line(
    panel: Axes, run: RunSeries, signal: Signal, window: tuple[float, float], **look: object
) -> list[Numbers]:
    """Draw what is within the window, and return its values."""
    times = seconds_since(signal.stamps_ns, run.start_ns)
    kept = (times >= window[0]) & (times <= window[1])
    panel.plot(times[kept], signal.values[kept], **look)  # type: ignore[arg-type]
    return [signal.values[kept]] if kept.any() else []


def _pixels(figure: Figure) -> NDArray[np.uint8]:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DOTS_PER_INCH)
    buffer.seek(0)
    shares = matplotlib.image.imread(buffer)[..., :3]
    return np.asarray((shares * 255.0).round(), dtype=np.uint8)

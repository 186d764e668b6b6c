"""The figure of the scaling study."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from benchmarks.figures import Middle
from hpid_ros.report.figures import RUN_STYLES
from hpid_ros.report.style import DOTS_PER_INCH, MARKERS, figure_style

NAMES = {
    "each": "a process for each controller",
    "composed": "controllers composed in one process",
    "single": "everything in one process",
    "in_process": "in-process engine, without ROS",
}
_SIZE_IN = (9.0, 4.0)
_MILLISECONDS = 1e3  # in a second


def draw(
    medians: Mapping[tuple[str, int], Middle], machine: Mapping[str, Any], file: Path
) -> None:
    """Draw rate and time of a cycle over the number of joints.

    Args:
        medians: Cycles per second by form and number of joints.
        machine: CPU model and number of cores, for the title.
        file: The PNG file.
    """
    with figure_style():
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        rates, times = figure.subplots(1, 2)
        counts = sorted({count for _, count in medians})
        for k, (form, name) in enumerate(NAMES.items()):
            points = [(n, medians[form, n]) for n in counts if (form, n) in medians]
            _line(rates, k, name, points, lambda rate: rate)
            _line(times, k, name, points, lambda rate: _MILLISECONDS / rate)
        rates.set(xscale="log", yscale="log", ylabel="control cycles per second [1/s]")
        rates.margins(x=0.06)
        times.set(ylabel="time of a cycle [ms]", ylim=(0.0, None), xlim=(0.0, 1.05 * counts[-1]))
        for axes in (rates, times):
            axes.set_xlabel("joints")
            axes.set_xticks(counts)
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        rates.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
        figure.legend(
            *rates.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False
        )
        cores = machine["cores"]
        figure.suptitle(f"Lock-step with physics, {machine['cpu']}, {cores} cores", fontsize=9)
        figure.savefig(file, dpi=DOTS_PER_INCH)


def _line(axes: Axes, k: int, name: str, points: Any, of: Any) -> None:
    """Draw one form: medians as a line, the range of the rounds as bars."""
    style = RUN_STYLES[k]
    x = [count for count, _ in points]
    y = [of(rate.median) for _, rate in points]
    ends = [sorted((of(rate.low), of(rate.high))) for _, rate in points]
    below = [value - low for value, (low, _) in zip(y, ends, strict=True)]
    above = [high - value for value, (_, high) in zip(y, ends, strict=True)]
    axes.errorbar(
        x,
        y,
        yerr=(below, above),
        label=name,
        color=style.color,
        marker=MARKERS[k],
        markersize=5,
        linewidth=style.width,
        linestyle="-" if style.dashes is None else (0, style.dashes),
        elinewidth=0.8,
        capsize=2,
    )

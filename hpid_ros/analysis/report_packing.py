"""The report's figures as plain data for the page's script: packed lines, panels, figures."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from hpid_ros.analysis.plot_style import RUN_STYLES

PIXELS_PER_POINT = 4.0 / 3.0


class Line(TypedDict):
    """A line: number of its run (-1: the reference) and base64 of little-endian float32."""

    run: int
    x: str
    y: str


class Mark(TypedDict):
    """A vertical line of a run."""

    run: int
    x: float


class Panel(TypedDict):
    """A chart: its title, its lines, where a level line stands, marks."""

    title: str
    lines: list[Line]
    level: float | None
    marks: list[Mark]


class Figure(TypedDict):
    """Charts that belong together; those of one group share the range of x."""

    name: str
    caption: str
    panels: list[Panel]
    group: str
    xName: str
    xLog: bool
    yLog: bool
    free: bool
    points: bool


def page_data(figures: Sequence[Figure], labels: Sequence[str]) -> str:
    """Return figures and runs as JSON that may stand inside a script element.

    Args:
        figures: The figures.
        labels: Labels of the runs, in the comparison's order.
    """
    runs = []
    for k, label in enumerate(labels):
        style = RUN_STYLES[k % len(RUN_STYLES)]
        dashes = [round(each * PIXELS_PER_POINT, 1) for each in style.dashes or ()]
        runs.append({"label": label, "style": k % len(RUN_STYLES), "dashes": dashes})
    document = {"runs": runs, "figures": figures}
    return json.dumps(document, separators=(",", ":")).replace("<", "\\u003c")


def figure_data(
    name: str,
    caption: str,
    panels: Sequence[Panel],
    *,
    group: str = "",
    x_name: str = "",
    x_log: bool = False,
    y_log: bool = False,
    is_free: bool = False,
    are_points: bool = False,
) -> Figure:
    """Return a figure.

    Args:
        name: Its name, also of its place in the page.
        caption: What stands below it.
        panels: Its charts.
        group: Figures of one group zoom together.
        x_name: Name and unit of x in read-outs.
        x_log: Whether x is logarithmic.
        y_log: Whether y is.
        is_free: Whether x is no running variable: curves, points.
        are_points: Whether lines are points, or bars of two.
    """
    return {
        "name": name,
        "caption": caption,
        "panels": list(panels),
        "group": group,
        "xName": x_name,
        "xLog": x_log,
        "yLog": y_log,
        "free": is_free,
        "points": are_points,
    }


def line_data(k: int, x: ArrayLike, y: ArrayLike) -> Line:
    """Return a line of a run.

    Args:
        k: The run's number, -1 for the reference.
        x: Where, (N,).
        y: Values, (N,).
    """
    return {"run": k, "x": _packed(x), "y": _packed(y)}


def _packed(values: ArrayLike) -> str:
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()

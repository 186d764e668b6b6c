"""The report's figures as data: thinned lines, packed for the charts of the page."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Sequence
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from hpid_ros.messages.series import JointSeries, RunSeries, seconds_since
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.indices import amplitude_density
from hpid_ros.metrics.quantities import (
    IAVC,
    ITAE,
    IVC,
    Data,
    Gains,
    Quantity,
    Signal,
    effort_of,
    envelope,
    error_of,
    has_any,
    norm_of_run,
    position_of,
    reference_of,
)
from hpid_ros.metrics.results import RunIndices
from hpid_ros.report.portraits import can_be_drawn, phase_curve
from hpid_ros.report.style import RUN_STYLES, JointUnits

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


def page_data(figures: Sequence[Figure], labels: Sequence[str]) -> dict[str, object]:
    """Return figures and runs as the page's program is given them, as JSON."""
    runs = []
    for k, label in enumerate(labels):
        style = RUN_STYLES[k % len(RUN_STYLES)]
        dashes = [round(each * PIXELS_PER_POINT, 1) for each in style.dashes or ()]
        runs.append({"label": label, "style": k % len(RUN_STYLES), "dashes": dashes})
    return {"runs": runs, "figures": figures}


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
    """Return a figure."""
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
    """Return a line of a run."""
    return {"run": k, "x": _packed(x), "y": _packed(y)}


def _packed(values: ArrayLike) -> str:
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()


SAMPLES = 150_000
"""Samples of all lines together: about 1.6 MB of text."""
LEAST_SAMPLES, MOST_SAMPLES = 200, 6000
REFERENCE = -1


def figures_data(
    runs: Sequence[RunSeries],
    comparison: Comparison,
    repeats: Sequence[RunIndices],
    gains: Gains,
) -> list[Figure]:
    """Return all figures that can be drawn."""
    figures = list(_Figures(runs, comparison, gains).all()) if runs else []
    if comparison.others and can_be_drawn(comparison):
        figures.append(_trade_off(comparison, repeats))
    return figures


class _Figures:
    """The figures of recordings."""

    def __init__(self, runs: Sequence[RunSeries], comparison: Comparison, gains: Gains) -> None:
        labels = [run.label for run in comparison.runs]
        self._runs = [(labels.index(run.label), run) for run in runs]
        self._names = runs[0].joint_names
        self._units = JointUnits.of(runs)
        self._gains = gains
        lines = (3 + 2 * bool(gains)) * len(runs) * len(self._names) + len(self._names)
        samples = min(max(SAMPLES // lines, LEAST_SAMPLES), MOST_SAMPLES)
        self._buckets = samples // 4
        self._points = samples

    def all(self) -> Iterator[Figure]:
        """Yield the figures."""
        runs = [run for _, run in self._runs]
        has_errors, has_efforts = has_any(runs, Data.REFERENCE), has_any(runs, Data.EFFORT)
        if has_errors:
            yield self._positions("Positions and reference")
            yield self._of_joints("errors", "Errors, reference minus position", "rad", error_of)
        else:
            yield self._positions("Positions")
        if has_efforts:
            yield self._of_joints("efforts", "Efforts", "N m", effort_of)
            yield self._norm("effort_norm", "Norm of the effort", "N m", effort_of)
        if has_errors:
            yield self._norm("error_norm", "Norm of the error", "rad", error_of)
        if has_efforts:
            yield self._spectrum()
        if has_errors:
            yield self._phase()
        if self._gains:
            yield self._gain("norm", "Homogeneous norm of error and error rate", 0, y_log=True)
            yield self._gain("multiplier", "Gain multiplier (1: the linear PID)", 1, level=1.0)

    def _positions(self, caption: str) -> Figure:
        figure = self._of_joints("positions", caption, "rad", position_of, None)
        first = self._runs[0][1]
        for panel, series in zip(figure["panels"], first.joints, strict=True):
            if series.has_reference:
                line = self._time_line(REFERENCE, first, reference_of(series))
                panel["lines"] = [line, *panel["lines"]]
        return figure

    def _of_joints(
        self,
        name: str,
        caption: str,
        unit: str,
        signal_of: Callable[[JointSeries], Signal],
        level: float | None = 0.0,
    ) -> Figure:
        caption = f"{caption} [{self._units.over_all(unit)}]"
        figure = self._time_figure(name, caption, lambda run, series: signal_of(series), level)
        return self._titled(figure, unit)

    def _titled(self, figure: Figure, unit: str) -> Figure:
        """Name each panel's unit where joints turn and slide."""
        for panel, suffix in zip(figure["panels"], self._units.suffixes(unit), strict=True):
            panel["title"] += suffix
        return figure

    def _gain(
        self, name: str, caption: str, which: int, level: float | None = None, y_log: bool = False
    ) -> Figure:
        def signal_of(run: RunSeries, series: JointSeries) -> Signal | None:
            known = self._gains.get(run.label)
            return None if known is None else known[series.joint][which]

        return self._time_figure(name, caption, signal_of, level, y_log)

    def _time_figure(
        self,
        name: str,
        caption: str,
        signal_of: Callable[[RunSeries, JointSeries], Signal | None],
        level: float | None,
        y_log: bool = False,
    ) -> Figure:
        panels: list[Panel] = []
        for joint in self._names:
            lines = []
            for k, run in self._runs:
                signal = signal_of(run, run.joints[run.joint_names.index(joint)])
                if signal is not None:
                    lines.append(self._time_line(k, run, signal))
            panels.append({"title": joint, "lines": lines, "level": level, "marks": self._marks()})
        return figure_data(
            name, f"{caption}, over time [s]", panels, group="time", x_name="t [s]", y_log=y_log
        )

    def _norm(
        self, name: str, caption: str, unit: str, signal_of: Callable[[JointSeries], Signal]
    ) -> Figure:
        lines = []
        for k, run in self._runs:
            norm = norm_of_run(run, signal_of)
            lines.append(self._time_line(k, run, norm))
        panel: Panel = {
            "title": "all joints",
            "lines": lines,
            "level": 0.0,
            "marks": self._marks(),
        }
        caption += f" over all joints [{self._units.over_all(unit)}], over time [s]"
        return figure_data(name, caption, [panel], group="time", x_name="t [s]")

    def _time_line(self, k: int, run: RunSeries, signal: Signal) -> Line:
        stamps_ns, values = _without_plateaus(envelope(signal, self._buckets))
        return line_data(k, seconds_since(stamps_ns, run.start_ns), values)

    def _marks(self) -> list[Mark]:
        return [
            {"run": k, "x": (retune.stamp_ns - run.start_ns) / 1e9}
            for k, run in self._runs
            for retune in run.retunes
        ]

    def _spectrum(self) -> Figure:
        panels: list[Panel] = []
        for joint in self._names:
            lines = []
            for k, run in self._runs:
                series = run.joints[run.joint_names.index(joint)]
                found = amplitude_density(series)
                if found is not None:
                    lines.append(line_data(k, found.frequency, found.density))
            panels.append({"title": joint, "lines": lines, "level": None, "marks": []})
        unit = "N m / √Hz"
        caption = f"Spectrum of the effort [{self._units.over_all(unit)}] over the frequency [Hz]"
        figure = figure_data(
            "spectrum", caption, panels, group="frequency", x_name="f [Hz]", x_log=True, y_log=True
        )
        return self._titled(figure, unit)

    def _phase(self) -> Figure:
        panels: list[Panel] = []
        for joint in self._names:
            lines = [
                line_data(k, *phase_curve(run.joints[run.joint_names.index(joint)], self._points))
                for k, run in self._runs
            ]
            panels.append({"title": joint, "lines": lines, "level": 0.0, "marks": []})
        rate, error = (self._units.over_all(unit) for unit in ("rad/s", "rad"))
        caption = f"Phase portrait: error rate [{rate}] over error [{error}]"
        figure = figure_data("phase", caption, panels, is_free=True)
        return self._titled(figure, "rad, rad/s")


def _trade_off(comparison: Comparison, repeats: Sequence[RunIndices]) -> Figure:
    labels = [run.label for run in comparison.runs]
    panels: list[Panel] = []
    for effort in (IVC, IAVC):
        lines = [_point(labels.index(run.label), run, effort) for run in repeats]
        lines += [
            bar
            for k, run in enumerate(comparison.runs)
            if run.spread is not None
            for bar in _bars(k, run, effort)
        ]
        lines += [_point(k, run, effort) for k, run in enumerate(comparison.runs)]
        title = f"{ITAE.symbol} over {effort.symbol} [{comparison.unit(effort)}]"
        panels.append({"title": title, "lines": lines, "level": None, "marks": []})
    caption = f"Error against effort: {ITAE.meaning} [{comparison.unit(ITAE)}]".replace("^2", "²")
    return figure_data("trade_off", caption, panels, is_free=True, are_points=True)


def _point(k: int, run: RunIndices, effort: Quantity) -> Line:
    return line_data(k, [run.value(effort)], [run.value(ITAE)])


def _bars(k: int, run: RunIndices, effort: Quantity) -> Iterator[Line]:
    quartiles = {} if run.spread is None else run.spread.quartiles[None]
    if effort.key in quartiles and ITAE.key in quartiles:
        yield line_data(k, quartiles[effort.key], [run.value(ITAE)] * 2)
        yield line_data(k, [run.value(effort)] * 2, quartiles[ITAE.key])


def _without_plateaus(signal: Signal) -> Signal:
    """Drop samples that equal both neighbours: the line is the same without them."""
    values = signal.values
    if values.size < 3:
        return signal
    is_inside = (values[1:-1] == values[:-2]) & (values[1:-1] == values[2:])
    kept = np.concatenate([[True], ~is_inside, [True]])
    return Signal(signal.stamps_ns[kept], values[kept])

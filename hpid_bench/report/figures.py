"""The figures of runs, each described once: the report's page and matplotlib draw them alike."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.units import Numbers, of_slide, unit_over
from hpid_ros.messages.series import JointSeries, RunSeries, seconds_since
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.gain_signals import RunGainSignals
from hpid_ros.metrics.indices import amplitude_density
from hpid_ros.metrics.quantities import EFFORT_L2, ERROR_L2, IAVC, ITAE, IVC, Data, Quantity
from hpid_ros.metrics.results import RunIndices
from hpid_ros.metrics.run_numbers import DEFAULT_CUTOFF, l2_of_run
from hpid_ros.metrics.signals import (
    Signal,
    effort_of,
    envelope,
    error_of,
    has_any,
    norm_of_run,
    position_of,
    reference_of,
)
from hpid_ros.metrics.texts import heading_of

if TYPE_CHECKING:
    from hpid_ros.metrics.task import EndEffectorPath

INK = "#20242b"
GRID = "#dfe2e7"
BACKGROUND = "#ffffff"
REFERENCE_COLOR = "#b4bac4"


@dataclass(frozen=True)
class RunStyle:
    color: str  # its colour
    tint: str  # the colour of the gaps between its dashes
    dashes: tuple[float, ...] | None  # [pt] lengths of dashes and gaps, or None for a solid line
    width: float  # [pt] line width


# Runs differ by hue, by lightness and by line, so that they can be told apart with any colour
# vision and on grey paper; a peak that falls into the gap of a dashed line is drawn in its tint.
# Dark blue, orange, green, purple: their lightness differs as well as their hue. Four more hues
# with dashes of their own follow; after eight runs they begin again.
RUN_STYLES = (
    RunStyle("#0b4a8f", "#0b4a8f", None, 1.3),
    RunStyle("#e8590c", "#f7bf9c", (7.0, 1.8), 1.3),
    RunStyle("#2b8a5b", "#a9d8c1", (2.0, 1.2), 1.3),
    RunStyle("#8f4bb8", "#d6bce6", (7.0, 1.5, 1.5, 1.5), 1.3),
    RunStyle("#8a0f2e", "#d9a3b0", (11.0, 1.5), 1.3),
    RunStyle("#0b8fa3", "#a6d9e0", (4.0, 1.2), 1.3),
    RunStyle("#6b5200", "#cfc39c", (1.2, 1.0), 1.3),
    RunStyle("#5a6572", "#c3c9d0", (9.0, 1.2, 1.2, 1.2, 1.2, 1.2), 1.3),
)

FIGURE_FORMATS = ("png", "pdf", "svg")
PRINT_SAMPLES = 8000  # of a line: twelve times a panel's pixels, so that a PDF can be enlarged


def require_formats(formats: Sequence[str]) -> None:
    for form in formats:
        if form not in FIGURE_FORMATS:
            raise SettingError(unknown_name("figure format", form, FIGURE_FORMATS))


def require_picture(path: Path) -> None:
    """Refuse a file of ``--plot`` that has no such format."""
    if path.suffix.lower().removeprefix(".") not in FIGURE_FORMATS:
        names = ", ".join(f".{form}" for form in FIGURE_FORMATS)
        raise SettingError(f"--plot must end in {names}, not {path.name!r}")


NO_RUN = -1  # stands for a run where a line is the reference, or a mark is of no run
LEAST_NORM = 1e-6  # zero has no place on a logarithmic axis


class Line(NamedTuple):
    """A line, torn where y is NaN; of a figure of points one point, or a bar of two."""

    run: int  # its place in the comparison
    x: Numbers
    y: Numbers
    is_repeat: bool = False  # whether it is one of several whose median is drawn, too


class Panel(NamedTuple):
    """Lines over common axes."""

    title: str
    lines: Sequence[Line]
    level: float | None = None  # where a level line stands
    marks: Sequence[tuple[int, float]] = ()  # vertical lines: run and x
    x: str = ""  # its own axes, where the figure has none for all
    y: str = ""

    @property
    def caption(self) -> str:
        return _caption(self.title, self.y, self.x)


@dataclass(frozen=True)
class Figure:
    """Panels that belong together.

    Its kind is ``time`` or ``frequency``, over which all figures of that kind share the range;
    ``curves``, each panel with its own; ``path``, with one scale for both axes; or ``points``.
    """

    name: str
    kind: str
    title: str
    x: str  # what the axes show, with units
    y: str
    panels: Sequence[Panel]
    y_log: bool = False
    labels: Mapping[int, str] = field(default_factory=dict)  # runs' names in a printed legend
    mark: str = ""  # what the marks are

    @property
    def is_free(self) -> bool:
        """Whether x does not rise along its lines."""
        return self.kind not in ("time", "frequency")

    @property
    def caption(self) -> str:
        return _caption(self.title, self.y, self.x)


def _caption(title: str, y: str, x: str) -> str:
    return ": ".join(filter(None, (title, " over ".join(filter(None, (y, x))))))


def are_slides(runs: Sequence[RunSeries]) -> list[bool]:
    """Return of each joint of the first run whether it slides, as far as any run knows."""
    slides = frozenset[str]().union(*(run.slides for run in runs))
    return [joint in slides for joint in runs[0].joint_names]


def figures_of(
    comparison: Comparison,
    runs: Sequence[RunSeries],
    samples: int,
    *,
    repeats: Sequence[RunIndices] = (),
    gains: RunGainSignals | None = None,
    paths: Sequence[EndEffectorPath] = (),
) -> list[Figure]:
    """Return all figures that would not be empty, each line of at most so many samples."""
    figures = list(_RunFigures(comparison, runs, samples, gains or {}).all()) if runs else []
    numbers = [[run.value(each) for each in (ITAE, IVC, IAVC)] for run in comparison.runs]
    if comparison.others and any(not any(map(math.isnan, each)) for each in numbers):
        figures.append(_trade_off(comparison, repeats))
    if paths:
        figures.append(_paths(paths, [run.label for run in comparison.runs]))
    return figures


SignalOf = Callable[[JointSeries], Signal]


class _RunFigures:
    def __init__(
        self,
        comparison: Comparison,
        runs: Sequence[RunSeries],
        samples: int,
        gains: RunGainSignals,
    ) -> None:
        self._numbers = comparison.runs
        labels = [run.label for run in comparison.runs]
        self._runs = [(labels.index(run.label), run) for run in runs]
        self._names = runs[0].joint_names
        self._are_slides = are_slides(runs)
        self._gains = gains
        self._samples = samples
        self._retunes = [
            (k, (retune.stamp_ns - run.start_ns) / 1e9)
            for k, run in self._runs
            for retune in run.retunes
        ]

    def all(self) -> Iterator[Figure]:
        runs = [run for _, run in self._runs]
        has_errors, has_efforts = has_any(runs, Data.REFERENCE), has_any(runs, Data.EFFORT)
        yield self._positions("Positions and reference" if has_errors else "Positions")
        if has_errors:
            title = "Errors, reference minus position"
            yield self._of_joints("errors", title, "error", "rad", error_of, 0.0)
        if has_efforts:
            yield self._of_joints("efforts", "Efforts", "effort", "N m", effort_of, 0.0)
            yield self._norm("effort_norm", "effort", "N m", effort_of, EFFORT_L2)
        if has_errors:
            yield self._norm("error_norm", "error", "rad", error_of, ERROR_L2)
        if has_efforts:
            yield self._spectrum()
        if has_errors:
            yield self._phase()
        if self._gains:
            title = "Homogeneous norm of error and error rate"
            yield self._over_time("norm", title, "homogeneous norm", self._norm_of, y_log=True)
            title, level = "Gain multiplier (1: the linear PID)", 1.0
            yield self._over_time("multiplier", title, "gain multiplier", self._multiplier, level)

    def _of(self, run: RunSeries, joint: str) -> JointSeries:
        return run.joints[run.joint_names.index(joint)]

    def _unit(self, unit: str) -> str:
        """Return the unit of an axis that the panels share: both where both kinds are there."""
        return unit_over(unit, self._are_slides)

    def _headings(self, unit: str) -> list[tuple[str, str]]:
        """Return each joint, and what its panel is called: with its unit where they differ."""
        if not unit or len(set(self._are_slides)) < 2:
            return [(joint, joint) for joint in self._names]
        pairs = zip(self._names, self._are_slides, strict=True)
        return [(joint, f"{joint} [{of_slide(unit) if each else unit}]") for joint, each in pairs]

    def _positions(self, title: str) -> Figure:
        figure = self._of_joints("positions", title, "position", "rad", position_of)
        first = self._runs[0][1]
        panels = [
            panel._replace(lines=[self._line(NO_RUN, first, reference_of(each)), *panel.lines])
            if each.has_reference
            else panel
            for panel, each in zip(figure.panels, first.joints, strict=True)
        ]
        return replace(figure, panels=panels)

    def _of_joints(
        self,
        name: str,
        title: str,
        what: str,
        unit: str,
        signal_of: SignalOf,
        level: float | None = None,
    ) -> Figure:
        what = f"{what} [{self._unit(unit)}]"
        return self._over_time(
            name, title, what, lambda run, series: signal_of(series), level, unit
        )

    def _norm_of(self, run: RunSeries, series: JointSeries) -> Signal | None:
        if run.label not in self._gains:
            return None
        stamps_ns, values = self._gains[run.label][series.joint].norm
        return Signal(stamps_ns, np.maximum(values, LEAST_NORM))

    def _multiplier(self, run: RunSeries, series: JointSeries) -> Signal | None:
        known = self._gains.get(run.label)
        return None if known is None else known[series.joint].multiplier

    def _over_time(
        self,
        name: str,
        title: str,
        y: str,
        signal_of: Callable[[RunSeries, JointSeries], Signal | None],
        level: float | None = None,
        unit: str = "",
        *,
        y_log: bool = False,
    ) -> Figure:
        panels = []
        for joint, heading in self._headings(unit):
            signals = [(k, run, signal_of(run, self._of(run, joint))) for k, run in self._runs]
            lines = [self._line(k, run, signal) for k, run, signal in signals if signal]
            panels.append(Panel(heading, lines, level, self._retunes))
        return Figure(name, "time", title, "time [s]", y, panels, y_log, mark="retuned")

    def _norm(
        self, name: str, what: str, unit: str, signal_of: SignalOf, quantity: Quantity
    ) -> Figure:
        lines = [self._line(k, run, norm_of_run(run, signal_of)) for k, run in self._runs]
        unit_of_l2 = self._unit(quantity.unit)
        unit_of_l2 = f"[{unit_of_l2}]" if "," in unit_of_l2 else unit_of_l2
        labels = {}
        for k, run in self._runs:
            value = self._l2_of(k, run, quantity)
            note = f"{quantity.meaning} {value:.4g} {unit_of_l2}"
            labels[k] = f"{run.label}: {f'no {quantity.meaning}' if math.isnan(value) else note}"
        return Figure(
            name,
            "time",
            f"Norm of the {what}",
            "time [s]",
            f"norm of the {what} over all joints [{self._unit(unit)}]",
            [Panel("all joints", lines, 0.0, self._retunes)],
            labels=labels,
            mark="retuned",
        )

    def _l2_of(self, k: int, run: RunSeries, quantity: Quantity) -> float:
        """Return an L2 norm of a recording itself, which a median of repeats is not."""
        known = self._numbers[k]
        if known.spread is None and known.angle_unit == "rad" and quantity in known.quantities:
            return known.value(quantity)
        return l2_of_run(run, quantity)

    def _line(self, k: int, run: RunSeries, signal: Signal) -> Line:
        stamps_ns, values = envelope(signal, self._samples // 4)
        if values.size > 2:  # what equals both of its neighbours changes no line
            is_inside = (values[1:-1] == values[:-2]) & (values[1:-1] == values[2:])
            kept = np.concatenate([[True], ~is_inside, [True]])
            stamps_ns, values = stamps_ns[kept], values[kept]
        return Line(k, seconds_since(stamps_ns, run.start_ns), values)

    def _spectrum(self) -> Figure:
        unit, panels = "N m / √Hz", []
        for joint, heading in self._headings(unit):
            found = [(k, amplitude_density(self._of(run, joint))) for k, run in self._runs]
            lines = [Line(k, each.frequency, each.density) for k, each in found if each]
            panels.append(Panel(heading, lines, None, [(NO_RUN, DEFAULT_CUTOFF)]))
        return Figure(
            "spectrum",
            "frequency",
            "Spectrum of the effort",
            "frequency [Hz]",
            f"effort density [{self._unit(unit)}]",
            panels,
            y_log=True,
            mark=f"chatter above {DEFAULT_CUTOFF:g} Hz",
        )

    def _phase(self) -> Figure:
        panels = []
        for joint, heading in self._headings("rad, rad/s"):
            curves = [
                (k, phase_curve(self._of(run, joint), self._samples)) for k, run in self._runs
            ]
            panels.append(Panel(heading, [Line(k, *curve) for k, curve in curves], 0.0))
        rate, error = map(self._unit, ("rad/s", "rad"))
        axes = f"error [{error}]", f"error rate [{rate}]"
        return Figure("phase", "curves", "Phase portrait", *axes, panels)


def _trade_off(comparison: Comparison, repeats: Sequence[RunIndices]) -> Figure:
    """Return the error over the effort's variation and effort spent, with bars of quartiles."""
    labels = [run.label for run in comparison.runs]
    error = f"{ITAE.meaning}, {ITAE.symbol} [{comparison.unit(ITAE)}]"
    panels = []
    for effort in (IVC, IAVC):
        lines = [_point(labels.index(run.label), run, effort, True) for run in repeats]
        for k, run in enumerate(comparison.runs):
            quartiles = {} if run.spread is None else run.spread.quartiles[None]
            if effort.key in quartiles and ITAE.key in quartiles:
                x, y = np.full(2, run.value(effort)), np.full(2, run.value(ITAE))
                lines.append(Line(k, np.array(quartiles[effort.key]), y))
                lines.append(Line(k, x, np.array(quartiles[ITAE.key])))
        lines += [_point(k, run, effort) for k, run in enumerate(comparison.runs)]
        label = f"{effort.meaning}, {effort.symbol} [{comparison.unit(effort)}]"
        panels.append(Panel("", lines, x=label))
    headings = {k: heading_of(run) for k, run in enumerate(comparison.runs)}
    title = "Error against effort"
    return Figure("trade_off", "points", title, "", error, panels, labels=headings)


def _point(k: int, run: RunIndices, effort: Quantity, is_repeat: bool = False) -> Line:
    return Line(k, np.array([run.value(effort)]), np.array([run.value(ITAE)]), is_repeat)


def _paths(paths: Sequence[EndEffectorPath], labels: Sequence[str]) -> Figure:
    panels = []
    for title, across, up, x, y in (
        ("from above", 0, 1, "x [m]", "y [m]"),
        ("from the side", 0, 2, "x [m]", "z [m]"),
    ):
        lines = [Line(NO_RUN, paths[0].reference[:, across], paths[0].reference[:, up])]
        for path in paths:
            k = labels.index(path.label)
            lines.append(Line(k, path.position[:, across], path.position[:, up]))
        panels.append(Panel(title, lines, x=x, y=y))
    title = "Path of the end effector in the task frame, and its reference"
    return Figure("end_effector", "path", title, "", "", panels)


RATE_WINDOW = 0.025  # time over which the error's rate is fitted, in [s]
LEAST_JUMP = 1e-3  # lower jumps of a reference are not told from its own resolution, in [rad]
JUMP_RATIO = 10.0  # a jump goes so many times further than the periods before and after


class PhaseCurve(NamedTuple):
    """Error in [rad] and error rate in [rad/s] of a joint, (N,) each.

    The rate is NaN where the curve is torn: from one side of a jump of the reference to the other
    no joint has moved.
    """

    error: Numbers
    rate: Numbers


def phase_curve(series: JointSeries, points: int) -> PhaseCurve:
    """Return a joint's error and the rate of its error; nothing without a reference.

    The rate is the slope of a parabola fitted over 25 ms, since a bare difference of encoder
    counts would hide everything. A jump of the reference is in no fit.
    """
    if not series.has_reference:
        return PhaseCurve(np.empty(0), np.empty(0))
    t, error = series.time, series.error
    stride = max(1, -(-error.size // points))
    if error.size < 4 or t[-1] <= t[0]:
        return PhaseCurve(error[::stride], np.zeros_like(error[::stride]))
    jumps = _jumps(series.reference)
    smooth: list[Numbers] = []
    rate: list[Numbers] = []
    for first, stop in pairwise((0, *jumps, error.size)):
        shown = slice(-first % stride, None, stride)
        for found, part in zip(
            (smooth, rate), _fitted(t[first:stop], error[first:stop], shown), strict=True
        ):
            found.append(part)
    curve = PhaseCurve(np.concatenate(smooth), np.concatenate(rate))
    torn = {(at - 1) // stride for at in jumps}  # the last one shown before a jump
    curve.rate[list(torn)] = np.nan
    return curve


def _jumps(reference: Numbers) -> list[int]:
    """Return the first samples after the jumps of a reference."""
    moved = np.abs(np.diff(reference))
    neighbours = np.zeros_like(moved)
    neighbours[1:] = moved[:-1]
    neighbours[:-1] = np.maximum(neighbours[:-1], moved[1:])
    found = (moved >= LEAST_JUMP) & (moved > JUMP_RATIO * neighbours)
    return [int(at) + 1 for at in np.flatnonzero(found)]


def _fitted(t: Numbers, error: Numbers, shown: slice) -> tuple[Numbers, Numbers]:
    """Return some of an error and its rate, each smoothed over :data:`RATE_WINDOW`."""
    if error.size < 4 or t[-1] <= t[0]:
        return error[shown], np.full_like(error[shown], np.nan)
    period = float(t[-1] - t[0]) / (error.size - 1)
    half = max(1, min(round(0.5 * RATE_WINDOW / period), (error.size - 1) // 2))
    even = np.interp(np.linspace(t[0], t[-1], error.size), t, error)
    # A parabola over each window, and those of the first and the last one for the ends: the
    # filter of Savitzky and Golay, as in scipy.signal, which takes half a second to import.
    offsets = np.arange(-half, half + 1)
    to_values = np.vander(offsets, 3, increasing=True)
    windows = sliding_window_view(even, offsets.size)
    middles = np.arange(error.size)[shown] - half
    places = np.clip(middles, 0, len(windows) - 1)
    off = middles - places
    c0, c1, c2 = (windows[places] @ np.linalg.pinv(to_values).T).T
    return c0 + off * (c1 + off * c2), (c1 + 2.0 * off * c2) / period

"""Margins of loops as tables and figures: Bode, Nyquist, |S| and |T|; hPID is a band."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import MultipleLocator
from rich.console import RenderableType, group
from rich.text import Text

from hpid_bench.report.figures import INK, RUN_STYLES
from hpid_bench.report.margin_text import (
    delay_margin_text,
    gain_margin_text,
    phase_margin_text,
    sensitivity_text,
)
from hpid_bench.report.plots import (
    DOTS_PER_INCH,
    WIDTH_IN,
    figure_style,
    laid_out,
    legend_outside,
    log_ticks,
    plain_ticks,
)
from hpid_bench.report.table import WideTable
from hpid_ros.base.text import figure_text
from hpid_ros.base.units import Numbers, of_slide
from hpid_ros.stability.frequency import Complexes, FrozenLoop
from hpid_ros.stability.margins import Case, FamilyMargins, LoopFamily, Margins, frequency_grid
from hpid_ros.stability.measured_margins import Distance, LoopReport, MeasuredJoint, measured_loop

_FIGURES = ("loop", "lam", "GM [dB]", "PM", "DM [ms]", "DM/T", "alpha", "Ms", "Mt", "BW [Hz]")
_PLACES = (
    "loop",
    "certified",
    "frozen",
    "certified mu",
    "inertia",
    "friction",
    "norm",
    "worst at m",
    "lam",
)


@group()
def margin_table(reports: Mapping[str, LoopReport]) -> Iterator[RenderableType]:
    """Yield the worst margins of each loop, and below them where, and what is certain."""
    rows = [row for name, each in reports.items() for row in _rows(name, each)]
    yield WideTable.of_rows(_FIGURES, rows, names=2)
    yield ""
    verdicts = [(name, *_verdict_cells(each)) for name, each in reports.items()]
    yield WideTable.of_rows(_PLACES, verdicts, names=2)
    yield ""
    for name, each in reports.items():
        yield from (Text(f"{name}: {line}", style=style) for line, style in _lines(each))
    yield Text(_legend(reports.values()), style="dim")


def _rows(name: str, report: LoopReport) -> list[list[str]]:
    family = report.family
    period = family.settings.timing.control_period
    if not family.is_homogeneous:
        return [[name, "1", *_cells(report.pid, period)]]
    least, largest = family.multipliers[0], family.multipliers[-1]
    return [
        [name, f"{least:.3g} {largest:.3g}", *_cells(report.band, period)],
        ["  at rest", f"{family.at_rest:.3g}", *_cells(report.at_rest, period)],
        ["  as PID", "1", *_cells(report.pid, period)],
    ]


def _cells(found: FamilyMargins, period: float) -> list[str]:
    worst = found.worst
    if worst is None:
        return ["UNSTABLE", *["-"] * (len(_FIGURES) - 3)]
    return [
        gain_margin_text(worst),
        phase_margin_text(worst),
        delay_margin_text(worst),
        f"{worst.delay / period:.3g}",
        f"{worst.disk:.2f}",
        sensitivity_text(worst),
        f"{worst.complementary:.2f}",
        f"{worst.bandwidth / math.tau:.3g}",
    ]


def _verdict_cells(report: LoopReport) -> list[str | Text]:
    family, interval = report.family, report.verdict.interval
    is_stable = report.band.is_stable
    worst = report.band.where["disk"] if is_stable else report.band.unstable[0]
    return [
        Text("yes", "green") if report.verdict.is_certified else Text("NO", "red"),
        Text("stable", style="green") if is_stable else Text("UNSTABLE", style="red"),
        "none" if interval is None else "{:+.3f} {:+.3f}".format(*interval),
        _range(family.inertia),
        f"{family.friction:.3g}",
        _range(family.norms) if family.is_homogeneous else "-",
        f"{worst.inertia:.3g}",
        f"{worst.multiplier:.3g}",
    ]


def _range(ends: tuple[float, float]) -> str:
    low, high = ends
    return f"{low:.3g}" if low == high else f"{low:.3g} {high:.3g}"


def _lines(report: LoopReport) -> list[tuple[str, str]]:
    """Return what has to be said of a loop, each line with its style."""
    lines = []
    unstable = report.band.unstable
    if unstable:
        least, most = (choose(each.multiplier for each in unstable) for choose in (min, max))
        family = report.family
        if family.is_homogeneous:
            norms = sorted(map(family.norm_of, (least, most)))
            what = f"frozen at lam {_range((least, most))} (norm {_range((norms[0], norms[1]))})"
        else:
            what = "the sampled loop"
        inertias = [each.inertia for each in unstable]
        on = _range((min(inertias), max(inertias)))
        lines.append((f"{what} it is unstable, on inertia {on} kg m^2", "red"))
    if report.verdict.reason:
        lines.append((report.verdict.reason, "red"))
    if report.measured is not None:
        lines.append((_measured_text(*report.measured), ""))
    return [(of_slide(line), style) for line, style in lines] if report.is_slide else lines


def _measured_text(joint: MeasuredJoint, apart: Distance) -> str:
    low, high = joint.frequency[0] / math.tau, joint.frequency[-1] / math.tau
    return (
        f"measured at {joint.frequency.size} of {joint.candidates} frequencies, {low:.3g} to "
        f"{high:.3g} Hz; the measured open loop (its law replaced by the PID) differs from the "
        f"computed one by {100 * apart.median:.2g} % (median), by at most "
        f"{100 * apart.most:.2g} % at 95 % of the frequencies; its gain is that of an inertia of "
        f"{apart.inertia:.3g} kg m^2; largest |S| {apart.sensitivity:.2f}, computed "
        f"{apart.computed_sensitivity:.2f}"
    )


def _legend(reports: Iterable[LoopReport]) -> str:
    words = [
        "Worst over the inertia, of the sampled and held loop: gain margins GM to lower and to "
        "raise the gain; phase margin PM [deg]; delay margin DM, also in control periods T; "
        "balanced disk margin alpha; peaks Ms of |S| and Mt of |T|; bandwidth BW of |T|. worst "
        "at: where alpha is least."
    ]
    if any(each.family.is_homogeneous for each in reports):
        words.append(
            "lam = n^mu is frozen at each of its values in turn. At rest, below the norm's floor, "
            "the law is linear and the margins are its own; elsewhere they prove nothing about a "
            "lam that moves: certified does, for the unsampled loop without floor or cap "
            "(hpid check-gains)."
        )
    return " ".join(words)


HEIGHT_IN = 9.0
_LINE, _BAND = RUN_STYLES[0], RUN_STYLES[1]
_MEASURED = "#5a6572"
_DISK = "#c9ced6"
_REACH = 2.4  # of the Nyquist panel, around -1/2
_DECADES_AROUND = 2.0  # of the frequencies shown, around the crossovers
_BAND_LINES = 61  # that fill the band in the Nyquist plot
_EDGE, _BESIDE = 0.82, 0.28  # where a text has to stand to the left; how far along its mark
_LARGEST_SHOWN = 1e3  # of the gain that a disk reaches to
_LEAST_SHOWN = 1e-2  # of |S| and |T|
_SHOWN = 0.98  # of the frequencies up to half the sampling frequency, where a held joint is zero


@figure_style()
def margins_figure(name: str, report: LoopReport) -> Figure:
    """Return Bode, Nyquist, |S| and |T| of a loop on the inertia where its PID is worst.

    The band of a homogeneous law is over all its multipliers; a recording is drawn as points.
    """
    family, found = report.family, report.found
    measured = None if report.measured is None else report.measured[0]
    worst = _worst_of_pid(found)
    pid = family.loop(worst.inertia)
    least, largest = family.multipliers[0], family.multipliers[-1]
    multipliers = np.geomspace(least, largest, _BAND_LINES) if family.is_homogeneous else ()
    band = [family.loop(worst.inertia, float(each)) for each in multipliers]
    frequency = _frequencies([pid, *band])
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DOTS_PER_INCH)
    grid = figure.add_gridspec(3, 2)
    panels = [figure.add_subplot(grid[row, 0]) for row in range(3)]
    nyquist, complementary = figure.add_subplot(grid[:2, 1]), figure.add_subplot(grid[2, 1])
    lines = _Lines(frequency, pid, band, measured)
    _draw_magnitude(panels[0], lines, worst.margins)
    extreme = _worst_of_band(found, family, worst.inertia)
    _draw_phase(panels[1], lines, worst.margins, extreme)
    _draw_nyquist(nyquist, lines, worst.margins, extreme)
    _draw_peak(panels[2], lines, "sensitivity", worst.margins, extreme)
    _draw_peak(complementary, lines, "complementary", worst.margins, extreme)
    figure.suptitle(_title(name, report, worst), x=0.01, ha="left", fontsize=10.5)
    handles = _handles(family, lines)
    legend_outside(figure, handles, "lower", len(handles))
    return laid_out(figure)


class _Lines:
    """What every panel draws: open loops at the frequencies shown."""

    def __init__(
        self,
        frequency: Numbers,
        pid: FrozenLoop,
        band: list[FrozenLoop],
        measured: MeasuredJoint | None,
    ) -> None:
        self.frequency, self.hertz = frequency, frequency / math.tau
        self.pid = pid.response(frequency)
        self.band = [each.response(frequency) for each in band]
        # The law is at rest at one end of the band: the greatest multiplier or the least.
        self.is_greatest_at_rest = bool(band) and band[0].settings.degree < 0.0
        self.points: tuple[Numbers, Complexes] | None = None
        if measured is not None:
            self.points = measured.frequency / math.tau, measured_loop(pid, measured)


def _worst_of_pid(found: FamilyMargins) -> Case:
    pid = found.of((1.0,))
    return pid.where["disk"] if pid.is_stable else pid.unstable[0]


def _worst_of_band(found: FamilyMargins, family: LoopFamily, inertia: float) -> Margins | None:
    """Return the worst margins over the multipliers, on one inertia; None if one is unstable."""
    if not family.is_homogeneous:
        return None
    reached = found.of(family.multipliers).cases
    return FamilyMargins(tuple(each for each in reached if each.inertia == inertia)).worst


def _frequencies(loops: list[FrozenLoop]) -> Numbers:
    """Return the frequencies to show, in [rad/s]."""
    grids = [frequency_grid(each) for each in loops]
    nyquist = loops[0].joint.nyquist
    centers = [
        float(grid[np.argmin(np.abs(np.log(np.abs(loop.response(grid)))))])
        for grid, loop in zip(grids, loops, strict=True)
    ]
    low = min(centers) * 10.0**-_DECADES_AROUND
    return np.geomspace(max(low, min(grid[0] for grid in grids)), _SHOWN * nyquist, 1500)


def _title(name: str, report: LoopReport, worst: Case) -> str:
    family = report.family
    joint = f"inertia {worst.inertia:.3g} kg m^2"
    if family.inertia[0] != family.inertia[1]:
        joint += f", where the PID is worst in [{family.inertia[0]:.3g}, {family.inertia[1]:.3g}]"
    if family.friction:
        joint += f", friction {family.friction:.3g} N m s/rad"
    if family.delay:
        joint += f", delay {1e3 * family.delay:.3g} ms"
    joint = of_slide(joint) if report.is_slide else joint.replace("m^2", "m$^2$")
    state = "" if worst.margins is not None else ": the PID is unstable"
    return f"{figure_text(name)}{state}\n{joint}"


# Looks of the band's ends: where the law is at rest, and the other one.
_DASHES = (0, _BAND.dashes or ())
_AT_REST: dict[str, Any] = {"color": _BAND.color, "linewidth": 1.4, "linestyle": _DASHES}
_MOVING: dict[str, Any] = {"color": _BAND.color, "linewidth": 0.8}


def _handles(family: LoopFamily, lines: _Lines) -> list[Line2D]:
    handles: list[Any] = [Line2D([], [], color=_LINE.color, linewidth=1.8, label="PID (lam = 1)")]
    if lines.band:
        least, largest = family.multipliers[0], family.multipliers[-1]
        label = f"hPID, lam frozen in [{least:.3g}, {largest:.3g}]"
        handles.append(Patch(facecolor=_BAND.tint, edgecolor=_BAND.color, label=label))
        label = f"at rest, lam = {family.at_rest:.3g}"
        handles.append(Line2D([], [], label=label, **_AT_REST))
    if lines.points is not None:
        handles.append(_dots([], [], "measured"))
    return handles


def _draw_ends(panel: Axes, lines: _Lines, x: list[Numbers], y: list[Numbers]) -> None:
    looks = (_MOVING, _AT_REST) if lines.is_greatest_at_rest else (_AT_REST, _MOVING)
    for end, look in zip((0, -1), looks, strict=True):
        panel.plot(x[end], y[end], zorder=3, **look)


def _draw_line(panel: Axes, lines: _Lines, function: Callable[[Complexes], Numbers]) -> None:
    """Draw band, line and points of a function of the open loop."""
    if lines.band:
        values = [function(each) for each in lines.band]
        ends = np.min(values, axis=0), np.max(values, axis=0)
        panel.fill_between(lines.hertz, *ends, color=_BAND.tint, linewidth=0)
        _draw_ends(panel, lines, [lines.hertz] * 2, values)
    panel.plot(lines.hertz, function(lines.pid), color=_LINE.color, linewidth=1.5)
    if lines.points is not None:
        panel.add_line(_dots(lines.points[0], function(lines.points[1])))
    panel.set_xscale("log")
    panel.set_xlim(lines.hertz[0], lines.hertz[-1])


def _dots(x: object, y: object, label: str = "") -> Line2D:
    return Line2D(
        x,  # type: ignore[arg-type]
        y,  # type: ignore[arg-type]
        linestyle="",
        marker="o",
        markersize=3.0,
        markerfacecolor="none",
        markeredgecolor=_MEASURED,
        markeredgewidth=0.7,
        label=label,
        zorder=4,
    )


def _decibel(response: Complexes) -> Numbers:
    return np.asarray(20.0 * np.log10(np.abs(response)))


def _sensitivity(response: Complexes) -> Numbers:
    return np.asarray(1.0 / np.abs(1.0 + response))


def _complementary(response: Complexes) -> Numbers:
    return np.asarray(np.abs(response / (1.0 + response)))


def _phase(response: Complexes) -> Numbers:
    """Return a continuous phase in [deg], between -360 and 0 where the gain is near one."""
    phase = np.unwrap(np.angle(response))
    k = int(np.argmin(np.abs(np.log(np.abs(response)))))
    return np.asarray(np.degrees(phase - math.tau * math.ceil(phase[k] / math.tau)))


def _draw_magnitude(panel: Axes, lines: _Lines, margins: Margins | None) -> None:
    panel.axhline(0.0, color=INK, linewidth=0.8)
    _draw_line(panel, lines, _decibel)
    if margins is not None:
        for factor in (margins.gain_reduction, margins.gain):
            level = -20.0 * math.log10(factor) if 0.0 < factor < math.inf else None
            place = None if level is None else _place_of(lines, level)
            if level is not None and place is not None:
                _arrow(panel, place, (0.0, level), f"GM {-level:+.1f} dB")
    panel.set_title("open loop |L|")
    panel.set_ylabel("|L| [dB]")
    plain_ticks(panel.yaxis, 6)
    log_ticks(panel.xaxis)


def _place_of(lines: _Lines, level: float) -> float | None:
    """Return where the PID's phase is -180 degrees at a gain in [dB], in [Hz]."""
    off = np.abs(_decibel(lines.pid) - level) + np.abs(np.degrees(np.angle(-lines.pid)))
    k = int(np.argmin(off))
    return float(lines.hertz[k]) if off[k] < 5.0 else None


def _arrow(panel: Axes, x: float, ends: tuple[float, float], text: str) -> None:
    """Mark a margin, its text beside the end that is away from the curve."""
    panel.plot([x, x], ends, color=INK, linewidth=1.4, marker="_", markersize=6, zorder=5)
    low, high = panel.get_xlim()
    is_at_the_edge = math.log(x / low) > _EDGE * math.log(high / low)
    panel.annotate(
        text,
        (x, ends[0] + _BESIDE * (ends[1] - ends[0])),
        xytext=(-5 if is_at_the_edge else 5, 0),
        textcoords="offset points",
        ha="right" if is_at_the_edge else "left",
        va="center",
        fontsize=8.5,
        zorder=6,
    )


def _draw_phase(
    panel: Axes, lines: _Lines, margins: Margins | None, extreme: Margins | None
) -> None:
    panel.axhline(-180.0, color=INK, linewidth=0.8)
    _draw_line(panel, lines, _phase_or_points(lines))
    if margins is not None and margins.crossover > 0.0:
        w = margins.crossover / math.tau
        phase = float(np.interp(w, lines.hertz, _phase(lines.pid)))
        _arrow(panel, w, (-180.0, phase), "")
    values = [
        f"{math.degrees(each.phase):.0f}$\\degree$, {symbol}{1e3 * each.delay:.3g} ms ({name})"
        for each, symbol, name in ((margins, "DM ", "PID"), (extreme, "", "band"))
        if each
    ]
    panel.set_title("phase" + (f"; PM {', '.join(values)}" if values else " of L"))
    panel.set_ylabel("phase [deg]")
    panel.set_ylim(max(panel.get_ylim()[0], -360.0), min(panel.get_ylim()[1], 0.0))
    panel.yaxis.set_major_locator(MultipleLocator(45.0))
    log_ticks(panel.xaxis)


def _phase_or_points(lines: _Lines) -> Callable[[Complexes], Numbers]:
    """Return the phase of lines, and of points that which is nearest to the PID's."""
    pid = _phase(lines.pid)

    def phase(response: Complexes) -> Numbers:
        if response.size == lines.hertz.size or lines.points is None:
            return _phase(response)
        near = np.interp(lines.points[0], lines.hertz, pid)
        raw = np.degrees(np.angle(response))
        return np.asarray(raw + 360.0 * np.round((near - raw) / 360.0))

    return phase


def _draw_nyquist(
    panel: Axes, lines: _Lines, margins: Margins | None, extreme: Margins | None
) -> None:
    if margins is not None:
        for fill, order in ((_DISK, 1), ("none", 3.5)):
            disk = _disk(margins)
            disk.set(facecolor=fill, edgecolor=INK, linewidth=0.8, zorder=order)
            panel.add_patch(disk)
    if extreme is not None:
        disk = _disk(extreme)
        disk.set(facecolor="none", edgecolor=_BAND.color, linewidth=1.0, zorder=3.5)
        disk.set_linestyle(_DASHES)
        panel.add_patch(disk)
    for response in lines.band:
        panel.plot(response.real, response.imag, color=_BAND.tint, linewidth=1.6, zorder=2)
    if lines.band:
        real, imaginary = ([getattr(r, part) for r in lines.band] for part in ("real", "imag"))
        _draw_ends(panel, lines, real, imaginary)
    panel.plot(lines.pid.real, lines.pid.imag, color=_LINE.color, linewidth=1.5, zorder=4)
    if lines.points is not None:
        points = lines.points[1]
        panel.add_line(_dots(points.real, points.imag))
    turn = np.linspace(0.0, math.tau, 200)
    panel.plot(np.cos(turn), np.sin(turn), color=INK, linewidth=0.6, linestyle=":", zorder=1)
    panel.plot(-1.0, 0.0, marker="+", color=INK, markersize=9, markeredgewidth=1.6, zorder=6)
    disks = [(each, name) for each, name in ((margins, "PID"), (extreme, "band")) if each]
    words = [f"{each.disk:.2f} ({name})" for each, name in disks]
    panel.set_title("Nyquist plot of L" + ("; disk margins " + ", ".join(words) if words else ""))
    panel.set_xlabel("real part")
    panel.set_ylabel("imaginary part")
    panel.set_xlim(-0.5 - _REACH, -0.5 + _REACH)
    panel.set_ylim(-_REACH, _REACH)
    panel.set_aspect("equal", adjustable="box", anchor="N")
    for axis in (panel.xaxis, panel.yaxis):
        plain_ticks(axis, 6)


def _disk(margins: Margins) -> Circle:
    """Return the circle through the gains that a loop bears by its disk margin, which L avoids."""
    low, high = margins.disk_gain
    left, right = -min(high, _LARGEST_SHOWN), -low
    return Circle((0.5 * (left + right), 0.0), 0.5 * (right - left))


def _draw_peak(
    panel: Axes, lines: _Lines, name: str, margins: Margins | None, extreme: Margins | None
) -> None:
    """Draw a magnitude whose peak is the figure of this name among the margins."""
    title, symbol, function = {
        "sensitivity": ("sensitivity |S|", "$M_s$", _sensitivity),
        "complementary": ("complementary |T|", "$M_t$", _complementary),
    }[name]
    panel.axhline(1.0, color=INK, linewidth=0.8)
    _draw_line(panel, lines, function)
    panel.set_yscale("log")
    found = [(each, color) for each, color in ((margins, INK), (extreme, _BAND.color)) if each]
    highest = max((getattr(each, name) for each, _ in found), default=1.0)
    panel.set_ylim(_LEAST_SHOWN, max(1.8 * highest, 3.0))
    for each, color in found:
        place = getattr(each, f"{name}_at") / math.tau, getattr(each, name)
        panel.plot(*place, marker="o", color=color, markersize=4.5, zorder=6)
    values = [
        f"{getattr(each, name):.2f} ({whose})"
        for each, whose in ((margins, "PID"), (extreme, "band"))
        if each
    ]
    panel.set_title(title + (f"; {symbol} = {', '.join(values)}" if values else ""))
    panel.set_xlabel("frequency [Hz]")
    log_ticks(panel.xaxis)
    log_ticks(panel.yaxis)

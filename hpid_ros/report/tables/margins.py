"""The margins of loops as a person reads them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from hpid_ros.base.units import of_slide
from hpid_ros.frequency.family import FamilyMargins
from hpid_ros.frequency.loop_report import LoopReport
from hpid_ros.frequency.measured import Distance, MeasuredJoint
from hpid_ros.report.tables.wide_table import TableColumn, WideTable

_FIGURES = ("GM [dB]", "PM", "DM [ms]", "DM/T", "alpha", "Ms", "Mt", "BW [Hz]")
_PLACES = ("frozen", "certified mu", "inertia", "friction", "norm", "worst at m", "lam")


class MarginTable:
    """The worst margins of each loop, and below them where, and what is certain."""

    def __init__(self, reports: Mapping[str, LoopReport]) -> None:
        self._reports = reports

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        rows = [row for name, each in self._reports.items() for row in _rows(name, each)]
        names, multipliers, cells = zip(*rows, strict=True)
        yield WideTable(
            [TableColumn("loop", names, True), TableColumn("lam", multipliers)],
            [
                TableColumn(heading, column)
                for heading, column in zip(_FIGURES, zip(*cells, strict=True), strict=True)
            ],
        )
        yield ""
        verdicts = [_verdict_cells(each) for each in self._reports.values()]
        yield WideTable(
            [
                TableColumn("loop", list(self._reports), True),
                TableColumn("certified", [_certified(each) for each in self._reports.values()]),
            ],
            [
                TableColumn(heading, column)
                for heading, column in zip(_PLACES, zip(*verdicts, strict=True), strict=True)
            ],
        )
        yield ""
        for name, each in self._reports.items():
            yield from (Text(f"{name}: {line}", style=style) for line, style in _lines(each))
        yield Text(_legend(self._reports.values()), style="dim")


def _rows(name: str, report: LoopReport) -> list[tuple[str, str, list[str]]]:
    """Return the rows of one loop: name, multipliers, cells."""
    family = report.family
    period = family.settings.timing.control_period
    if not family.is_homogeneous:
        return [(name, "1", _cells(report.pid, period))]
    least, largest = family.multipliers[0], family.multipliers[-1]
    return [
        (name, f"{least:.3g} {largest:.3g}", _cells(report.band, period)),
        ("  at rest", f"{family.at_rest:.3g}", _cells(report.at_rest, period)),
        ("  as PID", "1", _cells(report.pid, period)),
    ]


def _cells(found: FamilyMargins, period: float) -> list[str]:
    worst = found.worst
    if worst is None:
        return ["UNSTABLE", *["-"] * (len(_FIGURES) - 1)]
    return [
        f"{_decibel(worst.gain_reduction)} {_decibel(worst.gain)}",
        _number(math.degrees(worst.phase)),
        _number(1e3 * worst.delay),
        _number(worst.delay / period),
        f"{worst.disk:.2f}",
        f"{worst.sensitivity:.2f}",
        f"{worst.complementary:.2f}",
        _number(worst.bandwidth / math.tau),
    ]


def _decibel(factor: float) -> str:
    if factor == 0.0:
        return "-inf"
    return "+inf" if factor == math.inf else f"{20.0 * math.log10(factor):+.1f}"


def _number(value: float) -> str:
    return "inf" if value == math.inf else f"{value:.3g}"


def _certified(report: LoopReport) -> Text:
    is_certified = report.verdict.is_certified
    return Text("yes", style="green") if is_certified else Text("NO", style="red")


def _verdict_cells(report: LoopReport) -> list[str | Text]:
    family, interval = report.family, report.verdict.interval
    is_stable = report.band.is_stable
    worst = report.band.where["disk"] if is_stable else report.band.unstable[0]
    return [
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
        f"{high:.3g} Hz; as PID L is {100 * apart.median:.2g} % from the computed one in the "
        f"median, {100 * apart.most:.2g} % in 95 of 100; gain of an inertia of "
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

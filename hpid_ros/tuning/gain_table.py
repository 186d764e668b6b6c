"""The verdicts on gains as a table for people."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from hpid_ros.analysis.wide_table import Column, WideTable
from hpid_ros.control.loop_figures import (
    GOOD_SAMPLING_MARGIN,
    LARGEST_SAMPLING_MARGIN,
    LARGEST_SAMPLING_MARGIN_LATE,
)
from hpid_ros.tuning.gain_check import GainVerdict

_HEADINGS = ("mu", "certified mu", "rho", "T kd", "lam", "settles", "inertia")


class GainTable:
    """One row for each loop, and the reasons below.

    Args:
        verdicts: By the name to show.
    """

    def __init__(self, verdicts: Mapping[str, GainVerdict]) -> None:
        self._verdicts = verdicts

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        rows = [_cells(verdict) for verdict in self._verdicts.values()]
        yield WideTable(
            [
                Column("loop", list(self._verdicts), is_text=True),
                Column("ok", [_verdict(verdict) for verdict in self._verdicts.values()], True),
            ],
            [
                Column(heading, cells)
                for heading, cells in zip(_HEADINGS, zip(*rows, strict=True), strict=True)
            ],
        )
        yield ""
        for name, verdict in self._verdicts.items():
            if verdict.reason:
                yield Text(f"{name}: {verdict.reason}", style="red")
            if verdict.sampling_margin > LARGEST_SAMPLING_MARGIN_LATE:
                yield Text(
                    f"{name}: T kd lam / m = {verdict.sampling_margin:.2f}: the sampled loop "
                    f"breaks at {LARGEST_SAMPLING_MARGIN_LATE:g} where an effort comes one period "
                    f"late, as over a topic, and at {LARGEST_SAMPLING_MARGIN:g} at best",
                    style="red",
                )
            elif not verdict.is_sampled_fast_enough:
                yield Text(
                    f"{name}: T kd lam / m = {verdict.sampling_margin:.2f} exceeds "
                    f"{GOOD_SAMPLING_MARGIN}: sampling will be felt",
                    style="yellow",
                )
        yield Text(
            "ok: certified at this mu, on a fine grid, for the unsampled loop without floor or "
            "cap; a loop may well be stable without. rho = m ki / (kp kd); T kd: T kd lam / m, "
            "without a unit; lam = n^mu up to norm 2; settles [s]: an error of error_scale to a "
            "hundredth, at the latest; inertia m [kg m^2].",
            style="dim",
        )


def _cells(verdict: GainVerdict) -> list[str]:
    low, high = verdict.inertia
    interval = "none"
    if verdict.interval is not None:
        interval = f"{verdict.interval[0]:+.3f} {verdict.interval[1]:+.3f}"
    least, largest = verdict.multipliers
    return [
        f"{verdict.degree:+.3f}" if verdict.law == "hpid" else "PID",
        interval,
        f"{verdict.integral_ratio:.3f}",
        f"{verdict.sampling_margin:.3f}",
        "1" if least == largest == 1.0 else f"{least:.2f} {largest:.2f}",
        "-" if verdict.settling_bound is None else f"{verdict.settling_bound:.3g}",
        f"{low:.3g}" if low == high else f"{low:.3g} {high:.3g}",
    ]


def _verdict(verdict: GainVerdict) -> Text:
    if verdict.is_certified:
        return Text("yes", style="green")
    return Text("NO", style="red")

"""``hpid upgrade --verify``: a prediction held against what was recorded before and after."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from hpid_ros.base.errors import SettingError
from hpid_ros.base.foreign_text import shown
from hpid_ros.cli.commands import DONE, FAILED

if TYPE_CHECKING:
    from hpid_ros.report.tables.wide_table import WideTable
    from hpid_ros.road.verification import Held, Verification

_PREDICTION = Path("upgrade.json")


def run_verify(options: argparse.Namespace) -> int:
    """Hold a prediction against two recordings."""
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.road.prediction import read_prediction
    from hpid_ros.road.verification import verify

    given = {
        "FILE or BAG": options.file,
        "--bag": options.bag,
        "--params": options.params,
        "--goal": options.goal,
        "--urdf": options.urdf,
        "-o": options.output,
    }
    beside = [name for name, value in given.items() if value is not None]
    if beside or options.inertia:
        raise SettingError(
            f"--verify BEFORE AFTER takes --prediction and nothing else, not "
            f"{', '.join(beside or ['--inertia'])}"
        )
    prediction = read_prediction(options.prediction or _PREDICTION)
    before, after = options.verify
    found = verify(prediction, before, after)
    console = output_console()
    console.print(_table(found))
    console.print("over what was recorded before; off: measured over predicted", style="dim")
    console.print("")
    for line in found.warnings:
        console.print(f"! {shown(line)}", style="yellow", highlight=False, markup=False)
    console.print(_verdict(found))
    return DONE if found.is_held else FAILED


def _table(found: Verification) -> WideTable:
    from hpid_ros.analysis.quantities import INDICES
    from hpid_ros.report.tables.wide_table import TableColumn, WideTable

    rows = [*found.joints.values(), found.totals]
    columns: list[TableColumn] = []
    for index in INDICES:
        each = [row[index.key] for row in rows]
        columns += [
            TableColumn(f"{index.symbol} predicted", [_number(held.predicted) for held in each]),
            TableColumn("measured", [_number(held.measured) for held in each]),
            TableColumn("off", _off(each)),
        ]
    names = TableColumn("joint", [*map(shown, found.joints), "all"], is_text=True)
    return WideTable([names], columns)


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "–"


def _off(each: Sequence[Held]) -> list[str | Text]:
    return [
        Text(f"{held.off:+.1%}", style="green" if held.is_held else "red")
        if math.isfinite(held.off)
        else "–"
        for held in each
    ]


def _verdict(found: Verification) -> Text:
    from hpid_ros.road.verification import HOLDS_WITHIN, JUDGED

    judged = [found.totals[index.key] for index in JUDGED]
    told = ", ".join(
        f"{index.symbol} {held.off:+.1%}" if math.isfinite(held.off) else f"{index.symbol} unknown"
        for index, held in zip(JUDGED, judged, strict=True)
    )
    if found.is_held:
        return Text(f"The prediction held, within {HOLDS_WITHIN:.0%}: {told}.", style="green")
    return Text(f"The prediction did NOT hold within {HOLDS_WITHIN:.0%}: {told}.", style="red")

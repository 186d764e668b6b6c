"""Puts the tables of docs/experiments.md in place, from what the package itself declares.

python tools/make_experiment_tables.py

Every table stands in the page between ``<!-- begin NAME -->`` and ``<!-- end NAME -->``; only what
is between is written. The suite says when the page is not what this writes.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hpid_ros.base.schema import TableRow, table  # noqa: E402
from hpid_ros.motion.references import (  # noqa: E402
    BrickTask,
    Oscillations,
    PathSection,
    Waypoints,
)
from hpid_ros.robot.amendments import RobotSection  # noqa: E402
from hpid_ros.simulation.drives import DriveSettings  # noqa: E402
from hpid_ros.simulation.settings import Disturbances, Sensor, Workplace  # noqa: E402
from hpid_ros.simulation.world_file import (  # noqa: E402
    ControlSection,
    MeasuredSection,
    PhysicsSection,
)

PAGE = ROOT / "docs" / "experiments.md"
BLOCK = re.compile(r"<!-- begin (?P<name>[^>]*?) -->\n(?P<body>.*?)<!-- end (?P=name) -->\n", re.S)
TABLES = {
    "robot": [(RobotSection, "robot.")],
    "control": [(ControlSection, "control."), (PhysicsSection, "simulation.")],
    "sensors": [(Sensor, "sensors."), (MeasuredSection, "sensors.")],
    "actuators": [(DriveSettings, "actuators.")],
    "disturbances": [(Disturbances, "disturbances.")],
    "scene": [(Workplace, "scene.")],
    "waypoints": [(Waypoints, "reference.")],
    "sine": [(Oscillations, "reference.")],
    "base_path": [(PathSection, "reference.")],
    "bricks": [(BrickTask, "reference.")],
}


def page(text: str) -> str:
    """Return the page with its tables in place."""
    return BLOCK.sub(_block, text)


def _block(match: re.Match[str]) -> str:
    name = match["name"]
    rows = [row for kind, prefix in TABLES[name] for row in table(kind, prefix)]
    return f"<!-- begin {name} -->\n{_markdown(rows)}<!-- end {name} -->\n"


def _markdown(rows: Iterable[TableRow]) -> str:
    lines = ["| key | default | range | meaning |", "|---|---|---|---|"]
    lines += [f"| `{row.key}` | {row.default} | {row.range} | {row.meaning} |" for row in rows]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")

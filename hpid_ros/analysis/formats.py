"""A comparison as text, in the format that was asked for."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

from hpid_ros.analysis.comparison import Comparison
from hpid_ros.analysis.table import table_text
from hpid_ros.analysis.table_export import table_csv, table_latex


def table_json(comparison: Comparison) -> str:
    """Return runs and ratios as JSON."""
    return json.dumps(comparison.as_mapping(), indent=2) + "\n"


FORMATS: Mapping[str, Callable[[Comparison], str]] = {
    "table": table_text,
    "csv": table_csv,
    "json": table_json,
    "latex": table_latex,
}
"""What writes a comparison, by the format's name."""

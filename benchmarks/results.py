"""The file of a machine's figures."""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks.figures import Middle, Outcome
from hpid_bench.experiment.result_folder import versions
from hpid_ros.base.rounding import significant

_LIBRARIES = {"rclpy": ("ros-jazzy-rclpy", "rclpy"), "simple_pid": ("simple-pid",)}
_DIGITS = 6


def machine() -> dict[str, Any]:
    """Return CPU model, number of cores and operating system, without its release or a name."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        found = re.search(r"^model name\s*:\s*(.+)$", info.read_text(), re.MULTILINE)
        model = found.group(1).strip() if found else model
    cores = len(os.sched_getaffinity(0))
    return {"cpu": model, "cores": cores, "system": platform.system()}


def slug() -> str:
    """Return a short name of this machine's kind, for instance ``amd_epyc_7763_2_cores``."""
    facts = machine()
    words = re.sub(r"\((?:r|tm)\)|\bcpu\b|@.*", " ", facts["cpu"].lower())
    return f"{re.sub(r'[^a-z0-9]+', '_', words).strip('_')}_{facts['cores']}_cores"


def all_versions() -> dict[str, str]:
    """Return the versions of everything that takes part, the peers included."""
    found = versions()
    for name, distributions in _LIBRARIES.items():
        for distribution in distributions:
            try:
                found.setdefault(name, metadata.version(distribution))
            except metadata.PackageNotFoundError:
                continue
    return found


def document(outcomes: Sequence[Outcome], before: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return what the file holds."""
    facts = {"machine": machine(), "versions": all_versions()}
    kept = {}
    if before is not None and all(before.get(key) == value for key, value in facts.items()):
        kept = dict(before.get("figures", {}))
    kept |= {outcome.figure.name: _entry(outcome) for outcome in outcomes}
    return {**facts, "figures": dict(sorted(kept.items()))}


def write(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Put figures into a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    before = json.loads(path.read_text()) if path.is_file() else None
    path.write_text(json.dumps(document(outcomes, before), indent=2) + "\n", encoding="utf-8")


def _entry(outcome: Outcome) -> dict[str, Any]:
    return {
        "ours": _rounded(outcome.ours.median),
        "reference": _rounded(outcome.reference.median),
        "ratio": _rounded(outcome.ratio.median),
        "unit": outcome.figure.unit,
        "against": outcome.figure.against,
        "spread": {
            "ours": _range(outcome.ours),
            "reference": _range(outcome.reference),
            "ratio": _range(outcome.ratio),
        },
        "rounds": outcome.rounds,
        "target": [str(bound) for bound in outcome.figure.bounds],
        "met": outcome.is_met,
        "beside": {name: _rounded(value) for name, value in outcome.beside.items()},
    }


def _range(values: Middle) -> list[float]:
    return [_rounded(values.low), _rounded(values.high)]


def _rounded(value: float) -> float:
    return significant(value, _DIGITS)

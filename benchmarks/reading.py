"""From a bag to arrays, against rosbags deserialising it and against reading its bytes."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path

from benchmarks.bag_speed import in_own_process
from benchmarks.figures import Bound, Figure, Group, Measure, Source

_MINUTES, _MINUTES_QUICK = 2.0, 0.1
_ROUNDS_AT_MOST = 3  # rosbags takes ten seconds and more a turn
_KINDS = {
    "mcap": ("mcap", "none"),
    "mcap_zstd": ("mcap", "storage"),
    "sqlite3": ("sqlite3", "none"),
}


def group(quick: bool) -> Group:
    """Return the figures of reading.

    Args:
        quick: Whether a short bag will do.
    """
    minutes = _MINUTES_QUICK if quick else _MINUTES
    contenders: dict[str, Measure] = {}
    figures = []
    for kind in _KINDS:
        for name in ("arrays", "messages", "bytes"):
            contenders[f"{name}, {kind}"] = partial(_turn, name, kind, minutes)
        figures += _figures(kind)
    return Group(contenders, tuple(figures), rounds_at_most=_ROUNDS_AT_MOST)


def _figures(kind: str) -> list[Figure]:
    arrays = f"arrays, {kind}"
    return [
        Figure(
            f"bags.{kind}",
            "messages/s",
            Source(arrays, "rate"),
            Source(f"messages, {kind}", "rate"),
            "rosbags deserialising every message",
            (Bound("ratio", least=20.0),),
            ("peak",),
        ),
        Figure(
            f"bags.{kind}.bytes",
            "s",
            Source(arrays, "seconds"),
            Source(f"bytes, {kind}", "seconds"),
            "reading and decompressing the file, which the page cache holds",
            (Bound("ratio", most=2.0),),
        ),
    ]


@cache
def _bag(kind: str, minutes: float) -> tuple[Path, tempfile.TemporaryDirectory[str]]:
    """Return a generated bag, and the folder that must live as long."""
    storage, compression = _KINDS[kind]
    folder = tempfile.TemporaryDirectory(prefix="hpid_bench_")
    bag = Path(folder.name) / "bag"
    generator = Path(__file__).with_name("generate_bag.py")
    command = [sys.executable, str(generator), str(bag), "--minutes", str(minutes)]
    command += ["--storage", storage, "--compression", compression]
    subprocess.run(command, check=True, capture_output=True)
    return bag, folder


def _turn(name: str, kind: str, minutes: float) -> Mapping[str, float]:
    """Let one contender read the bag in a process of its own."""
    result = in_own_process(name, _bag(kind, minutes)[0], is_cold=False)
    return {
        "seconds": result["cpu"],
        "rate": result["count"] / result["cpu"],
        "peak": result["peak"],
    }

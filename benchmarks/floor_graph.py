"""The floor: what the transport alone allows, in the closed loop's shape and environment."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.processes import Scripts
from hpid_ros.base.errors import RunError
from hpid_ros.experiment.graph_run import PROCESSES
from hpid_ros.experiment.processes import closed_environment, own_domain

_WITHIN = 120.0  # [s] for a whole run
_ASKER = "asker"


def run_floor(
    joints: Sequence[str],
    processes: str,
    cycles: int,
    is_timing: bool = False,
    has_physics: bool = False,
) -> Mapping[str, float]:
    """Run the echo graph once.

    Args:
        joints: One echo node for each.
        processes: ``each``, ``composed`` or ``single``, as for the closed loop.
        cycles: Cycles to count.
        is_timing: Whether to measure the latency of the answers too.
        has_physics: Whether the publisher steps the paper's robot once a cycle.

    Returns:
        ``rate`` in cycles per second; ``latency``, the median from a state's publication to the
        arrival of an answer, in [us], when asked for; ``repeats``, how often it began anew
        because a message was lost.

    Raises:
        RunError: A process failed, or the cycles were not completed in time.
    """
    ask = ["--ask", *joints, "--cycles", str(cycles), *(["--latency"] if is_timing else [])]
    ask += ["--physics"] if has_physics else []
    with (
        tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder,
        own_domain() as domain,
        Scripts(closed_environment(domain), Path(folder), is_batch=True) as scripts,
    ):
        for name, arguments in _echoes(joints, processes).items():
            scripts.start(name, "floor", arguments)
        together = ["--echo", *joints] if processes == "single" else []
        scripts.start(_ASKER, "floor", [*ask, *together])
        result = scripts.result(_ASKER, _WITHIN)
    if result["cycles"] != cycles:
        raise RunError(f"the echo graph counted {result['cycles']} cycles of {cycles}")
    return {name: float(value) for name, value in result.items()}


def _echoes(joints: Sequence[str], processes: str) -> dict[str, list[str]]:
    """Return the arguments of the processes that hold nothing but echo nodes."""
    if processes == "each":
        return {f"echo_{joint}": ["--echo", joint] for joint in joints}
    if processes == "composed":
        return {"echoes": ["--echo", *joints]}
    if processes == "single":
        return {}
    raise ValueError(f"processes must be one of {', '.join(PROCESSES)}, not {processes!r}")

"""The closed loop in plain rclpy: nine processes, the same physics, nothing done for speed."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from benchmarks.processes import Scripts
from benchmarks.tracking import tracking
from hpid_ros.base.errors import RunError
from hpid_ros.experiment.processes import closed_environment, own_domain

_WITHIN = 300.0  # [s] for a whole run
_LARGEST_ERROR = 0.1  # [rad] at the end of a run; without control a joint is 0.3 rad away
_SETTLED_AFTER = 1.0  # [s], from when on the error is looked at
_ROBOT = "robot"


def run_naive(seconds: float) -> Mapping[str, float]:
    """Run the naive closed loop once, one physics step in each control period.

    Args:
        seconds: Simulated time in [s].

    Returns:
        ``rate`` in states per second.

    Raises:
        RunError: A process failed, a state was lost, or the joints are not where they should be.
    """
    experiment = tracking()
    with (
        tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder,
        own_domain() as domain,
        Scripts(closed_environment(domain), Path(folder)) as scripts,
    ):
        for joint in experiment.world.joints:
            scripts.start(joint, "naive", ["--control", joint])
        scripts.start(_ROBOT, "naive", ["--simulate", "--seconds", str(seconds)])
        result = scripts.result(_ROBOT, _WITHIN)
    expected = round(seconds * 1e9 / experiment.world.control_period_ns) + 1
    if result["states"] != expected:
        raise RunError(f"the naive loop had {result['states']} states, not {expected}")
    if seconds >= _SETTLED_AFTER and result["largest_error"] > _LARGEST_ERROR:
        raise RunError(f"the naive loop does not control: {result['largest_error']:.3f} rad away")
    return {"rate": float(result["rate"])}

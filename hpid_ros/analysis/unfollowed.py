"""Joints that did not follow their reference: their ratios compare two failures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hpid_ros.analysis.series import JointSeries, RunSeries

SMALL = 0.05
"""An error below this is small for any joint, in [rad]."""
SHARE_OF_RANGE = 0.1
"""So is one below this share of the reference's range."""
SELDOM = 0.1
"""A joint follows if its error is small for at least this share of its motion."""


def unfollowed(run: RunSeries) -> dict[str, float]:
    """Return the joints whose error was small hardly ever, from where the reference moved on.

    Args:
        run: The run.

    Returns:
        By joint, the error that it exceeded nearly always, in [rad]; of joints with a reference.
    """
    told = [series for series in run.joints if series.reference.size]
    least = {series.joint: _usual_least(series) for series in told}
    allowed = {
        series.joint: max(SMALL, SHARE_OF_RANGE * float(np.ptp(series.reference)))
        for series in told
    }
    return {joint: error for joint, error in least.items() if error > allowed[joint]}


def unfollowed_lines(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield a line for each run with joints that did not follow.

    Args:
        runs: The runs.
    """
    for run in runs:
        joints = unfollowed(run)
        if joints:
            shown = ", ".join(f"{joint} ({error:.3g} rad)" for joint, error in joints.items())
            yield (
                f"run {run.label!r}: these joints do not follow their reference, and their ratios "
                f"say nothing of the controller: {shown}; in brackets the error that they exceed "
                f"{1 - SELDOM:.0%} of the time"
            )


def unfollowed_mapping(runs: Sequence[RunSeries]) -> Mapping[str, Mapping[str, float]]:
    """Return :func:`unfollowed` by label, of the runs that have such joints."""
    found = {run.label: unfollowed(run) for run in runs}
    return {label: joints for label, joints in found.items() if joints}


def _usual_least(series: JointSeries) -> float:
    moved = np.flatnonzero(series.reference != series.reference[0])
    error = np.abs(series.error[moved[0] :] if moved.size else series.error)
    return float(np.quantile(error, SELDOM))

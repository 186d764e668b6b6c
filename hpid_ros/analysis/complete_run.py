"""A run in which every state was answered, as lock-step in one process gives it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from hpid_ros.analysis.series import JointSeries, RunSeries


def complete_run(
    label: str,
    joints: Sequence[str],
    stamps_ns: NDArray[np.int64],
    columns: Iterable[NDArray[np.float64]],
) -> RunSeries:
    """Return the series of a run without losses.

    Args:
        label: Name of the run.
        joints: Names of the K joints.
        stamps_ns: Stamps of all states and commands, (N,), in [ns].
        columns: Positions [rad], references [rad] and efforts [N m], each (N, K).

    Raises:
        SeriesError: As for :class:`RunSeries` and :class:`JointSeries`.
    """
    positions, references, efforts = columns
    return RunSeries(
        label,
        tuple(
            JointSeries(
                joint, stamps_ns, positions[:, k], references[:, k], stamps_ns, efforts[:, k]
            )
            for k, joint in enumerate(joints)
        ),
    )

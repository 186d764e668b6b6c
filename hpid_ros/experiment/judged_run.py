"""A run that studies and searches judge: its indices, and whether it has settled at its end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hpid_ros.analysis import RunIndices, RunSeries
from hpid_ros.analysis.quantities import EFFORT_L2, ERROR_L2, IAVC, ITAE, IVC, Fold, Quantity
from hpid_ros.analysis.results import JointIndices
from hpid_ros.experiment.simulated_run import RunTask

PAPER_QUANTITIES = (IVC, IAVC, ITAE, EFFORT_L2, ERROR_L2)
"""The indices of the paper's Table I."""

LAST = 1.0
"""How much of the end of a run is looked at, in [s]; all of a shorter one."""

LAST_ERROR = Quantity(
    "last_error", "last |e|", "rad", "largest error of the last second", Fold.WORST, 1
)


@dataclass(frozen=True)
class JudgedTask(RunTask):
    """A run whose numbers have :data:`LAST_ERROR` beside the indices."""

    def numbers(self, run: RunSeries) -> RunIndices:
        """Return the indices and the largest error of the last second.

        Args:
            run: The series of all joints.
        """
        indices = super().numbers(run)
        errors = {series.joint: series for series in run.joints if series.joint in indices.joints}
        last = {}
        for joint, series in errors.items():
            is_last = series.time >= series.time[-1] - LAST
            last[joint] = float(np.abs(series.error[is_last]).max())
        return replace(
            indices,
            joints={joint: _with(each, last[joint]) for joint, each in indices.joints.items()},
            totals=_with(indices.totals, max(last.values())),
            quantities=(*indices.quantities, LAST_ERROR),
        )


def _with(indices: JointIndices, last: float) -> JointIndices:
    further: Mapping[str, float] = {**indices.further, LAST_ERROR.key: last}
    return replace(indices, further=further)

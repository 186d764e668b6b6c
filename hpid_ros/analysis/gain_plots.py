"""How a homogeneous loop's gains moved: the norm of its error, and the multiplier they got."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from hpid_ros.analysis.panels import joint_panels
from hpid_ros.analysis.plot_style import figure_style
from hpid_ros.analysis.series import JointSeries, RunSeries
from hpid_ros.analysis.signals import Gains, Signal

# Zero has no place on a logarithmic axis.
LEAST_NORM = 1e-6


@figure_style()
def norm_figure(runs: Sequence[RunSeries], gains: Gains, buckets: int) -> Figure:
    """Return the homogeneous norm over time, one panel a joint, its axis logarithmic.

    Args:
        runs: Runs whose gains are known, the baseline first.
        gains: What their laws did.
        buckets: Detail of each line.

    Raises:
        SeriesError: If there is no run, or the runs' joints differ.
    """

    def norm_of(run: RunSeries, series: JointSeries) -> Signal:
        stamps_ns, values = gains[run.label][series.joint].norm
        return Signal(stamps_ns, np.maximum(values, LEAST_NORM))

    return joint_panels(runs, "homogeneous norm", norm_of, buckets, level=None, is_log=True)


@figure_style()
def multiplier_figure(runs: Sequence[RunSeries], gains: Gains, buckets: int) -> Figure:
    """Return the gain multiplier over time, one panel a joint; see :func:`norm_figure`."""

    def multiplier_of(run: RunSeries, series: JointSeries) -> Signal:
        return gains[run.label][series.joint].multiplier

    # One is the linear PID.
    return joint_panels(runs, "gain multiplier", multiplier_of, buckets, level=1.0)

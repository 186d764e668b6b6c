"""From the arrays of a run to numbers, tables, figures and a report; no bag, no ROS.

The numbers come from :mod:`~hpid_ros.recordings.series`, :mod:`~hpid_ros.analysis.indices.run` and
:mod:`~hpid_ros.analysis.comparison`, which need numpy alone and are offered here. The drawing
modules import matplotlib and rich and are imported by their own names.
"""

from hpid_ros.analysis.comparison import Comparison, answer
from hpid_ros.analysis.indices.run import joint_indices, run_indices
from hpid_ros.analysis.results import JointIndices, RunIndices
from hpid_ros.recordings.series import JointSeries, Losses, RunSeries, SeriesError

__all__ = [
    "Comparison",
    "JointIndices",
    "JointSeries",
    "Losses",
    "RunIndices",
    "RunSeries",
    "SeriesError",
    "answer",
    "joint_indices",
    "run_indices",
]

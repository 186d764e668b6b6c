"""The indices of recordings, for Python: bags in, numbers and a comparison out.

:func:`measure` reads one recording, :func:`compare` lays several side by side. The command
``hpid metrics``, the node ``bag_metrics`` and the result of an experiment are made of them.
"""

from hpid_ros.messages.series import JointSeries, Losses, RunSeries, SeriesError
from hpid_ros.metrics.comparison import Comparison, answer
from hpid_ros.metrics.measure import (
    Measured,
    Measuring,
    Summary,
    compare,
    measure,
    measure_all,
    summary,
)
from hpid_ros.metrics.results import RunIndices
from hpid_ros.metrics.run_numbers import joint_indices, run_indices

__all__ = [
    "Comparison",
    "JointSeries",
    "Losses",
    "Measured",
    "Measuring",
    "RunIndices",
    "RunSeries",
    "SeriesError",
    "Summary",
    "answer",
    "compare",
    "joint_indices",
    "measure",
    "measure_all",
    "run_indices",
    "summary",
]

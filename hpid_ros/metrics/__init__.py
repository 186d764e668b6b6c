"""The indices of recordings, for Python: bags in, numbers and a comparison out.

:func:`measure` reads one recording, :func:`compare` lays several side by side. The command
``hpid metrics``, the node ``bag_metrics`` and the result of an experiment are made of them.
"""

from hpid_ros.metrics.compare import Summary, compare, summary
from hpid_ros.metrics.measure import Measured, Measuring, measure, measure_all

__all__ = [
    "Measured",
    "Measuring",
    "Summary",
    "compare",
    "measure",
    "measure_all",
    "summary",
]

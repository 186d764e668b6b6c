"""Computes the indices of recorded bags, prints them and publishes them latched."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.parameter import Parameter

from hpid_ros.analysis import Comparison
from hpid_ros.analysis.formats import FORMATS
from hpid_ros.analysis.indices import INDICES, NORMS
from hpid_ros.bags.comparison import compare_bags
from hpid_ros.errors import SettingError, unknown_name
from hpid_ros.nodes import executor
from hpid_ros.nodes.parameters import read_only
from hpid_ros.nodes.qos import LATCHED


class BagMetrics(executor.ClosingNode):
    """Reads the bags of its parameters once, prints the table, and offers the numbers.

    Raises:
        HpidError: No bag was named, or one cannot be read.
    """

    def __init__(self) -> None:
        super().__init__("bag_metrics")
        bags = read_only(
            self, "bags", Parameter.Type.STRING_ARRAY, "Bags to read; the first is the baseline"
        )
        if not bags:
            raise SettingError("the parameter bags must name at least one bag, it is empty")
        labels = read_only(
            self,
            "labels",
            Parameter.Type.STRING_ARRAY,
            "One for each bag; folder names if left out",
        )
        joints = read_only(
            self, "joints", Parameter.Type.STRING_ARRAY, "Only these joints; all if left out"
        )
        form = str(read_only(self, "format", "table", f"Of the output: {', '.join(FORMATS)}"))
        if form not in FORMATS:
            raise SettingError(f"format: {unknown_name('format', form, FORMATS)}")
        stays = read_only(
            self, "keep_running", False, "Stay, with the result latched on ~/indices"
        )
        comparison = compare_bags([Path(bag) for bag in bags], labels or (), joints)
        print(FORMATS[form](comparison), end="", flush=True)
        self._publisher = self.create_publisher(DiagnosticArray, "~/indices", LATCHED)
        self._publisher.publish(indices_message(comparison))
        if not stays:
            self.create_timer(0.0, self.request_stop)


def indices_message(comparison: Comparison) -> DiagnosticArray:
    """Return the indices as one status for each run and joint, and one for each run.

    Args:
        comparison: The numbers; keys carry the units.
    """
    array = DiagnosticArray()
    for run in comparison.runs:
        for joint in comparison.joint_names:
            values = [
                KeyValue(key=f"{q.symbol} [{q.unit}]", value=repr(run.value(q, joint)))
                for q in INDICES
            ]
            array.status.append(
                DiagnosticStatus(name=f"{run.label}: {joint}", hardware_id=joint, values=values)
            )
        values = [KeyValue(key=f"{q.symbol} [{q.unit}]", value=repr(run.value(q))) for q in NORMS]
        array.status.append(DiagnosticStatus(name=f"{run.label}: all joints", values=values))
    return array


def main(args: Sequence[str] | None = None) -> int:
    """Run the metrics."""
    return executor.run(lambda: [BagMetrics()], args)


if __name__ == "__main__":
    sys.exit(main())

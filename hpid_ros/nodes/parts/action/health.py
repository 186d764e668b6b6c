"""An action server's health: what became of goals, and who else is there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rclpy.node import Node

from hpid_ros.goals import CANCELLED, Result, ResultCode
from hpid_ros.nodes.ros.status import ERROR, OK, WARN, Diagnostics


class GoalHealth:
    """Counts goals and what could not be used, and publishes the status."""

    period = 1.0

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self._node = node
        self._diagnostics = Diagnostics(node, ", ".join(joints))
        self.fault = self._diagnostics.fault
        self._counts: Counter[str] = Counter()
        self.misread = self.stood_still = 0
        self._last_result = ""

    def note(self, result: Result) -> None:
        """Note how a goal ended, and log it where it did not succeed."""
        self._counts["cancelled" if result is CANCELLED else result.code.name.lower()] += 1
        self._last_result = result.text
        logger = self._node.get_logger()
        if result.code is ResultCode.SUCCESSFUL:
            logger.info(f"goal ended: {result.text}")
            return
        self._last_result = f"{result.code.name.lower()}: {result.text}"
        logger.warning(f"goal ended: {self._last_result}", throttle_duration_sec=0.1)

    def misread_message(self, line: str) -> None:
        """Note bytes that could not be read."""
        self.misread += 1
        self.fault(line)

    def report(
        self, course: str, against: str, warnings: Sequence[str], values: dict[str, object]
    ) -> None:
        """Publish the status now."""
        level = ERROR if against else WARN if warnings else OK
        self._diagnostics.publish(
            level,
            "; ".join([f"no goal can be followed: {against}" if against else course, *warnings]),
            {
                "goals reached": self._counts["successful"],
                "goals cancelled": self._counts["cancelled"],
                **{
                    f"goals ended by {code.name.lower()}": self._counts[code.name.lower()]
                    for code in ResultCode
                    if code is not ResultCode.SUCCESSFUL
                },
                "last goal": self._last_result or "none",
                "refused messages": self.misread,
                "times stood still": self.stood_still,
                **values,
                "last fault": self._diagnostics.last_fault,
            },
        )

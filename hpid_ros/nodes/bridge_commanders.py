"""Who commands which joint: two controllers on one joint are found out and named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node

from hpid_ros.names import controller_name
from hpid_ros.simulation.lockstep import AnswerCounts


class Commanders:
    """Watches the answers for joints that more than one publisher commands.

    The middleware does not say who sent a serialised message. But one controller answers each
    state once; a second one gives itself away by answers that differ, and the graph knows the
    names of all that publish commands.

    Args:
        node: The bridge.
        joints: The driven joints.
        counts: What each joint's controller did, by joint; kept up to date by others.
    """

    def __init__(
        self, node: Node, joints: Sequence[str], counts: Mapping[str, AnswerCounts]
    ) -> None:
        self._node = node
        self._counts = counts
        self._reported = dict.fromkeys(joints, 0)
        self._topic = node.resolve_topic_name("joint_commands")

    def conflict(self) -> str:
        """Return one line about the conflicts since the last call; empty if there were none."""
        lines = []
        for joint, before in self._reported.items():
            now = self._counts[joint].conflicting
            self._reported[joint] = now
            if now > before:
                lines.append(f"{joint} by {' and '.join(self._suspects(joint))}")
        return f"commanded twice: {'; '.join(lines)}" if lines else ""

    def values(self) -> dict[str, Any]:
        """Return the counts of all joints for ``/diagnostics``."""
        counts = self._counts.values()
        return {
            "unanswered": sum(count.unanswered for count in counts),
            "answers to earlier states": sum(count.stale for count in counts),
            "commands not finite": sum(count.invalid for count in counts),
            "commands beyond the joint's limit": sum(count.excessive for count in counts),
            "conflicting commands": sum(count.conflicting for count in counts),
        }

    def _suspects(self, joint: str) -> list[str]:
        """Return the publishers of commands but the controllers of other joints."""
        others = {controller_name(each) for each in self._reported if each != joint}
        infos = self._node.get_publishers_info_by_topic(self._topic)
        names = sorted(
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            for info in infos
            if info.node_name not in others
        )
        return names or ["publishers that the graph does not know"]

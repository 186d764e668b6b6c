"""Who commands which joint: a second sender is found out, not obeyed, and named."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import compress
from typing import Any

from rclpy.node import Node

from hpid_ros.names import controller_name
from hpid_ros.nodes.commands import node_of
from hpid_ros.simulation.followed import FollowedSender
from hpid_ros.simulation.lockstep import AnswerCounts


class Commanders:
    """Follows one sender a joint, and reports joints that have more than one.

    A joint follows who commanded it first, until that one is silent. Our controllers say in each
    command who they are (:func:`~hpid_ros.nodes.commands.sender_of`); the middleware does not, in
    rclpy of Jazzy. All who say nothing are one sender: two of them are both obeyed, give
    themselves away by answers that differ, and are named as far as the graph knows them.

    Args:
        node: The bridge.
        joints: The driven joints.
        counts: What each joint's controller did, by joint; kept up to date by others.
        patience: The longest silence of the one that is followed, in [s].
    """

    def __init__(
        self,
        node: Node,
        joints: Sequence[str],
        counts: Mapping[str, AnswerCounts],
        patience: float,
    ) -> None:
        self._node = node
        self._counts = counts
        self._topic = node.resolve_topic_name("joint_commands")
        self._patience = patience
        self._followed = {joint: FollowedSender(patience) for joint in joints}
        self._reported = dict.fromkeys(joints, (0, 0))
        self._moved = 0.0

    def heed(
        self, names: tuple[str, ...], efforts: tuple[float, ...], sender: str
    ) -> tuple[tuple[str, ...], tuple[float, ...]]:
        """Return what is to be obeyed of a command.

        Args:
            names: Its joints.
            efforts: Their efforts in [N m].
            sender: Who sent it.
        """
        now = time.perf_counter()
        if len(names) == 1:
            followed = self._followed.get(names[0])
            if followed is None or followed.takes(sender, efforts[0], now):
                return names, efforts
            return (), ()
        taken = []
        for name, effort in zip(names, efforts, strict=True):
            followed = self._followed.get(name)
            taken.append(followed is None or followed.takes(sender, effort, now))
        return tuple(compress(names, taken)), tuple(compress(efforts, taken))

    def move(self) -> None:
        """Note that a state is about to be published; after a standstill nobody is silent yet."""
        now = time.perf_counter()
        if now - self._moved > self._patience:
            for followed in self._followed.values():
                followed.wait(now)
        self._moved = now

    def conflict(self) -> str:
        """Return one line about the conflicts since the last call; empty if there were none."""
        lines = []
        for joint, before in self._reported.items():
            followed = self._followed[joint]
            now = followed.others, self._counts[joint].conflicting
            self._reported[joint] = now
            if now[0] > before[0]:
                names = [self._name(joint, each) for each in (followed.sender, followed.other)]
                lines.append(f"{joint} by {' and '.join(names)}, following {names[0]}")
            elif now[1] > before[1]:
                lines.append(f"{joint} by {self._name(joint, '')}, following the newest")
        return f"commanded twice: {'; '.join(lines)}" if lines else ""

    def values(self) -> dict[str, Any]:
        """Return the counts of all joints for ``/diagnostics``."""
        counts, followed = self._counts.values(), self._followed.values()
        return {
            "unanswered": sum(count.unanswered for count in counts),
            "answers to earlier states": sum(count.stale for count in counts),
            "commands not finite": sum(count.invalid for count in counts),
            "commands beyond the joint's limit": sum(count.excessive for count in counts),
            "conflicting commands": sum(count.conflicting for count in counts),
            "commands of second senders, not obeyed": sum(each.others for each in followed),
            "changes of sender": sum(each.changes for each in followed),
        }

    def _name(self, joint: str, sender: str | None) -> str:
        """Return the node that a sender is, as far as that is known.

        Who does not say so is one of those that publish commands, and neither the controller of
        another joint nor one that has said so.
        """
        if sender:
            return node_of(sender)
        others = {controller_name(each) for each in self._reported if each != joint}
        known = {self._followed[joint].sender, self._followed[joint].other} - {None, ""}
        rest = [name for name in self._publishers() if name.rpartition("/")[2] not in others]
        for name in map(node_of, filter(None, known)):
            if name in rest:
                rest.remove(name)
        return " and ".join(rest) or "a publisher that the graph does not know"

    def _publishers(self) -> list[str]:
        infos = self._node.get_publishers_info_by_topic(self._topic)
        return sorted(f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos)

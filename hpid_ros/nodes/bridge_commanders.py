"""Who commands which joint: a second publisher is found out, not obeyed, and named."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import compress
from typing import Any

from rclpy.node import Node

from hpid_ros.names import controller_name
from hpid_ros.simulation.followed import FollowedPublisher
from hpid_ros.simulation.lockstep import AnswerCounts

_PATIENCE = 0.2  # [s]; a process that is restarted takes longer until it commands


class Numbered:
    """A subscription's callback that gets each message with its number at its publisher.

    rclpy's executors hand over what they know of a message as a second argument, or both as one
    pair (``EventsExecutor`` in Jazzy), and ask the signature whether they shall.

    Args:
        callback: Called with the message and its number; None where the middleware has none.
    """

    __signature__ = inspect.Signature(
        [
            inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY)
            for name in ("message", "about")
        ]
    )

    def __init__(self, callback: Callable[[Any, int | None], None]) -> None:
        self._callback = callback

    def __call__(self, *received: Any) -> None:
        """Take a message."""
        message, about = received if len(received) == 2 else received[0]
        self._callback(message, about["publication_sequence_number"])


class Commanders:
    """Follows one publisher a joint, and reports joints that have more than one.

    A joint follows the publisher that commanded it first, until that one is silent or leaves with
    an effort of zero. Where the middleware has no numbers everybody is obeyed, and a second one
    gives itself away by answers that differ.

    Args:
        node: The bridge.
        joints: The driven joints.
        counts: What each joint's controller did, by joint; kept up to date by others.
        patience: The longest silence of the one that is followed, in [s]; at most 0.2 s.
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
        self._patience = min(patience, _PATIENCE)
        self._followed = {joint: FollowedPublisher(self._patience) for joint in joints}
        self._reported = dict.fromkeys(joints, 0)
        self._changes = dict.fromkeys(joints, 0)
        self._names: dict[str, str] = {}  # of those that are followed, where that is known
        self._moved = 0.0

    def heed(
        self, names: tuple[str, ...], efforts: tuple[float, ...], number: int | None
    ) -> tuple[tuple[str, ...], tuple[float, ...]]:
        """Return what is to be obeyed of a command.

        Args:
            names: Its joints.
            efforts: Their efforts in [N m].
            number: Of the message at its publisher; None if unknown.
        """
        if number is None:
            return names, efforts
        now = time.perf_counter()
        taken = []
        for name, effort in zip(names, efforts, strict=True):
            followed = self._followed.get(name)
            taken.append(followed is None or followed.takes(number, effort, now))
        if all(taken):
            return names, efforts
        return tuple(compress(names, taken)), tuple(compress(efforts, taken))

    def move(self) -> None:
        """Note that a state is about to be published; after a standstill nobody is silent yet."""
        now = time.perf_counter()
        if now - self._moved > self._patience:
            for followed in self._followed.values():
                followed.wait(now)
        self._moved = now

    def identify(self) -> dict[str, list[str]]:
        """Look who may command each joint, and remember whom it follows where that is certain.

        Returns:
            By joint the publishers of commands but the controllers of other joints.
        """
        everybody = self._publishers()
        suspects = {joint: self._suspects(joint, everybody) for joint in self._reported}
        for joint, names in suspects.items():
            changes = self._followed[joint].changes
            if changes != self._changes[joint]:
                self._changes[joint] = changes
                before = self._names.pop(joint, None)
                names = [name for name in names if name != before] or names
            if len(set(names)) == 1:
                self._names[joint] = names[0]
        return suspects

    def conflict(self) -> str:
        """Return one line about the conflicts since the last call; empty if there were none."""
        lines = []
        for joint, suspects in self.identify().items():
            before, now = self._reported[joint], self._conflicts(joint)
            self._reported[joint] = now
            if now > before:
                names = " and ".join(suspects) or "publishers that the graph does not know"
                followed = self._names.get(joint, "the first of them")
                lines.append(f"{joint} by {names}, following {followed}")
        return f"commanded twice: {'; '.join(lines)}" if lines else ""

    def values(self) -> dict[str, Any]:
        """Return the counts of all joints for ``/diagnostics``."""
        counts = self._counts.values()
        return {
            "unanswered": sum(count.unanswered for count in counts),
            "answers to earlier states": sum(count.stale for count in counts),
            "commands not finite": sum(count.invalid for count in counts),
            "commands beyond the joint's limit": sum(count.excessive for count in counts),
            "conflicting commands": sum(map(self._conflicts, self._reported)),
            "changes of publisher": sum(each.changes for each in self._followed.values()),
        }

    def _conflicts(self, joint: str) -> int:
        return self._counts[joint].conflicting + self._followed[joint].others

    def _publishers(self) -> list[str]:
        infos = self._node.get_publishers_info_by_topic(self._topic)
        return sorted(f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos)

    def _suspects(self, joint: str, everybody: Sequence[str]) -> list[str]:
        others = {controller_name(each) for each in self._reported if each != joint}
        return [name for name in everybody if name.rpartition("/")[2] not in others]

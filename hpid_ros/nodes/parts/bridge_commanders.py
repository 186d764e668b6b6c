"""The commands that the bridge obeys, and the controllers it waits for."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from itertools import compress
from typing import Any

from rclpy.node import Node

from hpid_ros.base.names import controller_name
from hpid_ros.nodes.core.middleware import full_name
from hpid_ros.nodes.parts.joint_topics import node_of
from hpid_ros.nodes.parts.merger import JointCounts, is_by_another
from hpid_ros.simulation.lockstep import AnswerCounts, FollowedSender


class HeldCommands:
    """Takes commands as they come and waits for none; else it is used as a ``Barrier`` is.

    A command stands until the joint's next one, whichever state it answers, so that a late
    controller costs delay and not effort. A joint whose last command came too long ago gets no
    effort: its controller is gone. After a reset a command whose stamp is yet to come, and had
    come before the reset, is from before it.
    """

    missing: tuple[str, ...] = ()
    """Nobody is waited for."""

    unstamped: frozenset[str] = frozenset()
    """No command needs a stamp."""

    is_abandoned = False
    """Time goes on without answers."""

    def __init__(
        self, joints: Sequence[str], timeout_ns: int, limits: Mapping[str, float] | None = None
    ) -> None:
        self.joints = tuple(joints)
        self.counts = {joint: AnswerCounts() for joint in self.joints}
        self.foreign = 0
        self._timeout_ns = timeout_ns
        self._stamp_ns = self._before_ns = 0  # of the present state, and the newest before a reset
        self._held: dict[str, tuple[int, float]] = {}
        self._limits = limits or {}
        self._last: dict[str, tuple[int, float]] = {}  # stamp and effort, as they came

    @property
    def silent(self) -> tuple[str, ...]:
        """Joints without a command that still stands, in their order."""
        return tuple(joint for joint in self.joints if self._effort(joint) is None)

    def begin(self, stamp_ns: int) -> None:
        """Note the present state; a clock that goes back ends all commands."""
        if stamp_ns < self._stamp_ns:
            self._held.clear()
            self._last.clear()
            self._before_ns = max(self._before_ns, self._stamp_ns)
        self._stamp_ns = stamp_ns

    def answer(self, stamp_ns: int, names: Sequence[str], efforts: Sequence[float]) -> bool:
        # One that answers no state has the stamp next to the last one that was answered.
        is_outdated = self._stamp_ns + 1 < stamp_ns <= self._before_ns + 1
        for name, effort in zip(names, efforts, strict=True):
            counts = self.counts.get(name)
            if counts is None:
                self.foreign += 1
                continue
            if is_outdated:
                counts.outdated += 1
                continue
            counts.answered += 1
            counts.stale += stamp_ns != self._stamp_ns
            last = self._last.get(name, (0, 0.0))
            counts.conflicting += is_by_another(*last, stamp_ns, effort)
            self._last[name] = stamp_ns, effort
            effort = counts.checked(effort, self._limits.get(name, math.inf))
            self._held[name] = self._stamp_ns, effort
        return False

    def time_out(self) -> tuple[str, ...]:
        """Return the joints that are no longer waited for: none ever was."""
        return ()

    def finish(self) -> list[float]:
        """Count who is silent, and return the efforts for the physics in [N m]."""
        efforts = []
        for joint in self.joints:
            effort = self._effort(joint)
            self.counts[joint].unanswered += effort is None
            efforts.append(effort or 0.0)
        return efforts

    def _effort(self, joint: str) -> float | None:
        """Return the command that stands in [N m]; None when there is none."""
        came_ns, effort = self._held.get(joint, (-self._timeout_ns - 1, 0.0))
        return effort if self._stamp_ns - came_ns <= self._timeout_ns else None


class Commanders:
    """Follows one sender a joint, and reports joints that have more than one.

    A joint follows who commanded it first, until that one is silent. Our controllers name
    themselves in each command (:func:`.sender_of`); the middleware, in rclpy of Jazzy, does not.
    All without a name are one sender: two of them are both obeyed, differ in their answers, and
    are named as far as the graph knows them.
    """

    def __init__(
        self,
        node: Node,
        joints: Sequence[str],
        counts: Mapping[str, AnswerCounts] | Mapping[str, JointCounts],
        patience: float,
        longest_gap: float = math.inf,
    ) -> None:
        self._node = node
        self._counts = counts
        self._topic = node.resolve_topic_name("joint_commands")
        self._patience = patience
        self._followed = {joint: FollowedSender(patience) for joint in joints}
        self._reported = dict.fromkeys(joints, (0, 0))
        # [s] what a gap counts at most where nothing but commands tells the time: after a
        # standstill they are read late, and a second sender's perhaps first
        self._longest_gap = longest_gap
        self._moved = self._unheard = 0.0

    def go_on(self, joints: Sequence[str], counts: Mapping[str, JointCounts]) -> None:
        """Go on with counts that begin at zero: a joint still follows whom it has followed."""
        self._counts = counts
        for joint in joints:
            self._followed.setdefault(joint, FollowedSender(self._patience))
        self._reported = {joint: (self._followed[joint].others, 0) for joint in joints}

    def heed(
        self, names: tuple[str, ...], efforts: tuple[float, ...], sender: str, now: float
    ) -> tuple[tuple[str, ...], tuple[float, ...]]:
        """Return what is to be obeyed of a command."""
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

    def move(self) -> float:
        """Note that time goes on, and return it; after a standstill no joint is silent yet."""
        now = time.perf_counter()
        gap, self._moved = now - self._moved, now
        self._unheard += max(gap - self._longest_gap, 0.0)
        listened = now - self._unheard
        if gap > self._patience:
            for followed in self._followed.values():
                followed.wait(listened)
        return listened

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
        counts, followed = self._counts.values(), self._followed.values()
        return {
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
        names = sorted(map(full_name, self._node.get_publishers_info_by_topic(self._topic)))
        rest = [name for name in names if name.rpartition("/")[2] not in others]
        for name in map(node_of, filter(None, known)):
            if name in rest:
                rest.remove(name)
        return " and ".join(rest) or "a publisher that the graph does not know"

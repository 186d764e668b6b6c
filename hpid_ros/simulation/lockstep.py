"""Who has answered the present state: the barrier between control and physics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass
class AnswerCounts:
    """What one joint's controller did.

    Attributes:
        answered: States that it answered in time.
        unanswered: States that it did not answer; the joint got no effort.
        repeated: Further answers to the same state.
        stale: Answers to another state than the present one.
        invalid: Answers that were not finite; the joint got no effort.
    """

    answered: int = 0
    unanswered: int = 0
    repeated: int = 0
    stale: int = 0
    invalid: int = 0


class Barrier:
    """Collects the answers to one state after the other.

    A joint that does not answer in time gets no effort and is not waited for again until it
    answers; it stops nobody else.

    Args:
        joints: The driven joints, in the order of the efforts.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self.counts = {joint: AnswerCounts() for joint in self.joints}
        self.foreign = 0
        self._index = {joint: index for index, joint in enumerate(self.joints)}
        self._everyone = frozenset(self.joints)
        self._silent: set[str] = set()
        self._stamp_ns: int | None = None
        self._missing: set[str] = set()  # of the present state; never also silent
        self._efforts = [0.0] * len(self.joints)

    @property
    def silent(self) -> tuple[str, ...]:
        """Joints that are not waited for, in their order."""
        return tuple(joint for joint in self.joints if joint in self._silent)

    @property
    def missing(self) -> tuple[str, ...]:
        """Joints that the present state still waits for, in their order."""
        return tuple(joint for joint in self.joints if joint in self._missing)

    @property
    def efforts(self) -> list[float]:
        """The answers to the present state in [N m]; zero where there is none."""
        return self._efforts

    @property
    def is_abandoned(self) -> bool:
        """Whether no joint is waited for at all."""
        return len(self._silent) == len(self.joints)

    def begin(self, stamp_ns: int) -> None:
        """Begin to wait for the answers to a state.

        Args:
            stamp_ns: Its stamp in [ns].
        """
        self._stamp_ns = stamp_ns
        self._missing = set(self._everyone - self._silent)
        self._efforts = [0.0] * len(self.joints)

    def answer(self, stamp_ns: int, names: Sequence[str], efforts: Sequence[float]) -> bool:
        """Take a command.

        Args:
            stamp_ns: Stamp of the state that it answers in [ns].
            names: Its joints.
            efforts: Their efforts in [N m].

        Returns:
            Whether this command ended the waiting: it completed the answers to the present
            state, or it is the first after everybody had been given up.
        """
        was_waiting = bool(self._missing) or self.is_abandoned
        for name, effort in zip(names, efforts, strict=True):
            counts = self.counts.get(name)
            if counts is None:
                self.foreign += 1
            elif stamp_ns != self._stamp_ns:
                counts.stale += 1
            else:
                self._accept(name, counts, effort)
        return was_waiting and not self._missing and not self.is_abandoned

    def _accept(self, name: str, counts: AnswerCounts, effort: float) -> None:
        if name in self._missing:
            self._missing.remove(name)
            counts.answered += 1
        elif name in self._silent:
            self._silent.remove(name)
            counts.answered += 1
        else:
            counts.repeated += 1
        if not math.isfinite(effort):
            counts.invalid += 1
            effort = 0.0
        self._efforts[self._index[name]] = effort

    def give_up(self) -> tuple[str, ...]:
        """Stop waiting for those that have not answered.

        Returns:
            The joints that are silent from now on.
        """
        given_up = self.missing
        self._silent |= self._missing
        self._missing = set()
        return given_up

    def finish(self) -> list[float]:
        """Count who did not answer, and return the efforts for the physics in [N m]."""
        for joint in self._silent:
            self.counts[joint].unanswered += 1
        return self._efforts

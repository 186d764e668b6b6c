"""Lock-step: which joints have answered the present state, and whom each of them follows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass
class AnswerCounts:
    """What one joint's controller did."""

    answered: int = 0  # states that it answered in time
    unanswered: int = 0  # states that it did not answer; the joint got no effort
    repeated: int = 0  # further answers to the same state
    stale: int = 0  # answers to another state than the present one
    outdated: int = 0  # commands from before a reset, which do not act after it
    invalid: int = 0  # answers that were not finite; the joint got no effort
    excessive: int = 0  # answers beyond the joint's limit, which were held to it
    conflicting: int = 0  # answers to one state that differ: somebody else commands the joint, too

    def checked(self, effort: float, limit: float) -> float:
        """Return what may reach the joint of a commanded effort, and count what may not."""
        if not math.isfinite(effort):
            self.invalid += 1
            return 0.0
        if abs(effort) > limit:
            self.excessive += 1
            return math.copysign(limit, effort)
        return effort


class Barrier:
    """Collects the answers to one state after the other.

    A joint that does not answer in time gets no effort and is not waited for; it stops nobody
    else. Its controller has come back when it answers, also a state that is over, since nobody
    waited for it: then the next state waits. Each time it does not keep that promise, twice as
    many answers must come before it is believed again.
    """

    def __init__(self, joints: Sequence[str], limits: Mapping[str, float] | None = None) -> None:
        self.joints = tuple(joints)
        self.counts = {joint: AnswerCounts() for joint in self.joints}
        self.foreign = 0
        self._index = {joint: index for index, joint in enumerate(self.joints)}
        self._everyone = frozenset(self.joints)
        limits = limits or {}
        self._limits = [limits.get(joint, math.inf) for joint in self.joints]
        self._silent: set[str] = set()
        self._late = dict.fromkeys(self.joints, 0)  # answers to states that did not wait
        self._needed = dict.fromkeys(self.joints, 1)  # of them, to be waited for again
        self._stamp_ns: int | None = None
        self._past: tuple[int | None, list[float | None]] = None, []
        self._given: list[float | None] = [None] * len(self.joints)  # as they came
        self._missing: set[str] = set()  # of the present state; never also silent
        self.unstamped: set[str] = set()
        """Joints whose commands carry the stamp 0, and answer no state with it."""
        self.efforts = [0.0] * len(self.joints)
        """The answers to the present state in [N m]; zero where there is none."""

    @property
    def silent(self) -> tuple[str, ...]:
        """Joints that are not waited for, in their order."""
        return tuple(joint for joint in self.joints if joint in self._silent)

    @property
    def missing(self) -> tuple[str, ...]:
        """Joints that the present state still waits for, in their order."""
        return tuple(joint for joint in self.joints if joint in self._missing)

    @property
    def is_abandoned(self) -> bool:
        """Whether no joint is waited for at all."""
        return len(self._silent) == len(self.joints)

    def begin(self, stamp_ns: int) -> None:
        """Begin to wait for the answers to a state."""
        self._past = self._stamp_ns, self._given
        self._given = [None] * len(self.joints)
        self._stamp_ns = stamp_ns
        if self._silent:
            self._readmit()
        self._missing = set(self._everyone - self._silent)
        self.efforts = [0.0] * len(self.joints)

    def _readmit(self) -> None:
        """Wait again for those that have answered states that did not wait for them."""
        for name in self.silent:
            if self._late[name] >= self._needed[name]:
                self._silent.remove(name)

    def answer(self, stamp_ns: int, names: Sequence[str], efforts: Sequence[float]) -> bool:
        was_waiting = bool(self._missing) or self.is_abandoned
        for name, effort in zip(names, efforts, strict=True):
            counts = self.counts.get(name)
            if counts is None:
                self.foreign += 1
            elif stamp_ns != self._stamp_ns:
                self._note_late(name, counts, stamp_ns, effort)
            else:
                self._accept(name, counts, effort)
        return was_waiting and not self._missing and not self.is_abandoned

    def _note_late(self, name: str, counts: AnswerCounts, stamp_ns: int, effort: float) -> None:
        """Count an answer to another state than the present one."""
        counts.stale += 1
        self._late[name] += 1
        if stamp_ns == 0:
            self.unstamped.add(name)
        before_ns, given = self._past
        if stamp_ns == before_ns:
            counts.conflicting += _differ(given[self._index[name]], effort)

    def _accept(self, name: str, counts: AnswerCounts, effort: float) -> None:
        index = self._index[name]
        self.unstamped.discard(name)
        if name in self._missing:
            self._missing.remove(name)
            counts.answered += 1
            if self._late[name]:
                self._late[name], self._needed[name] = 0, 1
        elif name in self._silent:
            self._silent.remove(name)
            counts.answered += 1
        else:
            counts.repeated += 1
            counts.conflicting += _differ(self._given[index], effort)
        self._given[index] = effort
        self.efforts[index] = counts.checked(effort, self._limits[index])

    def time_out(self) -> tuple[str, ...]:
        """Stop waiting for those that have not answered."""
        given_up = self.missing
        for name in given_up:
            if self._late[name]:  # it was believed, and did not answer
                self._needed[name] *= 2
            self._late[name] = 0
        self._silent |= self._missing
        self._missing = set()
        return given_up

    def finish(self) -> list[float]:
        """Count who did not answer, and return the efforts for the physics in [N m]."""
        for joint in self._silent:
            self.counts[joint].unanswered += 1
        return self.efforts


def _differ(before: float | None, effort: float) -> bool:
    """Return whether two answers to one state come from two controllers.

    One controller repeats itself, and leaves with an effort of zero.
    """
    return before is not None and effort != before and effort != 0.0 and not math.isnan(effort)


_SPARED_AT_ZERO = 0.75  # of the patience, after an effort of zero


class FollowedSender:
    """Tells the sender that a joint follows from others."""

    def __init__(self, patience: float) -> None:
        self.sender: str | None = None
        self.other = ""
        self.others = self.changes = 0
        self._patience = patience
        self._heard = 0.0

    def takes(self, sender: str, effort: float, now: float) -> bool:
        """Return whether a command is to be followed."""
        if sender != self.sender:
            if self.sender is not None:
                if now - self._heard <= self._patience:
                    self.others += 1
                    self.other = sender
                    return False
                self.changes += 1
            self.sender = sender
        if math.isfinite(effort):
            self._heard = now if effort != 0.0 else now - _SPARED_AT_ZERO * self._patience
        return True

    def wait(self, now: float) -> None:
        """Begin to be patient again: time has stood still for everybody."""
        self._heard = now

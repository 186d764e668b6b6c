"""Rounds: which joints have answered the newest state, and when what has come must be sent.

A round begins with a command that answers a newer state, or with a joint that answers for the
second time: a state that was repeated, a last zero, a clock that went back. It is complete when
all joints that are waited for have answered. Whatever has come is due, complete or not, when the
first of it is as old as a stated part of the time between two rounds: a straggler delays nobody
for longer, and one that was late is not waited for again until it has answered in time. A joint
whose stamps are ahead of all others' makes stragglers of them, and its pace the time between two
rounds: so what a straggler sent is due at the latest when it sends again.
"""

from __future__ import annotations

from collections import deque
from statistics import median

from hpid_ros.base.units import NANOSECONDS

_FIRST_PERIOD_NS = NANOSECONDS // 1000  # taken for the time between two rounds until it is known
_BURST_NS = NANOSECONDS // 2000  # in which a process that stood still answers what it has missed
_INTERVALS = 9  # whose median is that time


class Rounds:
    """Rounds of the answers of some joints, which are numbers from 0.

    All times are of one steady clock, in [ns].
    """

    def __init__(self, joints: int, share: float) -> None:
        self.stamp_ns: int | None = None
        self.began_ns = 0
        self.deadline_ns: int | None = None
        self._share = share
        self._stamps: list[int | None] = [None] * joints
        self._alive: set[int] = set()
        self._awaited: set[int] = set()
        self._answered: set[int] = set()
        self._unsent: dict[int, int] = {}  # since when
        self._is_overdue = False
        self._was_sent = False
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)
        self._wait_ns = round(share * _FIRST_PERIOD_NS)

    @property
    def period_ns(self) -> float:
        """The time between two rounds: the median of the last ones."""
        return median(self._intervals) if self._intervals else _FIRST_PERIOD_NS

    @property
    def wait_ns(self) -> int:
        """How long a command waits for others."""
        return self._wait_ns

    @property
    def is_complete(self) -> bool:
        """Whether all who are waited for have answered the present state, or one cannot wait.

        What comes after a round was sent waits for all who are not silent, so that stragglers are
        sent together.
        """
        if self._is_overdue:
            return True
        if self._was_sent:
            return self._alive <= self._answered
        return (self._awaited or self._alive) <= self._answered

    def stamp_of(self, joint: int) -> int | None:
        """Return the stamp of the state that a joint answered last, in [ns]."""
        return self._stamps[joint]

    def answer(self, joint: int, stamp_ns: int, now_ns: int) -> None:
        """Take note of a command."""
        before, self._stamps[joint] = self._stamps[joint], stamp_ns
        if self._is_another(joint, stamp_ns, before):
            self._begin(stamp_ns, now_ns)
        elif stamp_ns != self.stamp_ns:
            self._is_overdue |= now_ns - self._unsent.get(joint, now_ns) > _BURST_NS
        self._unsent.setdefault(joint, now_ns)
        self._alive.add(joint)
        if stamp_ns == self.stamp_ns:
            self._answered.add(joint)
            if now_ns - self.began_ns <= self._wait_ns:
                self._awaited.add(joint)
        due_ns = now_ns + self._wait_ns
        if self.deadline_ns is None or due_ns < self.deadline_ns:
            self.deadline_ns = due_ns

    def _is_another(self, joint: int, stamp_ns: int, before: int | None) -> bool:
        """Tell whether a command is of another round than the present one."""
        if self.stamp_ns is None or stamp_ns > self.stamp_ns:
            return True
        if stamp_ns == self.stamp_ns:
            return joint in self._answered
        return before is not None and stamp_ns <= before  # else it catches up

    def _begin(self, stamp_ns: int, now_ns: int) -> None:
        if self.stamp_ns is not None and stamp_ns > self.stamp_ns:
            self._intervals.append(now_ns - self.began_ns)
            self._wait_ns = round(self._share * self.period_ns)
        self.stamp_ns, self.began_ns = stamp_ns, now_ns
        self._answered.clear()
        self._was_sent = False

    def leave(self, joint: int) -> None:
        """Wait for a joint no more until it answers again."""
        self._alive.discard(joint)
        self._awaited.discard(joint)

    def forget(self) -> None:
        """Note that what has come is sent, whoever has not answered."""
        self.deadline_ns = None
        self._unsent.clear()
        self._is_overdue = False

    def finish(self, now_ns: int) -> set[int]:
        """Note that what has come is sent because the round is complete, or has waited enough."""
        self.forget()
        if self._was_sent:
            return set()
        self._was_sent = True
        if now_ns - self.began_ns >= self._wait_ns:
            self._awaited &= self._answered
        return self._alive - self._answered

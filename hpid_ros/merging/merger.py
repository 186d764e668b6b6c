"""The newest effort of each joint, merged into one command for each state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.merging.rounds import Rounds
from hpid_ros.merging.settings import MergedJoint, MergerSettings

_REPEATS = 4  # in one timeout, of a fallback that nobody else's command carries
_SHORTEST_REPEAT_NS = NANOSECONDS // 1000
_STOOD_STILL_NS = NANOSECONDS // 20  # a look that comes later than this: we stood still ourselves


class Merged(NamedTuple):
    """One command for all joints."""

    stamp_ns: int  # [ns] stamp of the newest state that it answers
    efforts: tuple[float, ...]  # [N m] in the order of the joints or [N]; all are finite


@dataclass
class JointCounts:
    """What one joint's controller did."""

    commands: int = 0  # its usable commands
    late: int = 0  # rounds that were sent without its answer, while it was not silent
    silences: int = 0  # how often it fell silent
    returns: int = 0  # how often it came back
    invalid: int = 0  # its commands that were not finite; each counts as if it had not come
    # commands that do not continue its last one: another source commands it, too
    conflicting: int = 0


class _Fade(NamedTuple):
    """How a joint comes back."""

    began_ns: int  # since when
    effort: float  # [N m] from where or [N]


class CommandMerger:
    """Merges the commands of joints; says what is to be sent whenever something is.

    It starts when every joint has commanded, or may be missing. From then on every command is in
    what is sent no later than the wait of its round, all that answer one state together where
    they come in time. A joint that is silent for longer than its timeout gets its fallback; one
    that comes back is faded in from there, and nothing that is not finite is ever sent.

    All times are of one steady clock, in [ns]. Whoever calls it sends what it returns at once.
    """

    def __init__(self, settings: MergerSettings) -> None:
        self.settings = settings
        self.counts = {name: JointCounts() for name in settings.names}
        self.foreign = 0
        self.rounds = Rounds(len(settings.joints), settings.straggler_wait)
        self.has_begun = False
        self.sent = self.sent_whole = 0
        self.silences = self.returns = 0
        self._joints = settings.joints
        self._index = {name: index for index, name in enumerate(settings.names)}
        self._efforts = [joint.fallback for joint in settings.joints]
        self._timeouts_ns = [round(joint.timeout * NANOSECONDS) for joint in settings.joints]
        self._repeat_ns = max(min(self._timeouts_ns) // _REPEATS, _SHORTEST_REPEAT_NS)
        self._fade_in_ns = round(settings.fade_in_time * NANOSECONDS)
        self._heard_ns = [0] * len(settings.joints)
        self._forgiven: set[int] = set()
        self._silent = set(range(len(settings.joints)))
        self._fades: dict[int, _Fade] = {}
        self._sent_ns: int | None = None
        self._promised_ns: int | None = None

    @property
    def silent(self) -> tuple[MergedJoint, ...]:
        """Joints without a usable command that still stands, in their order."""
        return tuple(joint for k, joint in enumerate(self._joints) if k in self._silent)

    @property
    def shortest_timeout(self) -> float:
        """The shortest timeout of a joint in [s]."""
        return min(joint.timeout for joint in self._joints)

    @property
    def missing(self) -> tuple[str, ...]:
        """Joints whose first command is waited for, in their order; none once it has begun."""
        if self.has_begun:
            return ()
        return tuple(joint.name for joint in self.silent if not joint.may_be_missing)

    def take(
        self, joint: str, stamp_ns: int, effort: float, now_ns: int, *, is_signed: bool = True
    ) -> Merged | None:
        """Take a command."""
        index = self._index.get(joint)
        if index is None:
            self.foreign += 1
            return None
        counts = self.counts[joint]
        if not math.isfinite(effort):
            counts.invalid += 1
            return None
        counts.commands += 1
        counts.conflicting += not is_signed and self._is_by_another(index, stamp_ns, effort)
        if index in self._silent:
            self._return(index, counts, now_ns)
        self._heard_ns[index] = now_ns
        self._forgiven.discard(index)
        self._efforts[index] = effort
        self.rounds.answer(index, stamp_ns, now_ns)
        if not self._may_send(now_ns):
            return None
        return self._finish(now_ns) if self.rounds.is_complete else None

    def flush(self, now_ns: int) -> Merged | None:
        """Return what has come and has not been sent, if there is any, whoever is missing."""
        if not self.has_begun or self.rounds.deadline_ns is None:
            return None
        self.rounds.forget()
        return self._merged(now_ns)

    def look(self, now_ns: int) -> Merged | None:
        """See who has fallen silent and what is due; to be called when :meth:`within` says."""
        self._forgive(now_ns)
        has_changed = self._fall_silent(now_ns)
        if not self._may_send(now_ns):
            return None
        deadline_ns = self.rounds.deadline_ns
        if deadline_ns is not None and (now_ns >= deadline_ns or self.rounds.is_complete):
            return self._finish(now_ns)
        if has_changed or (self._silent and self._repeat_is_due(now_ns)):
            self.rounds.forget()
            return self._merged(now_ns)
        return None

    def within(self, now_ns: int) -> float:
        """Return the time in [s] until :meth:`look` is due, if nothing comes until then.

        Whoever asks promises to look then: who comes later stood still, and did not hear anybody.
        """
        times = [
            heard_ns + timeout_ns + 1
            for index, (heard_ns, timeout_ns) in enumerate(
                zip(self._heard_ns, self._timeouts_ns, strict=True)
            )
            if index not in self._silent
        ]
        if self.has_begun and self.rounds.deadline_ns is not None:
            times.append(self.rounds.deadline_ns)
        if self.has_begun and self._silent:
            times.append((self._sent_ns or now_ns) + self._repeat_ns)
        self._promised_ns = max(min(times), now_ns) if times else None
        return math.inf if not times else max(min(times) - now_ns, 0) / NANOSECONDS

    def supersede(self, effort: float, now_ns: int) -> None:
        """Note that joints were sent another effort; those with commands return from it."""
        if self.has_begun and self._fade_in_ns:
            for index in set(range(len(self._joints))) - self._silent:
                self._fades[index] = _Fade(now_ns, effort)

    def _is_by_another(self, index: int, stamp_ns: int, effort: float) -> bool:
        """Tell whether a command does not continue the joint's last one.

        One controller answers each state once, in their order; it repeats itself, and leaves
        with an effort of zero. Commands without stamps say nothing about their order.
        """
        before_ns = self.rounds.stamp_of(index)
        if index in self._silent or not before_ns or effort == 0.0:
            return False
        return stamp_ns < before_ns or (stamp_ns == before_ns and effort != self._efforts[index])

    def _return(self, index: int, counts: JointCounts, now_ns: int) -> None:
        self._silent.remove(index)
        if not self.has_begun:
            return  # nothing was sent in its place
        counts.returns += 1
        self.returns += 1
        if self._fade_in_ns:
            self._fades[index] = _Fade(now_ns, self._joints[index].fallback)

    def _may_send(self, now_ns: int) -> bool:
        if not self.has_begun:
            self.has_begun = not self.missing
            if not self.has_begun:
                self.rounds.forget()
        return self.has_begun

    def _forgive(self, now_ns: int) -> None:
        """Be patient anew after having stood still: nobody could be heard meanwhile.

        Only once until a joint commands again: a machine that is always late hides no silence.
        """
        promised_ns = self._promised_ns
        if promised_ns is None or now_ns - promised_ns <= _STOOD_STILL_NS:
            return
        self._promised_ns = None
        for index in set(range(len(self._joints))) - self._forgiven:
            self._forgiven.add(index)
            self._heard_ns[index] = now_ns

    def _fall_silent(self, now_ns: int) -> bool:
        """Let joints fall back that have been silent for too long, and tell if there are any."""
        before = len(self._silent)
        for index, joint in enumerate(self._joints):
            silence_ns = now_ns - self._heard_ns[index]
            if index in self._silent or silence_ns <= self._timeouts_ns[index]:
                continue
            self._silent.add(index)
            self._efforts[index] = joint.fallback
            self._fades.pop(index, None)
            self.rounds.leave(index)
            self.counts[joint.name].silences += 1
            self.silences += 1
        return len(self._silent) > before

    def _repeat_is_due(self, now_ns: int) -> bool:
        return self._sent_ns is None or now_ns - self._sent_ns >= self._repeat_ns

    def _finish(self, now_ns: int) -> Merged:
        late = self.rounds.finish(now_ns)
        for index in late:
            self.counts[self._joints[index].name].late += 1
        self.sent_whole += not late
        return self._merged(now_ns)

    def _merged(self, now_ns: int) -> Merged:
        self.sent += 1
        self._sent_ns = now_ns
        efforts = self._faded(now_ns) if self._fades else tuple(self._efforts)
        return Merged(self.rounds.stamp_ns or 0, efforts)

    def _faded(self, now_ns: int) -> tuple[float, ...]:
        """Return the efforts with those that come back on their way to what was commanded."""
        efforts = list(self._efforts)
        for index, fade in list(self._fades.items()):
            part = (now_ns - fade.began_ns) / self._fade_in_ns
            if part >= 1.0:
                del self._fades[index]
            else:
                efforts[index] = fade.effort + part * (efforts[index] - fade.effort)
        return tuple(efforts)

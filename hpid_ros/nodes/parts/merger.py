"""Efforts of many joints merged into one command for each state: rounds, fallbacks, receiver.

A round begins with a command that answers a newer state, or with a joint that answers for the
second time: a state that was repeated, a last zero, a clock that went back. It is complete when
all joints that are waited for have answered. Whatever has come is due, complete or not, when the
first of it is as old as a stated part of the time between two rounds: a straggler delays no other
for longer, and one that was late is not waited for again until it has answered in time. A joint
whose stamps are ahead of all others' makes stragglers of them, and its pace the time between two
rounds: so what a straggler sent is due at the latest when it sends again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.units import NANOSECONDS


class MergedJoint(NamedTuple):
    """One joint of a merged command."""

    name: str
    timeout: float = 0.15  # [s] it is silent when no usable command has come for longer than this
    fallback: float = 0.0  # [N m] or [N], effort that it is sent while silent
    # whether the merger starts without a command of this joint, at its fallback
    may_be_missing: bool = False


class MergerSettings(NamedTuple):
    joints: tuple[MergedJoint, ...]  # at least one, each once, in the order of the merged command
    straggler_wait: float = 0.5  # as part of the states' period, above 0
    # [s] a joint that comes back is faded in from its fallback for so long
    fade_in_time: float = 0.1

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)


def require_order(names: Iterable[str]) -> tuple[str, ...]:
    order = tuple(names)
    if not order or len(set(order)) != len(order):
        raise SettingError(
            f"the joints of a merged command must be named once each, "
            f"not {', '.join(order) or 'none'}"
        )
    return order


def joints_of(
    order: Iterable[str],
    timeout: float,
    timeouts: Mapping[str, float],
    fallbacks: Mapping[str, float],
) -> tuple[MergedJoint, ...]:
    names = require_order(order)
    for what, values in (("timeout", timeouts), ("fallback", fallbacks)):
        for name in values:
            if name not in names:
                unknown = unknown_name("joint", name, names)
                raise SettingError(f"a {what} is given for the {unknown}")
    if "" in names:
        raise SettingError("a joint must have a name, not an empty one")
    return tuple(
        MergedJoint(name, timeouts.get(name, timeout), fallbacks.get(name, 0.0), name in fallbacks)
        for name in names
    )


ACTIVE = "active"
"""State of a controller that acts on commands, as lifecycles name it."""

EFFORT = "effort"
"""Interface of ros2_control that efforts are for."""


class Receiver:
    """What is known of the receiver of merged commands, and why nothing may be sent to it.

    A receiver that is named is a group controller of ros2_control, which says itself which joints
    it has, in which order. A message of another size would end it, so it is asked whenever there
    is a new one of that name, and gets nothing before it has answered. Of one without a name
    nothing is known but that it subscribes.
    """

    def __init__(self, name: str, joints: Sequence[str], topic: str) -> None:
        self.name = name
        self._given = tuple(joints)
        self._topic = topic
        self.endpoints: frozenset[bytes] = frozenset()  # its subscriptions
        self._own_joints: tuple[str, ...] = ()
        self._refusal = ""
        self._state: str | None = None

    @property
    def joints(self) -> tuple[str, ...]:
        """The order of the commands; empty while it is not known."""
        return self._own_joints if self.name else self._given

    @property
    def must_be_asked(self) -> bool:
        """Whether it is there and has not said which joints it has."""
        return bool(self.name and self.endpoints and not self._own_joints and not self._refusal)

    @property
    def is_refused(self) -> bool:
        """Whether it has said something of itself for which it gets nothing."""
        return bool(self._refusal)

    @property
    def is_deactivated(self) -> bool:
        """Whether it is there, and does not act on commands."""
        return bool(self.endpoints) and self._state not in (None, ACTIVE)

    @property
    def reason(self) -> str:
        """Why nothing may be sent; empty if something may."""
        if self._refusal:
            return self._refusal
        if not self.endpoints:
            return f"waiting for {self.name or 'somebody'} to subscribe to {self._topic}"
        if not self.joints:
            return f"waiting for {self.name} to say which joints it has"
        if self.is_deactivated:
            return f"{self.name} is {self._state}, and discards what it is sent"
        return ""

    def note_endpoints(self, endpoints: frozenset[bytes]) -> bool:
        """Take note of its subscriptions to the commands."""
        is_new = bool(endpoints - self.endpoints)
        if is_new:
            self._own_joints, self._refusal = (), ""
        if not endpoints:
            self._own_joints, self._refusal, self._state = (), "", None
        self.endpoints = endpoints
        return is_new

    def note_state(self, state: str | None) -> None:
        self._state = state

    def note_joints(self, joints: Sequence[str] | None, interface: str | None) -> None:
        """Take note of what it says of itself."""
        try:
            self._own_joints, self._refusal = self._checked(joints, interface), ""
        except SettingError as error:
            self._own_joints, self._refusal = (), f"nothing is sent to {self.name}: {error}"

    def _checked(self, joints: Sequence[str] | None, interface: str | None) -> tuple[str, ...]:
        if joints is None:
            raise SettingError("it has no parameter joints")
        if interface not in (None, "", EFFORT):
            raise SettingError(f"it commands the {interface} of its joints, not their effort")
        if not isinstance(joints, list | tuple) or not all(isinstance(x, str) for x in joints):
            raise SettingError("its parameter joints is no list of names")
        order = require_order(joints)
        if self._given and self._given != order:
            raise SettingError(
                f"its joints are {', '.join(order)}, those that were given "
                f"{', '.join(self._given)}"
            )
        return order


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
        self.stamps_ns: list[int | None] = [None] * joints  # of the state that each answered last
        self._alive: set[int] = set()
        self._awaited: set[int] = set()
        self._answered: set[int] = set()
        self._unsent: dict[int, int] = {}  # since when
        self._is_overdue = False
        self._was_sent = False
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)
        self.wait_ns = round(share * _FIRST_PERIOD_NS)  # how long a command waits for others

    @property
    def period_ns(self) -> float:
        """The time between two rounds: the median of the last ones."""
        return median(self._intervals) if self._intervals else _FIRST_PERIOD_NS

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

    def answer(self, joint: int, stamp_ns: int, now_ns: int) -> None:
        before, self.stamps_ns[joint] = self.stamps_ns[joint], stamp_ns
        if self._is_another(joint, stamp_ns, before):
            self._begin(stamp_ns, now_ns)
        elif stamp_ns != self.stamp_ns:
            self._is_overdue |= now_ns - self._unsent.get(joint, now_ns) > _BURST_NS
        self._unsent.setdefault(joint, now_ns)
        self._alive.add(joint)
        if stamp_ns == self.stamp_ns:
            self._answered.add(joint)
            if now_ns - self.began_ns <= self.wait_ns:
                self._awaited.add(joint)
        due_ns = now_ns + self.wait_ns
        if self.deadline_ns is None or due_ns < self.deadline_ns:
            self.deadline_ns = due_ns

    def _is_another(self, joint: int, stamp_ns: int, before: int | None) -> bool:
        """Return whether a command is of another round than the present one."""
        if self.stamp_ns is None or stamp_ns > self.stamp_ns:
            return True
        if stamp_ns == self.stamp_ns:
            return joint in self._answered
        return before is not None and stamp_ns <= before  # else it catches up

    def _begin(self, stamp_ns: int, now_ns: int) -> None:
        if self.stamp_ns is not None and stamp_ns > self.stamp_ns:
            self._intervals.append(now_ns - self.began_ns)
            self.wait_ns = round(self._share * self.period_ns)
        self.stamp_ns, self.began_ns = stamp_ns, now_ns
        self._answered.clear()
        self._was_sent = False

    def leave(self, joint: int) -> None:
        """Wait for a joint no more until it answers again."""
        self._alive.discard(joint)
        self._awaited.discard(joint)

    def forget(self) -> None:
        """Note that what has come is sent, though answers are missing."""
        self.deadline_ns = None
        self._unsent.clear()
        self._is_overdue = False

    def finish(self, now_ns: int) -> set[int]:
        """Note that what has come is sent because the round is complete, or has waited enough."""
        self.forget()
        if self._was_sent:
            return set()
        self._was_sent = True
        if now_ns - self.began_ns >= self.wait_ns:
            self._awaited &= self._answered
        return self._alive - self._answered


_REPEATS = 4  # in one timeout, of a fallback that no command carries
_SHORTEST_REPEAT_NS = NANOSECONDS // 1000
_STOOD_STILL_NS = NANOSECONDS // 20  # a look that comes later than this: we stood still ourselves


class Merged(NamedTuple):
    """One command for all joints."""

    stamp_ns: int  # [ns] stamp of the newest state that it answers
    efforts: tuple[float, ...]  # [N m] or [N], in the order of the joints, all finite


@dataclass
class JointCounts:
    """What one joint's controller did."""

    commands: int = 0  # its usable commands
    late: int = 0  # rounds that were sent without its answer, while it was not silent
    silences: int = 0  # how often it fell silent
    returns: int = 0  # how often it came back
    invalid: int = 0  # its commands that were not finite; each counts as if it had not come
    # commands from before a clock that went back, of a joint that was silent; as if not come, too
    outdated: int = 0
    # commands that do not continue its last one: another source commands it, too
    conflicting: int = 0


def is_by_another(before_ns: int, before: float, stamp_ns: int, effort: float) -> bool:
    """Return whether a command does not continue a joint's last one, given by stamp and effort.

    One controller answers each state once, in their order; it repeats itself, and leaves
    with an effort of zero. Commands without stamps say nothing about their order.
    """
    if effort == 0.0 or before_ns == 0:
        return False
    return stamp_ns < before_ns or (stamp_ns == before_ns and effort != before)


class _Fade(NamedTuple):
    """How a joint comes back."""

    began_ns: int  # since when
    effort: float  # [N m] or [N], effort that the fade starts from


class CommandMerger:
    """Merges the commands of joints; says what is to be sent whenever something is.

    It starts when every joint has commanded, or may be missing. From then on every command is in
    what is sent no later than the wait of its round, all that answer one state together where
    they come in time. A joint that is silent for longer than its timeout gets its fallback; one
    that comes back is faded in from there, and nothing that is not finite is ever sent.

    All times are of one steady clock, in [ns]. The caller it sends what it returns at once.
    """

    def __init__(self, settings: MergerSettings, *, from_zero: bool = False) -> None:
        self.settings = settings
        self._from_zero = from_zero  # whether the joints have had no effort before
        self.counts = {name: JointCounts() for name in settings.names}
        self.foreign = 0
        self.shortest_timeout = min(joint.timeout for joint in settings.joints)  # [s]
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
        self._went_back: dict[int, int] = {}  # the newest stamp before, by joint
        self._before_reset_ns = -1  # the newest stamp before the clock went back
        self._sent_ns: int | None = None
        self._promised_ns: int | None = None

    @property
    def silent(self) -> tuple[MergedJoint, ...]:
        """Joints without a usable command that still stands, in their order."""
        return tuple(joint for k, joint in enumerate(self._joints) if k in self._silent)

    @property
    def missing(self) -> tuple[str, ...]:
        """Joints whose first command is waited for, in their order; none once it has begun."""
        if self.has_begun:
            return ()
        return tuple(joint.name for joint in self.silent if not joint.may_be_missing)

    def take(
        self, joint: str, stamp_ns: int, effort: float, now_ns: int, *, is_signed: bool = True
    ) -> Merged | None:
        index = self._index.get(joint)
        if index is None:
            self.foreign += 1
            return None
        counts = self.counts[joint]
        if not math.isfinite(effort):
            counts.invalid += 1
            return None
        if self._is_outdated(index, stamp_ns):
            counts.outdated += 1
            return None
        counts.commands += 1
        if not is_signed and index not in self._silent:
            last = self.rounds.stamps_ns[index] or 0, self._efforts[index]
            counts.conflicting += is_by_another(*last, stamp_ns, effort)
        if index in self._silent:
            self._return(index, counts, now_ns)
        self._heard_ns[index] = now_ns
        self._forgiven.discard(index)
        self._efforts[index] = effort
        self.rounds.answer(index, stamp_ns, now_ns)
        if not self._may_send(now_ns):
            return None
        return self._finish(now_ns) if self.rounds.is_complete else None

    def _is_outdated(self, index: int, stamp_ns: int) -> bool:
        """Tell whether a joint that was silent over a reset says what it had to say before it.

        A clock has gone back where a joint answers two states one after the other that lie more
        than its timeout before those that it had answered.
        """
        before_ns, timeout_ns = self.rounds.stamps_ns[index], self._timeouts_ns[index]
        if before_ns is not None and stamp_ns + timeout_ns < before_ns:
            self._went_back[index] = before_ns
        elif index in self._went_back:
            newest_ns = self._went_back.pop(index)
            if stamp_ns < newest_ns:
                self._before_reset_ns = newest_ns
        if index not in self._silent:
            return False
        newest_ns = self.rounds.stamp_ns or 0  # it may be the first that answers the next state
        return newest_ns + timeout_ns < stamp_ns <= self._before_reset_ns + 1

    def flush(self, now_ns: int) -> Merged | None:
        """Return what has come and has not been sent, if anything, though answers are missing."""
        if not self.has_begun or self.rounds.deadline_ns is None:
            return None
        self.rounds.forget()
        return self._merged(now_ns)

    def look(self, now_ns: int) -> Merged | None:
        """See who has fallen silent and what is due; to be called when :meth:`time_left` says."""
        self._forgive(now_ns)
        has_changed = self._fall_silent(now_ns)
        if not self._may_send(now_ns):
            return None
        deadline_ns = self.rounds.deadline_ns
        if deadline_ns is not None and (now_ns >= deadline_ns or self.rounds.is_complete):
            return self._finish(now_ns)
        is_due = self._sent_ns is None or now_ns - self._sent_ns >= self._repeat_ns
        if has_changed or (self._silent and is_due):
            self.rounds.forget()
            return self._merged(now_ns)
        return None

    def time_left(self, now_ns: int) -> float:
        """Return the time in [s] until :meth:`look` is due, if nothing comes until then.

        The caller promises to look then: a later look means that this process stood still.
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
            elif self._from_zero:  # who had to wait may have wound up
                self.supersede(0.0, now_ns)
        return self.has_begun

    def _forgive(self, now_ns: int) -> None:
        """Restart the timeouts after having stood still: no command could be received meanwhile.

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
        """Let joints fall back that have been silent for too long; return whether any have."""
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

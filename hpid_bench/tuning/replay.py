"""A recorded joint computed again: the record, the same loop, the verdict.

What a recording cannot tell is found by trying. A controller received a motion or a change of its
parameters some states before or after the recorder did; it may not have received a state that the
recorder has, or was stopped unnoticed. Every possibility is a branch with a loop of its own, which
ends where its effort is not the recorded one while another's is. So a replay that agrees is a
proof, whatever was assumed; one that does not shows where the last possibility ended.
"""

from __future__ import annotations

import contextlib
import math
import struct
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

from hpid_ros.base.errors import HpidError, TrajectoryError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.reference import LARGEST_POSITION, Motion, Pace
from hpid_ros.control.settings import LoopSettings
from hpid_ros.control.supervision import LATE_NS

LoopAnswer = Callable[[JointLoop], float]
"""Steps a loop with a state, and returns its effort in [N m]."""


class RecordedState(NamedTuple):
    """A state that a controller may have received."""

    log_time_ns: int  # [ns] when it was recorded
    place: int  # its place in the log
    stamp_ns: int  # [ns] its stamp
    answer: LoopAnswer


class RecordedCommand(NamedTuple):
    """A command for the joint."""

    place: int  # its place in the log
    stamp_ns: int  # [ns] stamp of the state that it answers
    effort: float  # [N m]
    sender: str  # who sent it, as it says; empty where it does not


class Instruction(NamedTuple):
    """Something that a controller received: a motion, other settings, or a relay."""

    place: int  # its place in the log
    what: Callable[[JointLoop], None]  # does to a loop what the controller does then
    text: str  # the same in words


def following(motion: Motion) -> Callable[[JointLoop], None]:
    """Return what has a loop follow a motion, where the controller did not refuse it."""

    def follow(loop: JointLoop) -> None:
        with contextlib.suppress(TrajectoryError):
            loop.receive(motion, carries_on=loop.following.motion is None)

    return follow


def retuned(settings: Callable[[], LoopSettings]) -> Callable[[JointLoop], None]:
    """Return what applies settings, which are made then: they may be refused."""
    return lambda loop: loop.retune(settings())


def driven(request: RelayRequest | None) -> Callable[[JointLoop], None]:
    """Return what has a relay drive a loop's joint; None ends one."""
    if request is None:
        return lambda loop: loop.end_relay("it was told to end")
    return lambda loop: loop.begin_relay(request)


@dataclass(frozen=True)
class AskedReference:
    """A reference that is given with each state, as to a firmware or a plugin of ros2_control."""

    samples: dict[int, tuple[float, float]]  # position [rad] and velocity [rad/s] by stamp [ns]

    def __deepcopy__(self, memo: object) -> AskedReference:
        return self  # the same for every branch of a replay

    gives_effort = goes_by_time = False
    begin_ns = end_ns = 0
    pace = Pace()  # nobody knows where it will lead
    window_ns = None

    def start(self, now_ns: int, position: float | None, velocity: float) -> AskedReference:
        return self

    def is_under_way(self, now_ns: int) -> bool:
        return True

    def target(self, now_ns: int) -> float:
        return self.sample(now_ns)[0]

    def first_ns(self, now_ns: int) -> int:
        return now_ns

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return what was asked for; of a state without an answer nobody knows."""
        return (*self.samples.get(stamp_ns, (0.0, 0.0)), 0.0)

    def effort(self, stamp_ns: int) -> float:
        return 0.0

    def is_usable(self, stamp_ns: int) -> bool:
        return all(abs(each) <= LARGEST_POSITION for each in self.sample(stamp_ns))


@dataclass(frozen=True)
class RecordedLoop:
    """One joint of a recording, each part in the order of the log."""

    settings: LoopSettings  # the controller's settings when it began
    states: Sequence[RecordedState]
    commands: Sequence[RecordedCommand]
    instructions: Sequence[Instruction]  # what the controller received
    begin_ns: int  # [ns] stamp from which times are counted
    is_slide: bool = False  # whether the joint slides: its efforts are in [N]


class CommandDifference(NamedTuple):
    """Answered states one after the other whose commands are not the law's."""

    stamp_ns: int  # [ns] stamp of the first
    last_ns: int  # [ns] stamp of the last
    time: float  # [s] of the first, since the first state of the recording
    commands: int  # how many there are
    recorded: float  # [N m] the first command
    computed: float  # [N m] what the law answers
    reason: str  # what is known of why


@dataclass(frozen=True)
class JointVerdict:
    """One joint's commands against the law."""

    joint: str
    equal: int = 0  # commands that are the law's, to the last bit
    different: int = 0  # commands that answer a state with another effort
    differences: tuple[CommandDifference, ...] = ()  # the same, one after the other taken together
    unanswered: int = 0  # states without a command since the controller began
    without_state: int = 0  # commands that answer a state which is not in the recording
    outside: int = 0  # commands that answer states before the first or after the last one recorded
    zeros: int = 0  # commands of zero with which the joint was left
    fallbacks: int = 0  # commands that answer no state: a fallback effort, or zero while stopped
    foreign: int = 0  # commands by somebody else than who sent the first
    senders: tuple[str, ...] = ()  # who sent commands, as far as they say
    notes: tuple[str, ...] = ()  # what had to be assumed
    is_slide: bool = False  # whether the joint slides: its efforts are in [N]
    is_begun_before: bool = False  # whether the controller ran before the recording began

    @property
    def is_the_law(self) -> bool:
        """Whether every command that could be computed again is the law's, and there is one."""
        return self.equal > 0 and not (self.different or self.without_state or self.foreign)

    @property
    def is_undecidable(self) -> bool:
        """Whether nothing can be said: what its controller remembered from before is missing."""
        return self.is_begun_before and not self.equal


_APART = (50, 500)
"""States by which a controller may have received something earlier or later than the recorder:
first a few are tried, and where that does not agree, as on an overloaded machine, many."""
_BRANCHES_AT_MOST = 64
_STATES_APART = 2000  # between two notes of progress
_SETTLED_AFTER = 200  # states without a choice, after which the likeliest branch is taken
_TRIED_UNANSWERED = 3  # states without a command, one after the other, that may have been received
_SHOWN_AT_MOST = 100  # differences
_BEGUN_BEFORE = (
    "that the controller started with the recording; it was already running, and its integral and "
    "filter states are not in the bag"
)
_WAITED = (
    "that states which waited while the controller was stopped, or busy, got the effort in force"
)
_CONTEXT = 1.0  # [s] within which something that happened may be the reason of a difference


@dataclass(eq=False, slots=True)
class _Branch:
    """One possible course of the controller."""

    loop: JointLoop
    received: int = 0  # instructions
    cost: float = 0.0
    notes: tuple[str, ...] = ()
    effort: float = math.nan  # [N m] its last answer

    def copy(self, cost: float = 0.0, note: str = "") -> _Branch:
        """Return a branch that goes its own way from here on."""
        notes = (*self.notes, note) if note else self.notes
        return _Branch(deepcopy(self.loop), self.received, self.cost + cost, notes)


def replay_joint(
    record: RecordedLoop, progress: Callable[[float], None] = lambda share: None
) -> JointVerdict:
    """Compute every command of one joint again, and compare it to the last bit.

    ``progress`` gets the share of the states that are done, from 0 again for a second look.
    """
    verdict = JointVerdict(record.settings.joint, is_slide=record.is_slide)
    for apart in _APART:
        found = _Replay(record, apart).verdict(progress)
        if found.equal >= verdict.equal:
            verdict = found
        if not (verdict.different and record.instructions) or _BEGUN_BEFORE in verdict.notes:
            break
    return verdict


class _Replay:
    def __init__(self, record: RecordedLoop, apart: int) -> None:
        self._record, self._apart = record, apart
        self._counts = Counter[str]()  # by the names of a verdict's fields
        self._differences: list[CommandDifference] = []
        self._stretch: CommandDifference | None = None
        self._happened: tuple[int, str] = (record.begin_ns, "")
        self._senders = tuple(dict.fromkeys(each.sender for each in record.commands))
        self._sender = self._senders[0] if self._senders else ""
        self._to_come = Counter(each.stamp_ns for each in record.states)
        self._answers: dict[int, list[RecordedCommand]] = {}
        self._unsolicited: dict[int, list[RecordedCommand]] = {}
        self._is_begun_before = False
        for command in record.commands:
            self._sort(command)
        # For each instruction the first state that was recorded after it.
        places = [each.place for each in record.states]
        self._nominal = [bisect_left(places, each.place) for each in record.instructions]
        self._branches = [_Branch(JointLoop(record.settings))]
        self._undecided = self._passed_over = 0
        self._is_left = False
        self._log_time_ns: int | None = None
        self._last_stamp_ns: int | None = None

    def _sort(self, command: RecordedCommand) -> None:
        """Put a command to the state that it answers, or next to which it was sent."""
        stamp_ns, states, stamps = command.stamp_ns, self._record.states, self._to_come
        if stamp_ns in stamps:
            self._answers.setdefault(stamp_ns, []).append(command)
            return
        near = next((each for each in (stamp_ns - 1, stamp_ns + 1) if each in stamps), None)
        if near is not None:
            self._unsolicited.setdefault(near, []).append(command)
        elif states and states[0].stamp_ns < stamp_ns < states[-1].stamp_ns:
            self._counts["without_state"] += 1
        else:
            self._counts["outside"] += 1
            self._is_begun_before |= bool(states) and stamp_ns < states[0].stamp_ns

    def verdict(self, progress: Callable[[float], None]) -> JointVerdict:
        has_begun = False
        for index, state in enumerate(self._record.states):
            if index % _STATES_APART == 0:
                progress(index / len(self._record.states))
            has_begun = has_begun or state.stamp_ns in self._answers
            if has_begun:
                self._take(index, state)
        self._agree()
        notes = dict.fromkeys(self._branches[0].notes)
        if self._is_begun_before:
            notes[_BEGUN_BEFORE] = None
        return JointVerdict(
            self._record.settings.joint,
            differences=tuple(self._differences),
            senders=tuple(each for each in self._senders if each),
            notes=tuple(notes),
            is_slide=self._record.is_slide,
            is_begun_before=self._is_begun_before,
            **self._counts,
        )

    def _take(self, index: int, state: RecordedState) -> None:
        commands = self._answers.get(state.stamp_ns, [])
        own = next((each for each in commands if each.sender == self._sender), None)
        is_repeat = state.stamp_ns == self._last_stamp_ns
        if own is not None and is_repeat and self._is_last_zero(own):
            own = None  # the joint was left before the state came once more
        if own is None:
            self._pass_over(index, state)
        else:
            commands.remove(own)
            self._passed_over = 0
            self._compare(index, state, own)
        self._to_come[state.stamp_ns] -= 1
        # A state that comes once more gets an answer of its own.
        is_last = not self._to_come[state.stamp_ns]
        self._after(state, commands if is_last else [])
        self._log_time_ns, self._last_stamp_ns = state.log_time_ns, state.stamp_ns

    def _is_last_zero(self, command: RecordedCommand) -> bool:
        return command.effort == 0.0 and all(
            each.loop.law.effort != 0.0 for each in self._branches
        )

    def _pass_over(self, index: int, state: RecordedState) -> None:
        """Take a state that nothing answers: it was not received, or the command was lost."""
        self._counts["unanswered"] += 1
        if self._is_left:
            return
        self._happened = state.stamp_ns, "a state that no command answers"
        self._passed_over += 1
        if self._passed_over > _TRIED_UNANSWERED:  # it listens no more
            return
        received = []
        for branch in self._expanded(index):
            each = branch.copy(1.0)
            state.answer(each.loop)
            received.append(each)
        self._keep([*self._branches, *received])

    def _compare(self, index: int, state: RecordedState, command: RecordedCommand) -> None:
        recorded = command.effort
        if self._is_left:
            self._is_left = False
            before = sum(nominal <= index for nominal in self._nominal)
            for branch in self._branches:
                while branch.received < before:  # parameters stay, motions are forgotten
                    self._instruct(branch, self._record.instructions[branch.received])
                branch.loop.release()
        branches = self._expanded(index)
        silence = state.log_time_ns - (self._log_time_ns or state.log_time_ns)
        timeout = self._branches[0].loop.settings.timing.state_timeout
        if silence > timeout * NANOSECONDS and self._branches[0].loop.state.stamp_ns is not None:
            text = "the controller was stopped, or busy, for longer than state_timeout"
            woken = [branch.copy(2.0, text) for branch in branches]
            for branch in woken:
                branch.loop.note_unanswered()
            branches += woken
        waiting = []
        timing = branches[0].loop.settings.timing
        if not timing.is_simulated and self._has_waited(state, command):
            waiting = [branch.copy(2.0, _WAITED) for branch in branches]
        for branch in waiting:
            branch.loop.note_unanswered()
            branch.effort = branch.loop.law.effort
        for branch in branches:
            branch.effort = state.answer(branch.loop)
        branches += waiting
        equal = [branch for branch in branches if _is_same(branch.effort, recorded)]
        if equal:
            self._counts["equal"] += 1
            self._agree()
            self._keep(equal)
            return
        self._differ(state, recorded, branches[0].effort)
        self._keep(branches[:1])

    def _has_waited(self, state: RecordedState, command: RecordedCommand) -> bool:
        """Tell whether an answer came so late that its state was waiting for the controller."""
        states = self._record.states
        late_ns = state.log_time_ns + LATE_NS
        later = bisect_right(states, late_ns, key=attrgetter("log_time_ns"))
        return later < len(states) and states[later].place < command.place

    def _differ(self, state: RecordedState, recorded: float, computed: float) -> None:
        """Note a difference, or that one goes on."""
        self._counts["different"] += 1
        stamp_ns = state.stamp_ns
        if self._stretch is not None:
            commands = self._stretch.commands + 1
            self._stretch = self._stretch._replace(last_ns=stamp_ns, commands=commands)
            return
        happened_ns, text = self._happened
        since = (stamp_ns - happened_ns) / NANOSECONDS
        reason = f"{text}, {since:.3f} s before" if text and since <= _CONTEXT else ""
        time = (stamp_ns - self._record.begin_ns) / NANOSECONDS
        self._stretch = CommandDifference(stamp_ns, stamp_ns, time, 1, recorded, computed, reason)

    def _agree(self) -> None:
        """Note that differences, if there were any, have ended."""
        if self._stretch is not None and len(self._differences) < _SHOWN_AT_MOST:
            self._differences.append(self._stretch)
        self._stretch = None

    def _after(self, state: RecordedState, others: Sequence[RecordedCommand]) -> None:
        """Take what was commanded next to the answer: repeats, a last zero, a fallback."""
        for command in others:
            if command.sender != self._sender:
                self._counts["foreign"] += 1
                self._happened = state.stamp_ns, f"a command by {command.sender or 'another'}"
            elif command.effort == 0.0:
                self._counts["zeros"] += 1
                self._is_left = True
                self._happened = state.stamp_ns, "the controller released the joint (zero effort)"
            else:
                self._differ(state, command.effort, self._branches[0].effort)
        for command in self._unsolicited.get(state.stamp_ns, ()):
            self._counts["fallbacks"] += 1
            unit = "N" if self._record.is_slide else "N m"
            self._happened = state.stamp_ns, f"{command.effort:g} {unit} that answers no state"
            for branch in self._branches:
                if not branch.loop.is_on_fallback:
                    branch.loop.note_timeout()

    def _expanded(self, index: int) -> list[_Branch]:
        """Return all branches, with those that receive something before this state."""
        branches: list[_Branch] = []
        for branch in self._branches:
            branches += self._receiving(branch, index)
        return sorted(branches, key=lambda each: each.cost)

    def _receiving(self, branch: _Branch, index: int) -> Iterator[_Branch]:
        """Yield a branch, unless it must have received more by now, and those that have."""
        while branch.received < len(self._nominal):
            late = index - self._nominal[branch.received]
            if late < -self._apart:
                break
            instruction = self._record.instructions[branch.received]
            if late >= self._apart:
                self._instruct(branch, instruction)
                continue
            waiting = branch.copy(1.0 if late >= 0 else 0.0)
            branch.cost += max(-late, 0)
            self._instruct(branch, instruction)
            yield waiting
        yield branch

    def _instruct(self, branch: _Branch, instruction: Instruction) -> None:
        branch.received += 1
        try:
            instruction.what(branch.loop)
        except HpidError as error:
            branch.notes = (*branch.notes, f"{instruction.text} was left out: {error}")
        stamp_ns = branch.loop.state.stamp_ns
        if stamp_ns is not None and stamp_ns >= self._happened[0]:
            self._happened = stamp_ns, instruction.text

    def _keep(self, branches: list[_Branch]) -> None:
        """Go on with the likeliest branches; with one where a choice has no effect."""
        branches.sort(key=lambda each: each.cost)
        self._undecided = self._undecided + 1 if len(branches) > 1 else 0
        if self._undecided > _SETTLED_AFTER:
            branches, self._undecided = branches[:1], 0
        self._branches = branches[:_BRANCHES_AT_MOST]


def _is_same(one: float, other: float) -> bool:
    """Return whether two numbers are the same bits."""
    return struct.pack("<d", one) == struct.pack("<d", other)

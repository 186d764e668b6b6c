"""What a joint loop knows of the states that came, and what the next one is by that."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.control.reference import LARGEST_POSITION


class LoopMode(Enum):
    """What a loop is doing.

    =====================  ====================================================================
    event                  next mode
    =====================  ====================================================================
    state answered         HOLDING, or FOLLOWING where there is a motion
    state refused          FAULT, SILENT stays SILENT
    ``note_timeout``       SILENT
    two sources of states  CONFLICT, until one of them has ended: then a takeover
    ``reset``              WAITING: the next usable state is the first; so after a simulated clock
                           went back
    =====================  ====================================================================

    States that get the active effort once (``LATE``, ``EARLIER``, ``JUMP`` of
    :class:`StateKind`) and repeats change no mode.
    """

    WAITING = "waiting for the first state"
    HOLDING = "holding its position"
    FOLLOWING = "following a reference"
    FAULT = "the last state could not be used"
    SILENT = "no new state within state_timeout"
    CONFLICT = "its states come from two sources"


class Outlier(NamedTuple):
    """A position that the joint cannot have reached."""

    stamp_ns: int
    position: float  # [rad] with its turns


@dataclass(slots=True)
class LoopState:
    """All that decides what a loop makes of the next state."""

    mode: LoopMode = LoopMode.WAITING
    stamp_ns: int | None = None
    """Stamp of the last state that the law answered in [ns]; None before the first one."""
    position: float = 0.0  # [rad] the joint's last one that was possible, with its turns
    is_takeover_due: bool = False  # the next usable state is a takeover
    outlier: Outlier | None = None  # the last position that jumped, where it was the state before
    refused_ns: int | None = None  # stamp of the state before, where the law did not answer it
    refused_count: int = 0  # states since the one that the law answered

    def is_repeat(self, stamp_ns: int) -> bool:
        """Return whether a stamp is that of the state before."""
        return stamp_ns == self.stamp_ns or stamp_ns == self.refused_ns

    def refuse(self, stamp_ns: int) -> None:
        """Note a state that the law does not answer."""
        self.refused_ns = stamp_ns
        self.refused_count += 1

    def answer(self, stamp_ns: int, mode: LoopMode) -> None:
        """Note a state that the law has answered."""
        self.mode, self.stamp_ns = mode, stamp_ns
        self.refused_ns, self.refused_count = None, 0


class StateKind(Enum):
    """What a state is; the table in docs/architecture.md says what a loop does with each."""

    # The law answers these.
    FIRST = "no state was answered before it"
    NEXT = "it follows the last one within state_timeout"
    RESUMED = "the second state after a gap"
    SET_BACK = "the second state of a wall clock that was set back"
    RESET = "a simulated clock went back"
    MOVED = "it is where the position before it jumped to"
    # These it does not.
    REPEAT = "its stamp is that of the state before"
    CONFLICT = "the states come from two sources"
    UNUSABLE = "its numbers cannot be used"
    LATE = "the first state after a gap: its stamp may be wrong"
    EARLIER = "the first state before the last one of a wall clock: its stamp may be wrong"
    JUMP = "no joint can have moved so far: its position may be wrong"
    STRAY = "as JUMP, but it continues neither the positions nor the jump before it"


NEXT = StateKind.NEXT  # nearly all are: to look a member up in its enum takes as long as to call

ANSWERED = (
    StateKind.FIRST,
    StateKind.NEXT,
    StateKind.RESUMED,
    StateKind.SET_BACK,
    StateKind.RESET,
    StateKind.MOVED,
)
"""The kinds of states that the law answers."""


@dataclass(frozen=True, slots=True)
class StateRules:
    """What the settings say of consecutive states."""

    timeout: float  # [s] state_timeout; a longer time between two stamps is a gap
    is_simulated: bool  # whether a stamp that goes back is a simulation that began again
    step_max: float  # [rad] by which a position may differ from the last one at any time
    speed_max: float  # [rad/s] and for the time between
    turn: float  # [rad] of the encoder, inf where it does not wrap


def kind_of_state(
    stamp_ns: int, position: float | None, is_split: bool, state: LoopState, rules: StateRules
) -> StateKind:
    """Return what a state is.

    Its position is the one with the encoder's turns, in [rad], and None where position or
    velocity cannot be used; ``is_split`` says that the states come from two sources.
    """
    if is_split:
        return StateKind.CONFLICT
    last_ns = state.stamp_ns
    if stamp_ns == last_ns or stamp_ns == state.refused_ns:
        return StateKind.REPEAT
    if position is None:
        return StateKind.UNUSABLE
    dt = 0.0 if last_ns is None else (stamp_ns - last_ns) * SECONDS_PER_NANOSECOND
    if 0.0 < dt <= rules.timeout:
        kind = NEXT
    elif last_ns is None:
        kind = StateKind.FIRST
    elif dt < 0.0 and rules.is_simulated:
        return StateKind.RESET  # which forgets the turns
    elif not _is_stamp_confirmed(stamp_ns, last_ns, state.refused_ns, rules.timeout):
        return StateKind.LATE if dt > 0.0 else StateKind.EARLIER
    else:
        kind = StateKind.RESUMED if dt > 0.0 else StateKind.SET_BACK
    if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
        return StateKind.UNUSABLE
    if (
        kind is not NEXT
        or abs(position - state.position) <= rules.step_max + rules.speed_max * dt
        or state.is_takeover_due
    ):
        return kind
    if state.outlier is None:
        return StateKind.JUMP
    is_there = _is_near(stamp_ns, position, state.outlier, rules)
    return StateKind.MOVED if is_there else StateKind.STRAY


def _is_stamp_confirmed(
    stamp_ns: int, last_ns: int, refused_ns: int | None, timeout: float
) -> bool:
    """Return whether the state before confirms a stamp that is no next one.

    Both lie before the last usable one, or beyond it by more than the timeout, or it follows the
    state before within that.
    """
    if refused_ns is None or stamp_ns < refused_ns:
        return False
    if stamp_ns < last_ns:  # and so was the one before
        return True
    return (stamp_ns - refused_ns) * SECONDS_PER_NANOSECOND <= timeout or (
        refused_ns - last_ns
    ) * SECONDS_PER_NANOSECOND > timeout


def _is_near(stamp_ns: int, position: float, outlier: Outlier, rules: StateRules) -> bool:
    """Return whether the joint can be at a position if it was at the outlier's."""
    dt = (stamp_ns - outlier.stamp_ns) * SECONDS_PER_NANOSECOND
    distance = position - outlier.position
    if abs(distance) > 0.5 * rules.turn:
        distance -= rules.turn * round(distance / rules.turn)
    return dt > 0.0 and abs(distance) <= rules.step_max + rules.speed_max * dt

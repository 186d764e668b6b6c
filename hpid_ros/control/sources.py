"""Whether the states of a joint come from one source, by their stamps and positions alone.

A joint has one driver. Where a second node publishes states of it (``joint_state_publisher`` next
to a driver), the states are two sequences that take turns: one stamp has two positions, positions
jump to and fro, or stamps do. A state *parts* from the one before it where its position is too far
away, or its stamp goes back or leaps; a *return* is a state that parts and goes on the sequence
that was left. One wrong state, a jump to another place, and a clock that was set make one return
at most. Three returns are two sources.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hpid_ros.base.units import SECONDS_PER_NANOSECOND


class SourceRule(NamedTuple):
    """What tells two sources from one."""

    agree_within: float = 0.02  # [rad] of the state before: sources that agree harm nobody
    same_stamp_within: float = 0.005  # [rad] of the state with the same stamp, if that is coarse
    counts: float = 2.0  # of an encoder, between which it may flicker
    noise: float = 8.0  # times the usual distance of two states of one sequence
    noise_share: float = 0.125  # of the newest distance in the usual one
    near: float = 0.25  # of the way that it parted; as near a state goes on the other sequence
    pair: int = 2  # states of either source after a stamp that came twice
    returns: int = 3  # there, back, there again and back again
    window: float = 0.5  # [s] beyond state_timeout; a source that is slower is not recognised


SOURCE_RULE = SourceRule()
"""The rule, for the exported loops, too."""


class SourceBounds(NamedTuple):
    """What one source may do."""

    apart: float  # [rad] from one state to the next
    twice: float  # [rad] between two states with one stamp
    turn: float  # [rad]; positions whole turns apart are the same
    back: float  # [s] by which a stamp may go back
    window: float  # [s] of the stamps between two states of one source


def source_bounds(
    *,
    timeout: float,
    is_simulated: bool,
    resolution: float = 0.0,
    step_max: float = 0.0,
    wrap: float = 0.0,
) -> SourceBounds:
    """Return the bounds that the settings of a joint give.

    A simulated clock never goes back but for a reset; the stamps of a driver may jitter.
    """
    counts = SOURCE_RULE.counts * resolution
    return SourceBounds(
        apart=max(SOURCE_RULE.agree_within, counts, step_max),
        twice=max(SOURCE_RULE.same_stamp_within, counts),
        turn=wrap if wrap > 0.0 else math.tau,
        back=0.0 if is_simulated else timeout,
        window=SOURCE_RULE.window + timeout,
    )


_NOISE, _NOISE_SHARE, _NEAR = SOURCE_RULE.noise, SOURCE_RULE.noise_share, SOURCE_RULE.near


class SourceWatch:
    """Recognises two sources of one joint's states, and that one of them has ended."""

    __slots__ = (
        "_apart",
        "_back_ns",
        "_doubled",
        "_has_other",
        "_other",
        "_other_ns",
        "_position",
        "_returns",
        "_since_ns",
        "_stamp_ns",
        "_turn",
        "_twice",
        "_usual",
        "_window_ns",
        "is_split",
        "positions",
    )

    def __init__(self, bounds: SourceBounds) -> None:
        self.adopt(bounds)
        self.reset()

    @property
    def conflict(self) -> str:
        """Where the joint is by two sources; empty while there is one."""
        if not self.is_split:
            return ""
        one, other = self.positions
        return f"one says {one:.4g} rad, one {other:.4g} rad"

    def adopt(self, bounds: SourceBounds) -> None:
        """Go by other bounds from the next state on."""
        self._apart, self._twice, self._turn = bounds.apart, bounds.twice, bounds.turn
        self._back_ns = round(bounds.back / SECONDS_PER_NANOSECOND)
        self._window_ns = round(bounds.window / SECONDS_PER_NANOSECOND)

    def reset(self) -> None:
        """Forget the past: the next state is the first one."""
        self.is_split = False
        """Whether the states come from two sources."""
        self.positions = 0.0, 0.0
        """Where the joint is by either of them, in [rad]."""
        self._stamp_ns: int | None = None
        self._position = 0.0
        self._has_other = False  # there is a sequence that was left
        self._other_ns, self._other = 0, 0.0  # its last state
        self._since_ns = 0  # stamp of the first state since then
        self._doubled = 0  # states left in which stamps are taken to come twice
        self._returns = 0
        self._usual = 0.0  # [rad] distance between two states of one sequence

    def take(self, stamp_ns: int, position: float) -> bool:
        """Take a state with a finite position, and return whether there are two sources."""
        before_ns = self._stamp_ns
        if before_ns is None:
            self._stamp_ns = self._since_ns = stamp_ns
            self._position = position
            return False
        since_ns, apart = stamp_ns - before_ns, self._distance(position, self._position)
        noise = _NOISE * self._usual
        if since_ns == 0:
            if apart <= max(self._twice, noise):
                return self.is_split
            self._doubled = SOURCE_RULE.pair
            self._part(stamp_ns, position, _NEAR * apart)
            return self.is_split
        is_later = -self._back_ns <= since_ns <= self._window_ns
        bound = self._apart
        if self._doubled:
            self._doubled -= 1
            bound = self._twice
        is_near = apart <= bound or apart <= noise
        if is_later and is_near:
            self._go_on(stamp_ns, position, apart)
        else:  # where it parted by its stamp alone, the sequences may be near each other
            near = bound if is_near else _NEAR * apart
            self._part(stamp_ns, position, near)
        return self.is_split

    def _go_on(self, stamp_ns: int, position: float, apart: float) -> None:
        """Go on with the present sequence; after long enough the other one has ended."""
        self._stamp_ns, self._position = stamp_ns, position
        self._usual += _NOISE_SHARE * (apart - self._usual)
        if self._returns and stamp_ns - self._since_ns > self._window_ns:
            self._returns, self.is_split = 0, False

    def _part(self, stamp_ns: int, position: float, near: float) -> None:
        """Leave the present sequence, for the other one or for a new one."""
        assert self._stamp_ns is not None
        off = self._distance(position, self._other)
        is_on_time = self._has_other and 0 <= stamp_ns - self._other_ns <= self._window_ns
        if off <= near and is_on_time:
            self._returns += 1
            self._usual += _NOISE_SHARE * (off - self._usual)
            if self._returns >= SOURCE_RULE.returns:
                self.is_split = True
                self.positions = self._position, position
        elif not self.is_split:
            self._returns = 0
        self._has_other = True
        self._other_ns, self._other = self._stamp_ns, self._position
        self._stamp_ns = self._since_ns = stamp_ns
        self._position = position

    def _distance(self, position: float, other: float) -> float:
        """Return how far apart two positions are, but for whole turns, in [rad]."""
        apart = position - other
        if abs(apart) > 0.5 * self._turn:
            apart -= self._turn * round(apart / self._turn)
        return abs(apart)

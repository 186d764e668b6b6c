"""Golden vectors: states that a joint may have, and what Python's loop answers to each."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from hpid_ros.base.errors import HpidError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.export.parameters import in_single, to_single

_ROWS = 1000
_RETUNE_AT = 520
_LARGEST_SWING = 0.3  # [rad]
_SAFETY = 300.0
_PRECISIONS = 2.0**29  # a last place in single precision, in those of double precision


@dataclass
class GivenReference:
    """A reference that is told anew with each state, as a firmware does.

    It is under way whenever a loop takes it up, so that the loop glides onto it.
    """

    position: float = 0.0  # [rad]
    velocity: float = 0.0  # [rad/s]

    def start(self, now_ns: int, position: float, velocity: float) -> GivenReference:
        """Return itself: it is what it was told, at all times."""
        return self

    def is_under_way(self, now_ns: int) -> bool:
        """Return True."""
        return True

    def target(self, now_ns: int) -> float:
        """Return the position that was told last, in [rad]."""
        return self.position

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return position, velocity and no acceleration."""
        return self.position, self.velocity, 0.0

    @property
    def gives_effort(self) -> bool:
        """Return False."""
        return False

    def effort(self, stamp_ns: int) -> float:
        """Return 0."""
        return 0.0


class GivenLoop:
    """Python's loop, called as the exported one: with the reference of each state."""

    def __init__(self, settings: LoopSettings) -> None:
        self.loop = JointLoop(settings)
        self._reference = GivenReference()
        self.loop.follow(self._reference)

    def step(
        self,
        stamp_ns: int,
        reference: float,
        rate: float,
        position: float,
        velocity: float | None,
    ) -> float:
        """Take one state and return the effort that answers it in [N m].

        A reference that is no joint's makes the state one that cannot be used: Python's motions
        have none, they are checked before.

        Args:
            stamp_ns: In [ns].
            reference: Where the joint should be, in [rad].
            rate: How fast, in [rad/s].
            position: Measured, in [rad].
            velocity: Measured, in [rad/s]; None where it is not.
        """
        if not all(-LARGEST_POSITION <= each <= LARGEST_POSITION for each in (reference, rate)):
            return self.loop.reject(stamp_ns, f"reference {reference} rad, {rate} rad/s")
        self._reference.position, self._reference.velocity = reference, rate
        return self.loop.step(stamp_ns, position, velocity)


class GoldenRow(NamedTuple):
    """One state, and what Python's loop answers."""

    stamp_ns: int  # [ns]
    reference: float  # [rad] where the joint should be
    rate: float  # [rad/s] how fast
    position: float  # [rad] measured
    velocity: float | None  # [rad/s] measured; None where it is not
    effort: float  # [N m] the answer


@dataclass(frozen=True)
class Golden:
    """Golden vectors of one loop."""

    rows: tuple[GoldenRow, ...]  # the states, in their order
    retune_at: int  # before this row the loop is retuned, its gains first, then its degree
    retuned: LoopSettings  # to these settings
    double_tolerance: float  # [N m]
    single_tolerance: float  # [N m] in single precision


def golden_vectors(settings: LoopSettings) -> Golden:
    """Return states that bring a loop into all that it does, with Python's answers.

    A swing about a resting position, with an error that decays over five decades; among the
    states are those of :func:`_disturbed`. They are the same for the same settings.

    What may deviate is measured: three hundred times what it changes to round every setting
    and every number of a state to the precision, and the efforts themselves. Of 2000 random
    loops in single precision none deviated by more than 0.4 of it.
    """
    states, retuned = _disturbed(settings), _retuned(settings)
    rows = _answered(states, settings, retuned)
    largest = max(abs(row.effort) for row in rows)
    deviation = math.ulp(1.0) * largest * _PRECISIONS  # half a last place in single precision
    with suppress(HpidError):  # settings that are none in single precision
        rounded = [_rounded(state) for state in states]
        others = _answered(rounded, in_single(settings), in_single(retuned))
        pairs = zip(rows, others, strict=True)
        deviation += max(abs(row.effort - other.effort) for row, other in pairs)
    tolerance = _SAFETY * deviation
    return Golden(tuple(rows), _RETUNE_AT, retuned, tolerance / _PRECISIONS, tolerance)


def _answered(
    states: Sequence[GoldenRow], settings: LoopSettings, retuned: LoopSettings
) -> list[GoldenRow]:
    """Return states with the efforts that answer them."""
    given, rows = GivenLoop(settings), []
    for row, state in enumerate(states):
        if row == _RETUNE_AT:
            given.loop.retune(settings.with_parameters(_gains(retuned)))
            given.loop.retune(retuned)
        rows.append(state._replace(effort=given.step(*state[:-1])))
    return rows


def _rounded(state: GoldenRow) -> GoldenRow:
    stamp_ns, *numbers = state
    return GoldenRow(stamp_ns, *(None if each is None else to_single(each) for each in numbers))  # type: ignore[arg-type]


def _gains(settings: LoopSettings) -> dict[str, float]:
    gains = settings.gains
    return {"gains.p": gains.p, "gains.i": gains.i, "gains.d": gains.d}


def _retuned(settings: LoopSettings) -> LoopSettings:
    """Return the settings with other gains and another degree, where they can have them."""
    gains = settings.gains
    changes = {"gains.p": 1.1 * gains.p, "gains.i": 0.9 * gains.i, "gains.d": 1.05 * gains.d}
    for change in ({**changes}, {"mu": 0.75 * settings.mu}):
        try:
            settings = settings.with_parameters(change)
        except HpidError:  # a gain at its end, or a floor that then has no room
            continue
    return settings


def _swing(settings: LoopSettings) -> tuple[float, float]:
    """Return middle and amplitude of a swing that stays between the stops, in [rad]."""
    lower, upper = settings.motion.lower, settings.motion.upper
    amplitude = min(_LARGEST_SWING, 0.4 * (upper - lower))
    return min(max(0.0, lower + amplitude), upper - amplitude), amplitude


def _undisturbed(settings: LoopSettings) -> list[GoldenRow]:
    """Return states at even stamps; efforts are still to come."""
    middle, amplitude = _swing(settings)
    period = settings.timing.control_period
    chance = random.Random(1)
    rows: list[GoldenRow] = []
    for row in range(_ROWS):
        angle = math.tau * row / 400.0
        reference = middle + amplitude * math.sin(angle)
        rate = amplitude * math.cos(angle) * math.tau / 400.0 / period
        decay = 10.0 ** (-5.0 * (row % 250) / 250.0)
        error = amplitude * decay * math.cos(math.tau * row / 60.0)
        position = reference - error
        speed = (position - rows[-1].position) / period if rows else 0.0
        velocity = speed * (1.0 + 0.01 * chance.gauss(0.0, 1.0))
        stamp_ns = NANOSECONDS + round(row * period * NANOSECONDS)
        rows.append(GoldenRow(stamp_ns, reference, rate, position, velocity, 0.0))
    return rows


def _disturbed(settings: LoopSettings) -> list[GoldenRow]:
    """Return states with a repeat, some that cannot be used, and times that are none."""
    rows = _undisturbed(settings)
    later_ns = round(5.0 * settings.timing.state_timeout * NANOSECONDS)

    def change(row: int, **values: Any) -> None:
        rows[row] = rows[row]._replace(**values)

    def shift(first: int, by_ns: int = 0, by: float = 0.0) -> None:
        for row in range(first, _ROWS):
            state = rows[row]
            change(row, stamp_ns=state.stamp_ns + by_ns, position=state.position + by)

    change(121, stamp_ns=rows[120].stamp_ns)  # a repeat
    change(180, position=math.nan)
    change(200, velocity=math.nan)
    for row in range(220, 240):
        change(row, velocity=None)
    shift(300, by_ns=later_ns)  # a gap
    change(400, position=rows[400].position + 4.0)  # passed over
    change(600, position=-math.inf)
    shift(650, by=3.5)  # a jump that is believed, with the second state
    change(750, stamp_ns=rows[750].stamp_ns + later_ns)  # a stamp from the future
    shift(800, by_ns=-3 * later_ns)  # the clock goes back
    change(900, rate=math.nan)
    change(950, reference=math.inf)
    return rows

"""What a loop can be told to follow, and how it takes a motion over without a jump."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from hpid_ros.errors import SettingError

LARGEST_POSITION = 1e9
"""Positions, velocities and references beyond this [rad, rad/s] are no joint's."""

SECONDS_PER_NANOSECOND = 1e-9


class Reference(Protocol):
    """Where the joint should be, on the control clock."""

    def sample(self, stamp_ns: int) -> Sequence[float]:
        """Return position [rad], velocity [rad/s], acceleration [rad/s^2] at an instant [ns]."""


class Motion(Protocol):
    """What a loop can be told to do: it becomes a reference when the loop takes it over."""

    def start(self, now_ns: int, position: float, velocity: float) -> Reference:
        """Take over from where the reference stands, see ``trajectory.Column.start``."""

    def is_under_way(self, now_ns: int) -> bool:
        """Tell whether it began before an instant, so that taking it over would jump."""

    def target(self, now_ns: int) -> float:
        """Return the position that it leads to first, or has now if it is under way, in [rad]."""


@dataclass(frozen=True)
class Setpoint:
    """Hold one position.

    Attributes:
        position: In [rad].

    Raises:
        SettingError: The position is not finite, or no joint's.
    """

    position: float

    def __post_init__(self) -> None:
        if not -LARGEST_POSITION <= self.position <= LARGEST_POSITION:
            raise SettingError(
                f"a setpoint must be finite and within {LARGEST_POSITION:g} rad, "
                f"not {self.position}"
            )

    def start(self, now_ns: int, position: float, velocity: float) -> Setpoint:
        """Return itself: a setpoint is the same at all times."""
        return self

    def is_under_way(self, now_ns: int) -> bool:
        """Return False: whoever sends a setpoint means a step."""
        return False

    def target(self, now_ns: int) -> float:
        """Return the position."""
        return self.position

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the position at rest."""
        return self.position, 0.0, 0.0


@dataclass(frozen=True)
class Turned:
    """Another reference, whole turns away.

    Attributes:
        onto: The other reference.
        offset: How much further this one is, in [rad].
    """

    onto: Reference
    offset: float

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the reference at an instant."""
        position, velocity, acceleration = self.onto.sample(stamp_ns)
        return position + self.offset, velocity, acceleration


class Glide:
    r"""A reference that begins where the joint is and ends on another one.

    The difference at the start, :math:`\delta` in position and :math:`\dot\delta` in velocity,
    fades with the quintics that have no acceleration at either end, over :math:`s \in [0, 1]`:

    .. math::
        \delta\,(1 - 10 s^3 + 15 s^4 - 6 s^5) + \dot\delta\,T\,(s - 6 s^3 + 8 s^4 - 3 s^5)

    Args:
        onto: The reference to end on.
        now_ns: The instant of the start in [ns].
        position: Where it starts in [rad].
        velocity: How fast it starts in [rad/s].
        duration: T in [s], positive.
    """

    def __init__(
        self, onto: Reference, now_ns: int, position: float, velocity: float, duration: float
    ) -> None:
        target = onto.sample(now_ns)
        self.onto = onto
        self._begin_ns = now_ns
        self._duration = duration
        self.end_ns = now_ns + round(duration / SECONDS_PER_NANOSECOND)
        self._offset = position - target[0]
        self._carried = (velocity - target[1]) * duration

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the reference at an instant."""
        position, velocity, acceleration = self.onto.sample(stamp_ns)
        if not self._begin_ns <= stamp_ns < self.end_ns:
            return position, velocity, acceleration
        T, a, b = self._duration, self._offset, self._carried
        s = (stamp_ns - self._begin_ns) * SECONDS_PER_NANOSECOND / T
        squared = s * s
        cubed = squared * s
        return (
            position
            + a * (1.0 - cubed * (10.0 - 15.0 * s + 6.0 * squared))
            + b * (s - cubed * (6.0 - 8.0 * s + 3.0 * squared)),
            velocity
            + a / T * (-30.0 * squared * (1.0 - 2.0 * s + squared))
            + b / T * (1.0 - squared * (18.0 - 32.0 * s + 15.0 * squared)),
            acceleration
            + a / (T * T) * (-60.0 * s * (1.0 - 3.0 * s + 2.0 * squared))
            + b / (T * T) * (-s * (36.0 - 96.0 * s + 60.0 * squared)),
        )

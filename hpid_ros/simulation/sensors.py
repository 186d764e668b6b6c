"""Encoders and Hall switches on the joints' output shafts.

An incremental encoder knows how far a joint has turned since power came on, not where it stands.
A joint is led past a magnet at constant speed; when the switch is seen to change, the counter
is set to the position at which the switch is said to change.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from hpid_ros.base.errors import SettingError
from hpid_ros.documents.records import Record, quantity


@dataclass(frozen=True)
class Encoder:
    """A position sensor with a finite number of counts per revolution.

    A position is rounded to the middle of its count: the error is at most half a count,
    pi / counts, either way. Where the counts begin is a matter of how the disc was mounted.
    """

    # counts per revolution of the joint's output shaft (all four edges of each line)
    counts: int = 0
    phase: float = 0.0  # [counts] where zero lies in its count, from the middle

    def __post_init__(self) -> None:
        if isinstance(self.counts, bool) or not isinstance(self.counts, int) or self.counts < 0:
            raise SettingError(
                f"encoder_counts {self.counts!r} must be a whole number >= 0 (0: ideal sensor)"
            )

    @property
    def resolution(self) -> float:
        """Size of one count, in [rad]; 0 for an ideal sensor."""
        return math.tau / self.counts if self.counts else 0.0

    def read(self, position: float) -> float:
        """Return the measured position."""
        counts, phase = self.counts, self.phase
        if not counts:
            return position
        return (round(position * counts / math.tau + phase) - phase) * math.tau / counts


LEAST_SPEED = 1e-6  # [rad/s]
FARTHEST = 1e3  # [rad]


@dataclass(frozen=True)
class HallSwitch(Record):
    """A switch that is on beyond a position, with a hysteresis."""

    position: float = quantity(
        "Middle of its two switching points", "rad", least=-FARTHEST, most=FARTHEST
    )
    hysteresis: float = quantity("Distance between them", "rad", default=0.0, least=0.0)

    def read(self, position: float, was_on: bool) -> bool:
        """Return whether the switch is on."""
        half = self.hysteresis / 2.0
        return position > self.position + (-half if was_on else half)


@dataclass(frozen=True)
class Homing(Record):
    """A homing run, done before time 0.

    The joint is led from its initial position towards the switch, and past it, by a drive that
    keeps its speed; the board looks at the switch once a control period, at a moment of the
    travel that chance decides. The error that remains is the way from the switch's place to
    where it was seen, at most half the hysteresis and one period's way, and the encoder's
    rounding.
    """

    speed: float = quantity("Of the run", "rad/s", least=LEAST_SPEED)
    position: float = quantity(
        "Where the Hall switch is", "rad", default=0.0, least=-FARTHEST, most=FARTHEST
    )
    hysteresis: float = quantity("Of the Hall switch", "rad", default=0.0, least=0.0)

    @property
    def switch(self) -> HallSwitch:
        """The switch."""
        return HallSwitch(self.position, self.hysteresis)

    def largest_error(self, period: float, encoder: Encoder) -> float:
        """Return the bound on :meth:`error`'s absolute value, in [rad]."""
        return self.hysteresis / 2.0 + self.speed * period + encoder.resolution / 2.0

    def error(self, start: float, period: float, encoder: Encoder, chance: random.Random) -> float:
        """Run, and return what the readings are wrong by from then on."""
        switch = self.switch
        was_on = start > switch.position
        step = math.copysign(self.speed * period, -1.0 if was_on else 1.0)
        edge = switch.position + math.copysign(switch.hysteresis / 2.0, step)
        # No look before the edge can see anything: the run begins with the last of them.
        offset = chance.random()
        before = max(0, math.floor((edge - start) / step - offset))
        seen = start + (offset + before) * step
        while switch.read(seen, was_on) == was_on:
            seen += step
        return switch.position - encoder.read(seen)


VELOCITIES = ("none", "differences")


@dataclass(frozen=True)
class Sensor(Record):
    """What measures one joint's position."""

    encoder_counts: int = quantity(
        "Counts per revolution of the joint; 0 measures exactly", default=0, least=0
    )
    noise: float = quantity(
        "Standard deviation of a position before it is measured", "rad", default=0.0, least=0.0
    )
    homing: Homing | None = quantity(
        "The homing run; off where the position at the start is known", default=None
    )

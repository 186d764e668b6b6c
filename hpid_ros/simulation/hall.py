"""Where zero is: a Hall switch, and the homing run that finds it.

An incremental encoder knows how far a joint has turned since power came on, not where it stands.
A joint is led past a magnet at constant speed; when the switch is seen to change, the counter
is set to the position at which the switch is said to change.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from hpid_ros.errors import SettingError
from hpid_ros.simulation.encoders import Encoder

LEAST_SPEED = 1e-6  # [rad/s]
FARTHEST = 1e3  # [rad]


@dataclass(frozen=True)
class HallSwitch:
    """A switch that is on beyond a position, with a hysteresis.

    Attributes:
        position: Middle of its two switching points, at most 1000 either way, in [rad].
        hysteresis: Distance between them, in [rad].

    Raises:
        SettingError: A value is not finite, or the hysteresis negative.
    """

    position: float
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        if not abs(self.position) <= FARTHEST:
            raise SettingError(
                f"homing.position {self.position!r} must be in [-{FARTHEST:g}, {FARTHEST:g}] rad"
            )
        if not (math.isfinite(self.hysteresis) and self.hysteresis >= 0.0):
            raise SettingError(f"homing.hysteresis {self.hysteresis!r} must be finite and >= 0")

    def read(self, position: float, was_on: bool) -> bool:
        """Return whether the switch is on.

        Args:
            position: Of the joint, in [rad].
            was_on: Whether it was on before.
        """
        half = self.hysteresis / 2.0
        return position > self.position + (-half if was_on else half)


@dataclass(frozen=True)
class Homing:
    """A homing run, done before time 0.

    The joint is led from its initial position towards the switch, and past it, by a drive that
    keeps its speed; the board looks at the switch once a control period, at a moment of the
    travel that chance decides. The error that remains is the way from the switch's place to
    where it was seen, at most half the hysteresis and one period's way, and the encoder's
    rounding.

    Attributes:
        speed: Of the run, in [rad/s].
        position: Where the switch is, in [rad].
        hysteresis: Of the switch, in [rad].

    Raises:
        SettingError: A value is out of its range.
    """

    speed: float
    position: float = 0.0
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.speed) and self.speed >= LEAST_SPEED):
            raise SettingError(
                f"homing.speed {self.speed!r} must be a finite number >= {LEAST_SPEED:g} [rad/s]"
            )
        _ = self.switch

    @property
    def switch(self) -> HallSwitch:
        """The switch."""
        return HallSwitch(self.position, self.hysteresis)

    def largest_error(self, period: float, encoder: Encoder) -> float:
        """Return the bound on :meth:`error`'s absolute value, in [rad].

        Args:
            period: Time between two looks at the switch, in [s].
            encoder: The joint's encoder.
        """
        return self.hysteresis / 2.0 + self.speed * period + encoder.resolution / 2.0

    def error(self, start: float, period: float, encoder: Encoder, chance: random.Random) -> float:
        """Run, and return what the readings are wrong by from then on.

        Args:
            start: Position at which power came on, in [rad].
            period: Time between two looks at the switch, in [s].
            encoder: The joint's encoder.
            chance: Decides when the switch is looked at.

        Returns:
            Reading minus position, the encoder's rounding aside, in [rad].
        """
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

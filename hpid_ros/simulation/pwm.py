"""An H-bridge with pulse width modulation, averaged over its periods."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.errors import SettingError

LARGEST_BITS = 32
_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Pwm:
    """A duty register of a number of bits beside a direction pin, taken over at a rate.

    The ripple of one PWM period is not simulated: the mean voltage acts.

    Attributes:
        bits: Resolution of the duty's magnitude: 2^bits - 1 steps from 0 to 1.
        dead_band: Duties smaller than this give nothing, in [0, 1).
        rate: How often the register is taken over, in [Hz]; 0 is with every physics step.

    Raises:
        SettingError: A value is out of its range.
    """

    bits: int
    dead_band: float = 0.0
    rate: float = 0.0

    def __post_init__(self) -> None:
        whole = isinstance(self.bits, int) and not isinstance(self.bits, bool)
        if not (whole and 1 <= self.bits <= LARGEST_BITS):
            raise SettingError(
                f"pwm.bits {self.bits!r} must be a whole number from 1 to {LARGEST_BITS}"
            )
        if not 0.0 <= self.dead_band < 1.0:
            raise SettingError(f"pwm.dead_band {self.dead_band!r} must be in [0, 1)")
        if not (math.isfinite(self.rate) and 0.0 <= self.rate <= _NANOSECONDS):
            raise SettingError(f"pwm.rate {self.rate!r} must be a number from 0 to 1e9 [Hz]")

    @property
    def resolution(self) -> float:
        """Smallest step of the duty."""
        return 1.0 / (2**self.bits - 1)

    def output(self, duty: float) -> float:
        """Return the duty that acts: the nearest step, or 0 in the dead band.

        Args:
            duty: The duty asked for; held to [-1, 1].
        """
        magnitude = min(abs(duty), 1.0)
        if magnitude < self.dead_band:
            return 0.0
        steps = 2**self.bits - 1
        return math.copysign(round(magnitude * steps) / steps, duty)

    def cycle(self, time_ns: int) -> int:
        """Return the number of the register's present cycle; a new one takes the register over.

        Args:
            time_ns: Simulated time, in [ns].
        """
        return math.floor(time_ns * self.rate / _NANOSECONDS) if self.rate else time_ns

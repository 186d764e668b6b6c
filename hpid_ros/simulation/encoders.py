"""Incremental encoders on the joints' output shafts."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.errors import SettingError


@dataclass(frozen=True)
class Encoder:
    """A position sensor with a finite number of counts per revolution.

    A position is rounded to the middle of its count: the error is at most half a count,
    pi / counts, either way. Where the counts begin is a matter of how the disc was mounted.

    Attributes:
        counts: Counts per revolution of the joint's output shaft (all four edges of each line);
            0 is an ideal sensor.
        phase: Where zero lies in its count, from the middle, in [counts].

    Raises:
        SettingError: The number of counts is negative or not a whole number.
    """

    counts: int = 0
    phase: float = 0.0

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
        """Return the measured position.

        Args:
            position: True position, in [rad].

        Returns:
            The middle of the count that the position is in, in [rad].
        """
        if not self.counts:
            return position
        count = round(position * self.counts / math.tau + self.phase)
        return (count - self.phase) * math.tau / self.counts

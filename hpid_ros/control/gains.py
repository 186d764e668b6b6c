"""The three gains of a PID."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.errors import GainError


@dataclass(frozen=True)
class Gains:
    """Gains of a PID on error = reference - measurement; the linear ones and the homogeneous.

    Attributes:
        p: Proportional gain, in [N m / rad].
        i: Integral gain, in [N m / (rad s)].
        d: Derivative gain, in [N m s / rad].

    Raises:
        GainError: A gain is not finite or is negative.
    """

    p: float
    i: float
    d: float

    def __post_init__(self) -> None:
        for name in ("p", "i", "d"):
            value = getattr(self, name)
            if not math.isfinite(value) or value < 0.0:
                raise GainError(
                    f"gain {name} must be finite and not negative "
                    f"(error = reference - measurement), not {value}"
                )

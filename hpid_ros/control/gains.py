"""The three gains of a PID, and whether they stabilise the linear loop."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.base.errors import GainError


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


def is_hurwitz(gains: Gains, inertia: float = 1.0) -> bool:
    """Tell whether the linear PID stabilises a joint of this inertia.

    The loop on ``m e'' = -u + p`` is ``m s^3 + kd s^2 + kp s + ki``; by Routh and Hurwitz it is
    stable if and only if the gains are positive and ``kp kd > m ki``. Without integral action
    the loop is of second order and positive ``kp`` and ``kd`` suffice.
    """
    return gains.p > 0.0 and gains.d > 0.0 and gains.p * gains.d > inertia * gains.i


def require_hurwitz(gains: Gains, inertia: float) -> None:
    """Refuse gains whose linear loop is unstable."""
    if not math.isfinite(inertia) or inertia <= 0.0:
        raise GainError(f"the inertia must be positive and finite, not {inertia} kg m^2")
    if not is_hurwitz(gains, inertia):
        raise GainError(
            f"the loop is unstable: p d = {gains.p * gains.d:g} must exceed "
            f"i x inertia = {gains.i * inertia:g} (p {gains.p:g}, i {gains.i:g}, d {gains.d:g}, "
            f"inertia {inertia:g} kg m^2), and p and d must be positive"
        )

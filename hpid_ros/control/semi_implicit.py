"""The homogeneous PID for slow sampling."""

from __future__ import annotations

import math

from hpid_ros.control.gains import Gains
from hpid_ros.control.homogeneous_pid import HomogeneousNorm, HomogeneousPid
from hpid_ros.errors import GainError


class SemiImplicitHomogeneousPid(HomogeneousPid):
    r"""Homogeneous PID that answers where the joint will be one period later.

    The multiplier is taken at the sample, and error and error rate at its end, as the joint's
    own inertia will have moved them: with :math:`a = k_p\lambda^2`, :math:`b = k_d\lambda` and
    :math:`D = 1 + (T b + T^2 a)/m`,

    .. math::
        u = \frac{a e + (b + T a)\dot e}{D} + I, \qquad
        I^+ = I + T k_i\lambda^3\,\frac{(1 + T b/m)\,e + T\dot e}{D}

    It costs one division more than :class:`HomogeneousPid`, is the same in the limit of fast
    sampling, and stays stable where T kd lam / m is not small: worth its while from about
    T = 5 ms. At degree zero it is the PID by backward Euler.

    Source: backward Euler of the paper's law, equation (8), on m e'' = -u + p.

    Args:
        gains: The gains of the PID that it upgrades.
        norm: A homogeneous norm; its degree is the law's.
        norm_floor: The norm is not let below this.
        norm_cap: The norm is not let above this.
        inertia: What one unit of effort accelerates, in [kg m^2].

    Raises:
        NormError: The floor is negative or not below the cap.
        GainError: The inertia is not positive and finite.
    """

    __slots__ = ("inertia",)

    def __init__(
        self,
        gains: Gains,
        norm: HomogeneousNorm,
        norm_floor: float = 0.0,
        norm_cap: float = math.inf,
        *,
        inertia: float,
    ) -> None:
        if not (math.isfinite(inertia) and inertia > 0.0):
            raise GainError(f"the inertia must be positive and finite, not {inertia} kg m^2")
        self.inertia = inertia
        super().__init__(gains, norm, norm_floor, norm_cap)

    def update(self, error: float, error_rate: float, dt: float) -> float:
        """Take one sample.

        Args:
            error: Reference minus measured position, in [rad].
            error_rate: Its time derivative, in [rad/s].
            dt: Time until the next sample, in [s].

        Returns:
            The effort in [N m], with the integral before this sample's increment.
        """
        gains, integral = self.gains, self._integral
        multiplier = self.multiplier(error, error_rate)
        square = multiplier * multiplier
        stiffness = gains.p * square
        damping = gains.d * multiplier
        moved = dt / self.inertia
        divisor = 1.0 + moved * (damping + dt * stiffness)
        self._proportional = proportional = stiffness * error / divisor
        self._derivative = derivative = (damping + dt * stiffness) * error_rate / divisor
        self._integral_used = integral
        error_after = ((1.0 + moved * damping) * error + dt * error_rate) / divisor
        self._integral = integral + dt * (gains.i * (square * multiplier) * error_after)
        return proportional + derivative + integral

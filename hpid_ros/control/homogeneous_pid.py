"""Gains, the linear PID, the homogeneous PID, and its semi-implicit variant.

The paper is Luna, Chairez and Polyakov, arXiv 2511.16406. Sign convention, once for the whole
package: the paper writes ``e = y - y*`` with negative gains; here, as everywhere in ROS,
``error = reference - measurement`` with positive gains. Both give the same effort.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.base.records import Record, quantity
from hpid_ros.control.norms import Norm, WeightedNorm, require_floor


def _gain(term: str, unit: str) -> Any:
    text = f"{term} gain [{unit}]; error = reference - measurement, gains positive"
    return quantity(text, default=0.0, least=0.0, most=1e6)


@dataclass(frozen=True)
class Gains(Record, prefix="gains."):
    """Gains of a PID on error = reference - measurement; the linear ones and the homogeneous.

    Attributes:
        p: Proportional gain, in [N m / rad].
        i: Integral gain, in [N m / (rad s)].
        d: Derivative gain, in [N m s / rad].

    Raises:
        GainError: A gain is not within [0, 1e6].
    """

    p: float = _gain("Proportional", "N m/rad")
    i: float = _gain("Integral", "N m/(rad s)")
    d: float = _gain("Derivative", "N m s/rad")

    def __post_init__(self) -> None:
        try:
            super().__post_init__()
        except SettingError as error:
            raise GainError(str(error)) from None


def is_hurwitz(gains: Gains, inertia: float = 1.0) -> bool:
    """Return whether the linear PID stabilises a joint of this inertia.

    The loop on ``m e'' = -u + w`` (w the load) is ``m s^3 + kd s^2 + kp s + ki``; by Routh and
    Hurwitz it is stable if and only if the gains are positive and ``kp kd > m ki``. Without
    integral action the loop is of second order and positive ``kp`` and ``kd`` suffice.
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


class Terms(NamedTuple):
    """What each term contributed to an effort."""

    p: float  # [N m] proportional term
    i: float  # [N m] integral term
    d: float  # [N m] derivative term


class Pid:
    """Linear PID, ``u = kp e + kd de + I`` with ``dI/dt = ki e``, by forward Euler.

    The gain ``ki`` stands inside the integral, so that changing it does not jump.

    Args:
        gains: The gains.
    """

    __slots__ = ("_answer", "_integral", "_integral_used", "gains")

    _integral: float
    _integral_used: float
    _answer: tuple[float, float, float]

    def __init__(self, gains: Gains) -> None:
        self.gains = gains
        self.reset()

    @property
    def integral(self) -> float:
        """The integral term that the next sample uses, in [N m]."""
        return self._integral

    @property
    def terms(self) -> Terms:
        """The terms of the last sample."""
        proportional, derivative, _ = self._answer
        return Terms(proportional, self._integral_used, derivative)

    def update(self, error: float, error_rate: float, dt: float) -> float:
        """Take one sample.

        Args:
            error: Reference minus measured position, in [rad].
            error_rate: Its time derivative, in [rad/s].
            dt: Time over which the error is integrated, in [s].

        Returns:
            The effort in [N m], with the integral before this sample's increment.
        """
        self._answer = answer = self.answer(error, error_rate, dt)
        proportional, derivative, increment = answer
        self._integral_used = integral = self._integral
        self._integral = integral + increment
        return proportional + derivative + integral

    def answer(self, error: float, error_rate: float, dt: float) -> tuple[float, float, float]:
        """Return what a sample gives, and integrate nothing.

        Args:
            error: Reference minus measured position, in [rad].
            error_rate: Its time derivative, in [rad/s].
            dt: Time over which the error is integrated, in [s].

        Returns:
            The proportional and the derivative term, and the increment of the integral term,
            each in [N m].
        """
        gains = self.gains
        return gains.p * error, gains.d * error_rate, dt * (gains.i * error)

    def reset(self) -> None:
        """Forget the integral and the last terms."""
        self._integral = self._integral_used = 0.0
        self._answer = 0.0, 0.0, 0.0

    def restore_integral(self, integral: float) -> None:
        """Replace the integral term, as anti-windup and a change of law do.

        Args:
            integral: In [N m].
        """
        self._integral = integral


_LARGEST_MULTIPLIER = 1e100  # its cube times a gain is finite, so that it times no error is 0


class HomogeneousPid(Pid):
    r"""Homogeneous PID, by forward Euler.

    .. math:: u = k_p n^{2\mu} e + k_d n^{\mu} \dot e + I, \qquad \dot I = k_i n^{3\mu} e

    with n the norm of (e, de/dt): the PID whose bandwidth is multiplied by :math:`n^\mu`. At
    degree zero it is the PID to the bit.

    Source: the paper, equation (8).

    Args:
        gains: The gains of the PID that it upgrades.
        norm: A homogeneous norm; its degree is the law's.
        norm_floor: Lower bound of the norm, see
            :func:`~hpid_ros.control.norms.sampling_floor`. Zero gives the paper's law exactly.
        norm_cap: Upper bound of the norm.

    Raises:
        NormError: The floor is negative or not below the cap.
    """

    __slots__ = ("_at_zero", "_degree", "_norm", "_weights", "norm_cap", "norm_floor")

    def __init__(
        self,
        gains: Gains,
        norm: Norm,
        norm_floor: float = 0.0,
        norm_cap: float = math.inf,
    ) -> None:
        require_floor(norm_floor, norm_cap)
        super().__init__(gains)
        self._norm = norm
        self._degree = norm.degree
        self.norm_floor = norm_floor
        self.norm_cap = norm_cap
        self._at_zero = 1.0 if norm.degree == 0.0 else 0.0
        self._weights: tuple[float, float, float] | None = None
        if isinstance(norm, WeightedNorm) and type(norm).__call__ is WeightedNorm.__call__:
            self._weights = norm.error_weight, norm.error_exponent, norm.rate_weight

    @property
    def norm(self) -> Norm:
        """The homogeneous norm."""
        return self._norm

    def multiplier(self, error: float, error_rate: float) -> float:
        r"""Return :math:`n^\mu`, the factor of the loop's bandwidth.

        Zero at the origin when there is no floor: there the proportional and derivative terms
        and the increment of the integral are zero in the limit.

        Args:
            error: Reference minus measured position, in [rad].
            error_rate: Its time derivative, in [rad/s].
        """
        n = min(max(self._norm(error, error_rate), self.norm_floor), self.norm_cap)
        return min(n**self._degree, _LARGEST_MULTIPLIER) if n else self._at_zero

    def answer(self, error: float, error_rate: float, dt: float) -> tuple[float, float, float]:
        """Return what a sample gives, and integrate nothing.

        Args:
            error: Reference minus measured position, in [rad].
            error_rate: Its time derivative, in [rad/s].
            dt: Time over which the error is integrated, in [s].

        Returns:
            The proportional and the derivative term, and the increment of the integral term,
            each in [N m].
        """
        # The weighted norm and the multiplier are written out: in Python the calls would cost as
        # much as all the arithmetic.
        weights = self._weights
        if weights is None:
            n = self._norm(error, error_rate)
        else:
            error_weight, exponent, rate_weight = weights
            n = error_weight * abs(error) ** exponent + rate_weight * abs(error_rate)
        if n < self.norm_floor:
            n = self.norm_floor
        elif n > self.norm_cap:
            n = self.norm_cap
        multiplier = n**self._degree if n else self._at_zero
        if multiplier > _LARGEST_MULTIPLIER:
            multiplier = _LARGEST_MULTIPLIER
        gains = self.gains
        square = multiplier * multiplier
        return (
            gains.p * square * error,
            gains.d * multiplier * error_rate,
            dt * (gains.i * (square * multiplier) * error),
        )


class SemiImplicitHomogeneousPid(HomogeneousPid):
    r"""Homogeneous PID that answers where the joint will be one period later.

    The multiplier is taken at the beginning of the period, and error and error rate at its end,
    as the joint's own inertia will have moved them: with :math:`a = k_p\lambda^2`,
    :math:`b = k_d\lambda` and :math:`D = 1 + (T b + T^2 a)/m`,

    .. math::
        u = \frac{a e + (b + T a)\dot e}{D} + I, \qquad
        I^+ = I + T k_i\lambda^3\,\frac{(1 + T b/m)\,e + T\dot e}{D}

    It costs one division more than :class:`HomogeneousPid`, is the same in the limit of fast
    sampling, and stays stable where T kd lam / m is not small: worth its while from about
    T = 5 ms. At degree zero it is the PID by backward Euler.

    Source: backward Euler of the paper's law, equation (8), on m e'' = -u + w, w the load.
    """

    __slots__ = ("inertia", "period")

    def __init__(
        self,
        gains: Gains,
        norm: Norm,
        norm_floor: float = 0.0,
        norm_cap: float = math.inf,
        *,
        inertia: float,
        period: float,  # [s] nominal: the effort must not move because a sample was lost
    ) -> None:
        if not (math.isfinite(inertia) and inertia > 0.0):
            raise GainError(f"the inertia must be positive and finite, not {inertia} kg m^2")
        self.inertia, self.period = inertia, period
        super().__init__(gains, norm, norm_floor, norm_cap)

    def answer(self, error: float, error_rate: float, dt: float) -> tuple[float, float, float]:
        """Return both terms and the integral's increment; see :meth:`Pid.answer`."""
        gains = self.gains
        multiplier = self.multiplier(error, error_rate)
        square = multiplier * multiplier
        stiffness = gains.p * square
        damping = gains.d * multiplier
        period = self.period
        moved = period / self.inertia
        divisor = 1.0 + moved * (damping + period * stiffness)
        error_after = ((1.0 + moved * damping) * error + period * error_rate) / divisor
        return (
            stiffness * error / divisor,
            (damping + period * stiffness) * error_rate / divisor,
            dt * (gains.i * (square * multiplier) * error_after),
        )

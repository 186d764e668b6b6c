"""Figures by which a loop's tuning is judged, each a small function."""

from __future__ import annotations

import math
from typing import NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.control.gains import Gains
from hpid_ros.control.norms import GOOD_SAMPLING_MARGIN, CanonicalNorm, WeightedNorm
from hpid_ros.stability.certificate import Certificate

__all__ = [
    "GOOD_SAMPLING_MARGIN",
    "LARGEST_SAMPLING_MARGIN",
    "LARGEST_SAMPLING_MARGIN_LATE",
    "MultiplierRange",
    "decay_time",
    "gain_multiplier_range",
    "integral_ratio",
    "sampling_margin",
    "settling_time_bound",
]

LARGEST_SAMPLING_MARGIN, LARGEST_SAMPLING_MARGIN_LATE = 2.0, 0.85
"""T kd lam / m at which the sampled loop breaks, and where a sample is answered one period late,
as over a topic."""

_NEGLIGIBLE_DEGREE = 1e-100  # a quotient of two such numbers has no digits


def integral_ratio(gains: Gains, inertia: float = 1.0) -> float:
    """Return rho = m ki / (kp kd): 0 without integral action, 1 at Routh's limit.

    Source: Routh and Hurwitz on m s^3 + kd s^2 + kp s + ki.
    """
    product = gains.p * gains.d
    return inertia * gains.i / product if product > 0.0 else math.inf


class MultiplierRange(NamedTuple):
    """The factors of a loop's bandwidth, n^mu."""

    least: float  # the smallest
    largest: float


def gain_multiplier_range(
    norm: WeightedNorm | CanonicalNorm,
    *,
    floor: float,
    cap: float = math.inf,
    largest_error: float = math.inf,
    largest_error_rate: float = math.inf,
) -> MultiplierRange:
    """Return the least and the largest factor of the bandwidth, lam = n^mu.

    The derivative gain is multiplied by lam, the proportional one by its square, the integral
    one by its cube. Source: the paper, equation (8).
    """
    largest = cap
    if math.isfinite(largest_error) and math.isfinite(largest_error_rate):
        corners = (norm(largest_error, sign * largest_error_rate) for sign in (1.0, -1.0))
        largest = max(floor, min(cap, max(corners)))
    ends = sorted((_power(floor, norm.degree), _power(largest, norm.degree)))
    return MultiplierRange(*ends)


def sampling_margin(
    gains: Gains, period: float, largest_multiplier: float, inertia: float = 1.0
) -> float:
    """Return T kd lam / m, without a unit; see :data:`GOOD_SAMPLING_MARGIN`.

    Source: Livne and Levant, "Proper discretization of homogeneous differentiators" (2014), for
    the principle; its limits were measured on the sampled double integrator.
    """
    return period * gains.d / inertia * largest_multiplier


def decay_time(degree: float, decay: float, start: float, end: float) -> float:
    r"""Return how long :math:`\dot V = -\beta V^{1+\mu}` takes from one value to another.

    Finite down to 0 for a negative degree, finite from infinity for a positive one, and the
    logarithm of the ratio for degree zero: the three classes of convergence.
    """
    if not decay > 0.0 or not 0.0 <= end < start:
        raise SettingError(
            f"the decay must be positive and 0 <= end < start, not {decay}, {end}, {start}"
        )
    if end == 0.0 or start == math.inf:
        at_end, at_start = (_power(each, -degree) for each in (end, start))
        return (at_end - at_start) / (decay * degree) if degree != 0.0 else math.inf
    logarithm = math.log(start / end)
    if abs(degree) < _NEGLIGIBLE_DEGREE:
        return logarithm / decay
    # end^-mu - start^-mu, without the loss of digits for a small degree.
    return _power(end, -degree) * -math.expm1(-degree * logarithm) / (decay * degree)


def settling_time_bound(
    certificate: Certificate,
    norm: WeightedNorm | CanonicalNorm,
    state: tuple[float, float, float],
    remaining: float = 0.01,
) -> float:
    """Return a time after which the ideal loop has settled for certain, in [s].

    Settled means that the canonical norm V of the certificate's P is below ``remaining`` times
    its first value, for every certified inertia. The bound is what the certificate proves, and
    hence larger than what a simulation shows.

    Source: along the closed loop dV/dt <= -beta V^{1+mu} with beta the least of -x'Pf/x'PGx on
    the sphere. (The paper's bound of the rate takes lambda_min where lambda_max is needed.)
    """
    # Imported here: a controller that only reads the figures above does not wait for numpy.
    from hpid_ros.stability.check import best_spans
    from hpid_ros.stability.closed_loop import state_norm

    if not any(state) or not 0.0 <= remaining < 1.0:
        raise SettingError(
            f"the state must not be zero and remaining must lie in [0, 1), "
            f"not {state}, {remaining}"
        )
    times = []
    for span, margins in best_spans(certificate, norm):
        start = float(state_norm(span.shape, norm.degree, state))
        times.append(decay_time(norm.degree, margins.decay, start, remaining * start))
    return max(times)


def _power(base: float, exponent: float) -> float:
    """Return base^exponent, with the limits at zero and infinity."""
    if base == 0.0 and exponent < 0.0:
        return math.inf
    return math.pow(base, exponent)

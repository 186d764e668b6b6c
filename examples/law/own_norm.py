"""A homogeneous norm of one's own: the larger of two parts, instead of their sum.

A norm is called with error and error rate, and knows its degree: that is all that a loop asks.
A certificate asks its array form, ``values``, and is refused where that is another function or is
not homogeneous. Homogeneous means that under the dilation d(s) = (e^((1-mu) s), e^s) the norm
grows by e^s, whatever the state.
"""

import math
import random

import numpy as np

from hpid_ros.control import Gains, HomogeneousPid, Norm, WeightedNorm
from hpid_ros.stability.certificate_search import certify_degree
from hpid_ros.stability.certification import verify_certificate
from hpid_ros.stability.gain_check import settling_time_bound

GAINS = Gains(p=300.0, i=1000.0, d=30.0)
PERIOD = 0.001  # [s]


class LargerPart(Norm):
    """max((|e| / error_scale)^(1 / (1 - mu)), rate_weight |de/dt|)."""

    def __init__(self, degree, error_scale, rate_weight):
        self.degree = degree
        self._error_scale, self._rate_weight = error_scale, rate_weight

    def __call__(self, error, error_rate):
        """Return the norm of one joint's state."""
        part = (abs(error) / self._error_scale) ** (1.0 / (1.0 - self.degree))
        return max(part, self._rate_weight * abs(error_rate))

    def values(self, errors, rates):
        """Return the norm of many states."""
        parts = (np.abs(errors) / self._error_scale) ** (1.0 / (1.0 - self.degree))
        return np.maximum(parts, self._rate_weight * np.abs(rates))


def largest_deviation(norm, states=1000):
    """Return how far the norm is from being homogeneous, relative, over states drawn by chance."""
    draw = random.Random(1)
    worst = 0.0
    for _ in range(states):
        error, rate, s = draw.uniform(-2, 2), draw.uniform(-9, 9), draw.uniform(-3, 3)
        dilated = norm(math.exp((1.0 - norm.degree) * s) * error, math.exp(s) * rate)
        worst = max(worst, abs(dilated / (math.exp(s) * norm(error, rate)) - 1.0))
    return worst


def settling_time(law, duration=5.0, tolerance=1e-3):
    """Return when a unit double integrator, one away, stays below the tolerance, in [s]."""
    error, error_rate, settled = 1.0, 0.0, 0.0
    for k in range(round(duration / PERIOD)):
        error_rate -= PERIOD * law.update(error, error_rate, PERIOD)
        error += PERIOD * error_rate
        if abs(error) > tolerance:
            settled = (k + 1) * PERIOD
    return settled


for norm in (WeightedNorm.scaled(-0.2, 1.0, 0.1), LargerPart(-0.2, 1.0, 0.1)):
    law = HomogeneousPid(gains=GAINS, norm=norm, norm_floor=1e-4)
    certificate = certify_degree(GAINS, norm)
    verify_certificate(certificate)  # checked again, without anything of the search
    bound = settling_time_bound(certificate, norm, (1.0, 0.0, 0.0))
    print(
        f"{type(norm).__name__:12} homogeneous to {largest_deviation(norm):.0e}, "
        f"settles in {settling_time(law):.3f} s, certified: to a hundredth in {bound:.3f} s"
    )

r"""How fast an ellipsoid is entered: the inequality behind a certificate, on an adapted grid.

The closed loop of the homogeneous PID on a unit double integrator, with the state
:math:`x = (e, \dot e, p - I)`, is homogeneous. So it is asymptotically stable if on one sphere
:math:`x^T P x = 1` the field points inward, :math:`x^T P f(x) < 0`, and the dilation crosses the
sphere once, :math:`PG + GP \succ 0`. The field has unbounded slopes where the norm of
(e, de/dt) is small: a plain grid on the sphere misses them, and accepted a false P. This grid
follows the dilation: a curve of unit norm in the plane, carried inward to the pole.
"""

from __future__ import annotations

import numpy as np

from hpid_ros.control.gains import Gains
from hpid_ros.control.norm_arrays import Array, Norm, canonical_values, unit_curve

LEAST_MONOTONICITY = 0.05
"""Least eigenvalue of the dilation's generator, relative to P, that is accepted."""

_STEEPEST_SPACING = 40.0


def time_unit(gains: Gains) -> float:
    """Return the rate ki^(1/3) in [1/s] that makes the integral gain one.

    Args:
        gains: Effective gains, over the inertia.
    """
    return float(gains.i ** (1.0 / 3.0))


def monotonicity(shape: Array, degree: float) -> float:
    r"""Return the least growth rate of the P-norm along the dilation.

    It is :math:`\tfrac12\lambda_{min}(P^{-1/2}(PG + GP)P^{-1/2})` with
    G = diag(1 - mu, 1, 1 + mu); the sphere is crossed once by every orbit of the dilation if it
    is positive. Minus infinity when P is not positive definite.

    Args:
        shape: The symmetric 3x3 matrix P.
        degree: Homogeneity degree mu.
    """
    return _monotonicity_range(shape, degree)[0]


def fastest_dilation(shape: Array, degree: float) -> float:
    """Return the largest growth rate of the P-norm along the dilation.

    Args:
        shape: The symmetric positive definite 3x3 matrix P.
        degree: Homogeneity degree mu.
    """
    return _monotonicity_range(shape, degree)[1]


def _monotonicity_range(shape: Array, degree: float) -> tuple[float, float]:
    # In the coordinates of the Cholesky factor L, P = L L', the matrix is L' G L'^-1 and its
    # transpose.
    try:
        factor = np.linalg.cholesky(shape)
    except np.linalg.LinAlgError:
        return -np.inf, np.inf
    generator = np.array([1.0 - degree, 1.0, 1.0 + degree])
    product = factor.T @ (generator[:, None] * np.linalg.inv(factor.T))
    values = np.linalg.eigvalsh(0.5 * (product + product.T))
    return float(values[0]), float(values[-1])


class SphereGrid:
    """The points on which a P is tried for one loop of one degree.

    Works in the loop's own units: time in 1/ki^(1/3), so that the integral gain is one.

    Args:
        gains: Effective gains, over the inertia; all positive.
        norm: The norm; its degree is the law's.
        along: Points in each quadrant of the curve of unit norm.
        inward: Points from the curve to the pole.
    """

    def __init__(self, gains: Gains, norm: Norm, along: int, inward: int) -> None:
        unit = time_unit(gains)
        self.degree = degree = norm.degree
        curve = unit_curve(norm, along)
        self._error = curve[:, 0]
        self._rate = curve[:, 1] / unit
        self._pull = gains.p / unit**2 * self._error + gains.d / unit * self._rate
        # The slowest growing power of the norm becomes linear in the parameter, and the outer
        # end is dense, where the third coordinate is a square root.
        spacing = min(_STEEPEST_SPACING, 1.0 / min(1.0 + 2.0 * degree, 1.0 - degree))
        angle = np.linspace(0.0, 0.5 * np.pi, inward + 1)[1:]
        self._inward = np.sin(angle) ** spacing

    @property
    def size(self) -> int:
        """How many points there are, the pole included."""
        return self._error.size * self._inward.size + 1

    def rates(self, shape: Array) -> Array:
        """Return x'P f(x) at every point of x'P x = 1, in units of ki^(1/3); negative is good.

        Args:
            shape: A positive definite P for which the dilation is monotone.

        Returns:
            One-dimensional array; the last one is the pole, where error and error rate are 0.
        """
        p13, p23, p33 = shape[0, 2], shape[1, 2], shape[2, 2]
        s11 = shape[0, 0] - p13 * p13 / p33
        s12 = shape[0, 1] - p13 * p23 / p33
        s22 = shape[1, 1] - p23 * p23 / p33
        mu = self.degree
        outer = 1.0 / canonical_values(mu, (s11, s12, s22), self._error, self._rate)
        inward = self._inward
        x1 = np.multiply.outer(outer ** (1.0 - mu) * self._error, inward ** (1.0 - mu))
        x2 = np.multiply.outer(outer * self._rate, inward)
        pull = np.multiply.outer(outer ** (1.0 + mu) * self._pull, inward ** (1.0 + mu))
        draw = np.multiply.outer(
            outer ** (1.0 + 2.0 * mu) * self._error, inward ** (1.0 + 2.0 * mu)
        )
        first = s11 * x1 + s12 * x2
        second = s12 * x1 + s22 * x2
        height = np.sqrt(np.maximum(1.0 - first * x1 - second * x2, 0.0) / p33)
        x3 = height - (p13 * x1 + p23 * x2) / p33
        first += p13 * height
        second += p23 * height
        rates = first * x2 + second * (x3 - pull) - p33 * height * draw
        return np.append(rates, p23 / p33)

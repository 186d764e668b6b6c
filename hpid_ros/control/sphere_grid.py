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
from hpid_ros.control.norm_arrays import Array, Norm, canonical_values, norm_values, unit_curve

LEAST_MONOTONICITY = 0.05
"""Least eigenvalue of the dilation's generator, relative to P, that is accepted."""

_DEEP = 14.0  # in ln of a power of the norm: there it is negligible


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

    Works in the loop's own units: time in 1/ki^(1/3), so that the integral gain is one. Half of
    the directions in the plane of error and rate are even for the norm, half for the sphere,
    whose ends may be thin.

    Args:
        gains: Effective gains, over the inertia; all positive.
        norm: The norm; its degree is the law's.
        along: Points in each quadrant, of the norm's curve and of the sphere's rim each.
        inward: Points from the rim to the pole.
    """

    def __init__(self, gains: Gains, norm: Norm, along: int, inward: int) -> None:
        self._unit = unit = time_unit(gains)
        self._norm = norm
        self.degree = degree = norm.degree
        self._gains = np.array([gains.p / unit**2, gains.d / unit])
        curve = unit_curve(norm, along)
        self._error, self._rate = curve[:, 0], curve[:, 1] / unit
        around = np.linspace(0.0, 2.0 * np.pi, 4 * along, endpoint=False)
        self._circle = np.stack([np.cos(around), np.sin(around)])
        depths = _depths(min(1.0 + 2.0 * degree, 1.0 - degree), inward)
        exponents = (1.0 - degree, 1.0, 1.0 + degree, 1.0 + 2.0 * degree)
        self._inward = [np.exp(-exponent * depths) for exponent in exponents]

    @property
    def size(self) -> int:
        """How many points there are, the pole included."""
        return 2 * self._error.size * self._inward[0].size + 1

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
        x1, x2, pull, draw = self._plane(s11, s12, s22)
        first = s11 * x1 + s12 * x2
        second = s12 * x1 + s22 * x2
        height = np.sqrt(np.maximum(1.0 - first * x1 - second * x2, 0.0) / p33)
        x3 = height - (p13 * x1 + p23 * x2) / p33
        first += p13 * height
        second += p23 * height
        rates = first * x2 + second * (x3 - pull) - p33 * height * draw
        return np.append(rates, p23 / p33)

    def _plane(self, s11: float, s12: float, s22: float) -> list[Array]:
        """Return e, de/dt, (a lam^2 e + b lam de/dt) and lam^3 e at the points."""
        mu = self.degree
        outer = 1.0 / canonical_values(mu, (s11, s12, s22), self._error, self._rate)
        # The rim itself: x'Sx = 1 by the factor of S; its norm is the outer value there.
        root = np.sqrt(s11)
        second = self._circle[1] / np.sqrt(s22 - s12 * s12 / s11)
        first = self._circle[0] / root - s12 / s11 * second
        rim = norm_values(self._norm, first, self._unit * second)
        error = np.concatenate([outer ** (1.0 - mu) * self._error, first])
        rate = np.concatenate([outer * self._rate, second])
        multiplier = np.concatenate([outer, rim]) ** mu
        pull = multiplier * (self._gains[0] * multiplier * error + self._gains[1] * rate)
        values = (error, rate, pull, multiplier**3 * error)
        return [np.multiply.outer(*each) for each in zip(values, self._inward, strict=True)]


def _depths(slowest: float, count: int) -> Array:
    """Return depths below the rim in ln n, from 0 to where the slowest power of n vanishes.

    Dense at the rim, where the third coordinate is a square root, and even in the logarithm
    further in, where a stiff loop has its slow manifold. For degrees close to -1/2 the powers
    of n vanish at very different depths, and a third of the points is for the slowest.
    """
    deepest = _DEEP / slowest
    if deepest < 2.0 * _DEEP:
        return deepest * np.linspace(0.0, 1.0, count) ** 2
    further = count // 3
    near = _DEEP * np.linspace(0.0, 1.0, count - further) ** 2
    return np.append(near, np.geomspace(_DEEP, deepest, further + 1)[1:])

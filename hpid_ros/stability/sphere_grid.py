r"""Rates of entry into an ellipsoid: the inequality behind a certificate, on an adapted grid.

The closed loop of the homogeneous PID on a unit double integrator, with the state
:math:`x = (e, \dot e, p - I)`, is homogeneous. So it is asymptotically stable if on one sphere
:math:`x^T P x = 1` the field points inward, :math:`x^T P f(x) < 0`, and the dilation crosses the
sphere once, :math:`PG + GP \succ 0`. The field has unbounded slopes where the norm of
(e, de/dt) is small: a plain grid on the sphere misses them, and accepted a false P. This grid
follows the dilation: a curve of unit norm in the plane, carried inward to the pole.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.control.gains import Gains
from hpid_ros.stability.closed_loop import Norm, canonical_values, norm_values, unit_curve

LEAST_MONOTONICITY = 0.05
"""Least eigenvalue of the dilation's generator, relative to P, that is accepted."""

_TOLERANCE_OF_RIM = 1e-5  # Newton's last step; what it leaves is the square of that
_AT_HAND = 10_000  # points, 80 kB of each array
_DEEP = 14.0  # in ln of a power of the norm: there it is negligible


def time_unit(gains: Gains) -> float:
    """Return the rate ki^(1/3) in [1/s] that makes the integral gain one."""
    return float(gains.i ** (1.0 / 3.0))


def monotonicity(shape: Numbers, degree: float) -> float:
    r"""Return the least growth rate of the P-norm along the dilation.

    It is :math:`\tfrac12\lambda_{min}(P^{-1/2}(PG + GP)P^{-1/2})` with
    G = diag(1 - mu, 1, 1 + mu); the sphere is crossed once by every orbit of the dilation if it
    is positive. Minus infinity when P is not positive definite.
    """
    return float(growth_rates(shape, [degree])[0, 0])


def growth_rates(shapes: Numbers, degrees: Sequence[float]) -> Numbers:
    """Return the least and the largest growth rate of the P-norm along the dilation."""
    try:
        factors = np.linalg.cholesky(shapes)
    except np.linalg.LinAlgError:
        if shapes.ndim > 2:  # find out which
            return np.stack([growth_rates(each, degrees) for each in shapes])
        return np.full((len(degrees), 2), (-np.inf, np.inf))
    # In the coordinates of the Cholesky factor L, P = L L', the matrix is L' G L'^-1 and its
    # transpose.
    upper = np.swapaxes(factors, -1, -2)[..., None, :, :]
    mu = np.asarray(degrees)
    generators = np.stack([1.0 - mu, np.ones_like(mu), 1.0 + mu], axis=-1)
    products = upper @ (generators[..., :, None] * np.linalg.inv(upper))
    values = np.linalg.eigvalsh(0.5 * (products + np.swapaxes(products, -1, -2)))
    return np.asarray(values[..., [0, -1]], float)


class SphereGrid:
    r"""The points on which P are tried for one loop of one degree.

    Works in the loop's own units: time in 1/ki^(1/3), so that the integral gain is one. Half of
    the directions in the plane of error and rate are even for the norm, half for the sphere,
    whose ends may be thin.

    At a direction on the rim, carried inward by the dilation, error, rate and the terms of the
    law are each a number times a power of the depth. With the height h above the plane of
    error and rate the field's inflow is

    .. math:: x^T P f = A + B h + p_{23} h^2, \qquad h^2 = (1 - q) / p_{33},

    where q, A and B are sums of a few such products: over all directions and depths they are
    products of two thin matrices, and a fine grid costs little more than its square roots.
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
        x1, x2, pull, draw = (np.exp(-exponent * depths) for exponent in exponents)
        self._squares = np.stack([x1 * x1, x1 * x2, x2 * x2, x1 * pull, x2 * pull])
        self._lines = np.stack([x1, x2, pull, draw])

    @property
    def size(self) -> int:
        """How many points there are, the pole included."""
        return int(2 * self._error.size * self._lines.shape[1]) + 1

    def rates(self, shapes: Numbers) -> Numbers:
        """Return x'P f(x) at every point of x'P x = 1, in units of ki^(1/3); negative is good."""
        rates = self._away_from_pole(*self._factors(shapes))
        pole = shapes[..., 1, 2, None] / shapes[..., 2, 2, None]
        return np.concatenate([rates.reshape(*shapes.shape[:-2], -1), pole], axis=-1)

    def largest_rates(self, shapes: Numbers) -> Numbers:
        """Return the largest of :meth:`rates` of each shape, of shape (...).

        Some directions at a time: what a processor has at hand is read faster than it is
        computed, and a fine grid is larger than that.
        """
        square, flat, steep, p23, p33 = self._factors(shapes)
        largest = shapes[..., 1, 2] / shapes[..., 2, 2]
        depths, count = self._lines.shape[1], int(np.prod(largest.shape))
        step = max(1, _AT_HAND // (depths * count))
        for k in range(0, square.shape[-2], step):
            rows = (..., slice(k, k + step), slice(None))
            rates = self._away_from_pole(square[rows], flat[rows], steep[rows], p23, p33)
            largest = np.maximum(largest, rates.max(axis=(-2, -1)))
        return np.asarray(largest)

    def _factors(self, shapes: Numbers) -> tuple[Numbers, Numbers, Numbers, Numbers, Numbers]:
        """Return the directions' factors of q, A and B, and p23 and p33."""
        p13, p23, p33 = (shapes[..., k, 2, None] for k in range(3))
        a13, a23 = p13 / p33, p23 / p33
        s11 = shapes[..., 0, 0, None] - p13 * a13
        s12 = shapes[..., 0, 1, None] - p13 * a23
        s22 = shapes[..., 1, 1, None] - p23 * a23
        x1, x2, pull, draw = self._rim(s11, s12, s22)
        x11, x12, x22 = x1 * x1, x1 * x2, x2 * x2
        square = np.stack([s11 * x11, 2.0 * s12 * x12, s22 * x22], axis=-1)
        flat = np.stack(
            [
                -s12 * a13 * x11,
                (s11 - s12 * a23 - s22 * a13) * x12,
                (s12 - s22 * a23) * x22,
                -s12 * x1 * pull,
                -s22 * x2 * pull,
            ],
            axis=-1,
        )
        steep = np.stack(
            [(s12 - p23 * a13) * x1, (p13 + s22 - p23 * a23) * x2, -p23 * pull, -p33 * draw],
            axis=-1,
        )
        return square, flat, steep, p23[..., None], p33[..., None]

    def _away_from_pole(
        self, square: Numbers, flat: Numbers, steep: Numbers, p23: Numbers, p33: Numbers
    ) -> Numbers:
        # In place: the arrays are large, and new memory costs more than the arithmetic.
        height = square @ self._squares[:3]
        np.subtract(1.0, height, out=height)
        np.maximum(height, 0.0, out=height)
        height /= p33
        np.sqrt(height, out=height)
        rates: Numbers = steep @ self._lines
        rates += p23 * height
        rates *= height
        rates += flat @ self._squares
        return rates

    def _rim(
        self, s11: Numbers, s12: Numbers, s22: Numbers
    ) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """Return e, de/dt, (a lam^2 e + b lam de/dt) and lam^3 e on the spheres' rims."""
        mu = self.degree
        norms = canonical_values(mu, (s11, s12, s22), self._error, self._rate, _TOLERANCE_OF_RIM)
        outer = 1.0 / norms
        # The rim itself: x'Sx = 1 by the factor of S; its norm is the outer value there.
        second = self._circle[1] / np.sqrt(s22 - s12 * s12 / s11)
        first = self._circle[0] / np.sqrt(s11) - s12 / s11 * second
        rim = norm_values(self._norm, first, self._unit * second)
        error = np.concatenate([outer ** (1.0 - mu) * self._error, first], axis=-1)
        rate = np.concatenate([outer * self._rate, second], axis=-1)
        multiplier = np.concatenate([outer, rim], axis=-1) ** mu
        pull = multiplier * (self._gains[0] * multiplier * error + self._gains[1] * rate)
        return error, rate, pull, multiplier**3 * error


def _depths(slowest: float, count: int) -> Numbers:
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

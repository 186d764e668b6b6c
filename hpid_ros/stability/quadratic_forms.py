r"""Quadratic forms for one loop, on a grid over the unit sphere.

.. math:: \min_x \max_k (v_k + s_k^T x), \qquad l_g^T x \le c_g, \quad |x_j| \le r

A linear program with a few unknowns and hundreds of rows. Its dual has as many equations as
there are unknowns and a first basis that is at hand, so that the simplex method needs some tens
of steps on a small matrix: a tenth of the time that a general solver takes to be called.

Source: V. Chvatal, *Linear Programming* (1983), chapter 7 (revised simplex method) and chapter 10
(solving a program by its dual).

The P of a certificate is not unique. Good ones are near the Lyapunov solutions of the linear
loop; the P-norm's sphere may sit anywhere along the dilation, which is the scale of P.

The closed loop of the homogeneous PID on a unit double integrator, with the state
:math:`x = (e, \dot e, p - I)`, is homogeneous. So it is asymptotically stable if on one sphere
:math:`x^T P x = 1` the field points inward, :math:`x^T P f(x) < 0`, and the dilation crosses the
sphere once, :math:`PG + GP \succ 0`. The field has unbounded slopes where the norm of
(e, de/dt) is small: a plain grid on the sphere misses them, and accepted a false P. This grid
follows the dilation: a curve of unit norm in the plane, carried inward to the pole.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from hpid_ros.base.units import Numbers
from hpid_ros.control.homogeneous_pid import Gains
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


_FEASIBLE = 1e-9
_STEPS = 300  # far beyond what it takes; a program that cycles is given up
_TINY = 1e-12


def least_maximum(
    values: Numbers, slopes: Numbers, losses: Numbers, spare: Numbers, radius: float
) -> Numbers | None:
    """Return the x in the box that makes the largest linear function least."""
    rows, n = slopes.shape
    scale = np.abs(slopes).max() or 1.0
    box = np.eye(n)
    # Every row a reads a (x, t) <= bound, t standing for the maximum.
    matrix = np.zeros((rows + len(losses) + 2 * n, n + 1))
    matrix[:rows, :n], matrix[:rows, n] = slopes / scale, -1.0
    matrix[rows : rows + len(losses), :n] = losses
    matrix[rows + len(losses) :, :n] = np.concatenate([box, -box])
    bounds = np.concatenate([-values / scale, spare, np.full(2 * n, radius)])
    # The dual multipliers of one function and of the sides of the box that hold it.
    first = int(values.argmax())
    sides = rows + len(losses) + np.arange(n)
    basis = np.append(np.where(matrix[first, :n] > 0.0, sides + n, sides), first)
    target = np.append(np.zeros(n), -1.0)
    for _ in range(_STEPS):
        try:
            inverse = np.linalg.inv(matrix[basis])
        except np.linalg.LinAlgError:
            return None
        point = inverse @ bounds[basis]
        excess = matrix @ point - bounds
        enters = int(excess.argmax())
        if excess[enters] <= _FEASIBLE * (1.0 + abs(bounds[enters])):
            best: Numbers = np.clip(point[:n], -radius, radius)
            return best
        multipliers = target @ inverse
        change = matrix[enters] @ inverse
        falls = change > _TINY
        if not falls.any():
            return None
        ratios = np.full(n + 1, np.inf)
        ratios[falls] = multipliers[falls] / change[falls]
        basis[int(ratios.argmin())] = enters
    return None


_LEAST_COST, _LARGEST_COST, _COSTS = 0.03, 30.0, 4
_SCALES = tuple(10.0 ** (0.75 * k) for k in range(-4, 5))  # 1e-3 to 1e3
_FIRST_RADIUS = 0.3  # of the trust region, relative to the shape
_LEAST_RADIUS = 1e-4
_DIFFERENCE = 1e-6
_STEEP = 1e3 * _DIFFERENCE  # stands for the slope into what is not allowed
_LEAST_GAIN = 0.03
_STALLED = 3  # steps without that gain
_ACTIVE = 200  # points that a linear program looks at
_STRETCH = np.tril_indices(3)


def scaled_loop(gains: Gains) -> Numbers:
    """Return the linear loop's matrix on (e, de/dt, p - I), in units of ki^(1/3)."""
    unit = time_unit(gains)
    return np.array(
        [[0.0, 1.0, 0.0], [-gains.p / unit**2, -gains.d / unit, 1.0], [-1.0, 0.0, 0.0]]
    )


def lyapunov_solution(loop: Numbers, cost: Sequence[float]) -> Numbers:
    """Return the P that solves A'P + PA = -diag(cost)."""
    eye = np.eye(3)
    equations = np.kron(loop.T, eye) + np.kron(eye, loop.T)
    shape = np.linalg.solve(equations, -np.diag(cost).ravel()).reshape(3, 3)
    symmetric: Numbers = 0.5 * (shape + shape.T)
    return symmetric


def first_shapes(gains: Gains, norm: Norm) -> Numbers:
    """Return the shapes that a search starts from: sixteen at each of nine scales.

    The costs reach from units of the integral action to units of the oscillation sqrt(kp), which
    are far apart in a loop with little integral action. At the middle scale the norm is about 1
    on the sphere's rim, where the linear loop is the loop itself.
    """
    loop, unit = scaled_loop(gains), time_unit(gains)
    slowness = min(1.0, unit / gains.p**0.5)
    costs = [
        np.geomspace(_LEAST_COST * slowness**power, _LARGEST_COST, _COSTS) for power in (2, 4)
    ]
    solutions = []
    for q2, q3 in product(*costs):
        solution = lyapunov_solution(loop, (1.0, q2, q3))
        width = np.sqrt(np.diag(np.linalg.inv(solution))[:2])  # of the rim, in e and de
        rim = norm(width[0], 0.0) * norm(0.0, unit * width[1])
        solutions.append(solution * rim)
    return np.multiply.outer(_SCALES, np.stack(solutions))


def worst_rates(grids: Sequence[SphereGrid], shapes: Numbers) -> Numbers:
    """Return the largest x'P f(x) on the sphere over several degrees, for many shapes at once."""
    rates = np.full(len(shapes), np.inf)
    is_monotone = _spare_monotonicity(grids, shapes).min(axis=-1) > 0.0
    if is_monotone.any():
        good = shapes[is_monotone]
        rates[is_monotone] = np.max([grid.largest_rates(good) for grid in grids], axis=0)
    return rates


def worst_rate(grids: Sequence[SphereGrid], shape: Numbers) -> float:
    """Return the largest x'P f(x) on the sphere over several degrees; see :func:`worst_rates`."""
    return float(worst_rates(grids, shape[None])[0])


def improved(
    grids: Sequence[SphereGrid],
    shape: Numbers,
    *,
    enough: float = -np.inf,
    relative: bool = False,
    steps: int = 40,
) -> Numbers:
    """Return a shape nearby with a lower worst rate.

    The worst rate is the largest of many smooth functions of P. Each step linearises them in a
    stretch of P's Cholesky factor and solves the linear program of their maximum in a trust
    region: near the optimum, where several are equal, this converges as Newton's method does.
    """
    radius, stalled = _FIRST_RADIUS, 0
    values = _values(grids, shape, relative)
    if not np.isfinite(values).all():
        return shape
    for _ in range(steps):
        value = values.max()
        if value < enough or radius < _LEAST_RADIUS or stalled == _STALLED:
            break
        move = _best_move(grids, shape, values, radius, relative)
        candidate = _stretched(shape, move)
        after = _values(grids, candidate, relative)
        stalled = stalled + 1 if after.max() > value - _LEAST_GAIN * abs(value) else 0
        if after.max() < value:
            radius *= 2.0 if after.max() < value - 0.5 * abs(value) * radius else 1.0
            shape, values = candidate, after
        else:
            radius *= 0.35
    return shape


def _best_move(
    grids: Sequence[SphereGrid], shape: Numbers, values: Numbers, radius: float, relative: bool
) -> Numbers:
    """Return the move within the radius that lowers the linearised maximum most."""
    active = np.argpartition(values, -_ACTIVE)[-_ACTIVE:]
    spare = _spare_monotonicity(grids, shape)
    moved = np.stack([_stretched(shape, _DIFFERENCE * direction) for direction in np.eye(6)])
    change = np.minimum(_values(grids, moved, relative)[:, active] - values[active], _STEEP)
    losses = (spare - _spare_monotonicity(grids, moved)).T / _DIFFERENCE
    move = least_maximum(values[active], change.T / _DIFFERENCE, losses, spare, radius)
    return np.zeros(6) if move is None else move


def _spare_monotonicity(grids: Sequence[SphereGrid], shapes: Numbers) -> Numbers:
    return growth_rates(shapes, [grid.degree for grid in grids])[..., 0] - LEAST_MONOTONICITY


def _values(grids: Sequence[SphereGrid], shapes: Numbers, relative: bool) -> Numbers:
    """Return the rates at all points of shapes (..., 3, 3); infinite where one is not allowed."""
    growth = growth_rates(shapes, [grid.degree for grid in grids])
    rates = [grid.rates(shapes) for grid in grids]
    if relative:
        rates = [each / growth[..., k, 1, None] for k, each in enumerate(rates)]
    values = np.concatenate(rates, axis=-1)
    values[growth[..., 0].min(axis=-1) <= LEAST_MONOTONICITY] = np.inf
    return values


def _stretched(shape: Numbers, parameters: Numbers) -> Numbers:
    """Return L T T' L' for P = L L' and a lower triangular T near one, exp on its diagonal."""
    stretch = np.zeros((3, 3))
    stretch[_STRETCH] = parameters
    stretch[np.diag_indices(3)] = np.exp(np.diag(stretch))
    factor = np.linalg.cholesky(shape) @ stretch
    result: Numbers = factor @ factor.T
    return result

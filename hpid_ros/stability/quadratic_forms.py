r"""Quadratic forms for one loop: where to look for a P, and how to improve one.

.. math:: \min_x \max_k (v_k + s_k^T x), \qquad l_g^T x \le c_g, \quad |x_j| \le r

A linear program with a few unknowns and hundreds of rows. Its dual has as many equations as
there are unknowns and a first basis that is at hand, so that the simplex method needs some tens
of steps on a small matrix: a tenth of the time that a general solver takes to be called.

Source: V. Chvatal, *Linear Programming* (1983), chapter 7 (revised simplex method) and chapter 10
(solving a program by its dual).

The P of a certificate is not unique. Good ones are near the Lyapunov solutions of the linear
loop; the P-norm's sphere may sit anywhere along the dilation, which is the scale of P.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.control.gains import Gains
from hpid_ros.stability.closed_loop import Norm
from hpid_ros.stability.sphere_grid import LEAST_MONOTONICITY, SphereGrid, growth_rates, time_unit

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
    return _growth_rates(grids, shapes)[..., 0] - LEAST_MONOTONICITY


def _growth_rates(grids: Sequence[SphereGrid], shapes: Numbers) -> Numbers:
    return growth_rates(shapes, [grid.degree for grid in grids])


def _values(grids: Sequence[SphereGrid], shapes: Numbers, relative: bool) -> Numbers:
    """Return the rates at all points of shapes (..., 3, 3); infinite where one is not allowed."""
    growth = _growth_rates(grids, shapes)
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

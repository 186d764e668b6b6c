r"""The least maximum of many linear functions of a few numbers, within a box.

.. math:: \min_x \max_k (v_k + s_k^T x), \qquad l_g^T x \le c_g, \quad |x_j| \le r

A linear program with a few unknowns and hundreds of rows. Its dual has as many equations as
there are unknowns and a first basis that is at hand, so that the simplex method needs some tens
of steps on a small matrix: a tenth of the time that a general solver takes to be called.

Source: V. Chvatal, *Linear Programming* (1983), chapter 7 (revised simplex method) and chapter 10
(solving a program by its dual).
"""

from __future__ import annotations

import numpy as np

from hpid_ros.control.norm_arrays import Array

_FEASIBLE = 1e-9
_STEPS = 300  # far beyond what it takes; a program that cycles is given up
_TINY = 1e-12


def least_maximum(
    values: Array, slopes: Array, losses: Array, spare: Array, radius: float
) -> Array | None:
    """Return the x in the box that makes the largest linear function least.

    Args:
        values: The functions at x = 0, of shape (rows,).
        slopes: Their slopes, of shape (rows, n).
        losses: Slopes of what must not exceed ``spare``, of shape (limits, n).
        spare: What they may reach; not negative, so that x = 0 is allowed.
        radius: Half of the box's side.

    Returns:
        Array of shape (n,); None if the arithmetic fails, which it may where slopes differ by
        many orders of magnitude.
    """
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
            best: Array = np.clip(point[:n], -radius, radius)
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

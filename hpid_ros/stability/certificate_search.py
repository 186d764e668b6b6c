r"""Search of certificates: quadratic forms for one loop, on a grid over the unit sphere.

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

from collections.abc import Callable, Iterator, Sequence
from itertools import chain, product

import numpy as np

from hpid_ros.base.errors import GainError, NormError, SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.norms import Norm, canonical_values
from hpid_ros.stability.certification import require_certifiable
from hpid_ros.stability.closed_loop import (
    Certificate,
    CertifiedSpan,
    ScaledGains,
    as_matrix,
    effective_gains,
    require_certifiable_norm,
    unit_curve,
)

LEAST_MONOTONICITY = 0.05
"""Least eigenvalue of the dilation's generator, relative to P, that is accepted."""

_TOLERANCE_OF_RIM = 1e-5  # Newton's last step; what it leaves is the square of that
_AT_HAND = 10_000  # points, 80 kB of each array
_DEEP = 14.0  # in ln of a power of the norm: there it is negligible


def time_unit(gains: Gains | ScaledGains) -> float:
    """Return the rate ki^(1/3) in [1/s] that makes the integral gain one."""
    return float(gains.i ** (1.0 / 3.0))


def growth_rates(shapes: Numbers, degrees: Sequence[float]) -> Numbers:
    r"""Return the least and the largest growth rate of the P-norm along the dilation, (..., D, 2).

    They are the ends of the eigenvalues of :math:`\tfrac12 P^{-1/2}(PG + GP)P^{-1/2}` with
    G = diag(1 - mu, 1, 1 + mu); every orbit of the dilation crosses the sphere once if the least
    is positive. Minus infinity where P is not positive definite.
    """
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

    Works in the loop's own units: time in 1/ki^(1/3), so that the integral gain is one; P may be
    given in those of another rate [1/s]. Half of the directions in the plane of error and rate are
    even for the norm, half for the sphere, whose ends may be thin.

    At a direction on the rim, carried inward by the dilation, error, rate and the terms of the
    law are each a number times a power of the depth. With the height h above the plane of
    error and rate the field's inflow is

    .. math:: x^T P f = A + B h + p_{23} h^2, \qquad h^2 = (1 - q) / p_{33},

    where q, A and B are sums of a few such products: over all directions and depths they are
    products of two thin matrices, and a fine grid costs little more than its square roots.
    """

    def __init__(
        self,
        gains: Gains | ScaledGains,
        norm: Norm,
        along: int,
        inward: int,
        unit_of_shapes: float = 0.0,
    ) -> None:
        self._unit = unit = time_unit(gains)
        scales = (unit / (unit_of_shapes or unit)) ** np.arange(3.0)
        self._to_own = np.multiply.outer(scales, scales)
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
        shapes = shapes * self._to_own
        rates = self._away_from_pole(*self._factors(shapes))
        pole = shapes[..., 1, 2, None] / shapes[..., 2, 2, None]
        return np.concatenate([rates.reshape(*shapes.shape[:-2], -1), pole], axis=-1)

    def largest_rates(self, shapes: Numbers) -> Numbers:
        """Return the largest of :meth:`rates` of each shape, of shape (...).

        Some directions at a time: what a processor has at hand is read faster than it is
        computed, and a fine grid is larger than that.
        """
        shapes = shapes * self._to_own
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
        rim = self._norm.values(first, self._unit * second)
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
            return np.asarray(np.clip(point[:n], -radius, radius))
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
_STALLED, _MOST_MOVES = 3, 40  # steps without that gain, and in all
_ACTIVE = 200  # points that a linear program looks at
_STRETCH = np.tril_indices(3)


def scaled_loop(gains: Gains | ScaledGains) -> Numbers:
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
    return np.asarray(0.5 * (shape + shape.T))


def first_shapes(gains: Gains | ScaledGains, norm: Norm) -> Numbers:
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
    for _ in range(_MOST_MOVES):
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
    return np.asarray(factor @ factor.T)


NormOfDegree = Callable[[float], Norm]

OUTERMOST_DEGREE = 0.495
"""Where the search ends on either side."""

_MARGIN = 1e-3  # of the rate in units of ki^(1/3), on the fine grid
_MARGIN_OF_SLOW_LOOP = 0.05  # of the loop's slowest pole, where that is less
_WIDEST_SPAN = 0.05
_COARSE = (12, 24)
_MEDIUM = (30, 60)
_FINE = (80, 260)
_REFINED = 4
_AMPLE = 3.0
_SAME = 1e-12  # of two P; rounding when units are changed and changed back


def shared_spans(
    one: Sequence[CertifiedSpan], other: Sequence[CertifiedSpan], inertia: float
) -> list[CertifiedSpan]:
    """Return spans that are certified at an inertia between two others because they are there.

    For one P, x'P f(x) is a linear function of one over the inertia: what is negative at two
    inertias is negative between them.
    """
    return [
        CertifiedSpan(inertia, here.norms, here.shape, min(here.rate, there.rate))
        for here in one
        for there in other
        if (here.lower, here.upper) == (there.lower, there.upper)
        and np.allclose(here.shape, there.shape, rtol=_SAME, atol=0.0)
    ]


class CertificateSearch:
    """Finds certificates of one loop."""

    def __init__(
        self, gains: Gains, inertia: float, norm_of_degree: NormOfDegree, first_degree: float = 0.0
    ) -> None:
        self._inertia = inertia
        self._effective = effective_gains(gains, inertia)
        self._norm_of_degree = norm_of_degree
        self._norms: dict[float, Norm] = {}
        slowest = -np.linalg.eigvals(scaled_loop(self._effective)).real.max()
        self._margin = min(_MARGIN, _MARGIN_OF_SLOW_LOOP * float(slowest))
        self._seen: dict[tuple[float, bytes], float] = {}
        self._first_shapes = first_shapes(self._effective, self.norm(first_degree))

    def norm(self, degree: float) -> Norm:
        known = self._norms.get(degree)
        if known is not None:
            return known
        norm = self._norm_of_degree(degree)
        require_certifiable_norm(norm)
        if norm.degree != degree:
            raise NormError(
                f"norm_of_degree must give a norm of the degree it is asked for: "
                f"asked {degree}, got {norm!r}"
            )
        self._norms[degree] = norm
        return norm

    def outward(
        self,
        direction: float,
        tolerance: float,
        outermost: float = OUTERMOST_DEGREE,
        like: Sequence[CertifiedSpan] = (),
        certain: Sequence[CertifiedSpan] = (),
    ) -> list[CertifiedSpan]:
        """Return certified spans that follow each other from degree zero."""
        here, width = 0.0, _WIDEST_SPAN
        spans: list[CertifiedSpan] = []
        shape: Numbers | None = None
        while abs(here) < outermost and width >= 0.5 * tolerance:
            there = direction * round(min(abs(here) + width, outermost), 12)
            ends = sorted((here, there))
            ready = [span for span in certain if [span.lower, span.upper] == ends]
            if ready:
                shape = self._in_units(ready[0])
                spans.append(ready[0])
                here = there
                continue
            middle = 0.5 * (here + there)
            others = [self._in_units(span) for span in like if span.lower <= middle <= span.upper]
            found = self._find((here, middle, there), shape, others)
            if found is None:
                width *= 0.5
                continue
            shape, span = found
            spans.append(span)
            here = there
        return spans or [self.at(0.0)]

    def at(self, degree: float) -> CertifiedSpan:
        """Return a certificate of one degree alone, its decay made as fast as the search can."""
        found = self._find((degree,), None)
        if found is None:
            raise GainError(
                f"degree {degree:g} is not certified for effective gains p "
                f"{self._effective.p:g}, i {self._effective.i:g}, d {self._effective.d:g}: "
                f"choose one closer to 0, or gains with p d further above i"
            )
        shape, span = found
        faster = improved(self._grids((degree,), _COARSE), shape, relative=True)
        return self._accepted((degree,), faster) or span

    def _find(
        self, degrees: tuple[float, ...], near: Numbers | None, others: Sequence[Numbers] = ()
    ) -> tuple[Numbers, CertifiedSpan] | None:
        """Return a shape that is accepted at all of these degrees, or None."""
        ends = (degrees[0], degrees[-1])[: len(degrees)]
        try:
            coarse = self._grids(ends, _COARSE)
        except NormError:
            return None  # the law has none there
        for shape in chain(others, self._candidates(coarse, ends, near)):
            span = self._accepted(degrees, shape)
            if span is not None:
                return shape, span
        return None

    def _candidates(
        self, coarse: list[SphereGrid], ends: tuple[float, ...], near: Numbers | None
    ) -> Iterator[Numbers]:
        """Yield shapes worth a look on the fine grid, the cheapest first."""
        enough = -_AMPLE * self._margin
        # A narrower span is asked for after a wider one failed, and is close to what is known.
        is_widest = near is None or abs(ends[-1] - ends[0]) > 0.99 * _WIDEST_SPAN
        for start in self._starts(coarse, near, is_widest):
            yield start
            shape = improved(coarse, start, enough=enough)
            yield shape
            if worst_rate(coarse, shape) < -self._margin:  # but too bad between the points
                yield improved(self._grids(ends, _MEDIUM), shape, enough=enough)

    def _starts(
        self, grids: list[SphereGrid], near: Numbers | None, is_widest: bool
    ) -> Iterator[Numbers]:
        if near is not None:
            yield near
        # The best shape of each scale: from scales that are far apart, the search ends in
        # different optima.
        scales, solutions = self._first_shapes.shape[:2]
        rates = worst_rates(grids, self._first_shapes.reshape(-1, 3, 3))
        rates = rates.reshape(scales, solutions)
        best = self._first_shapes[np.arange(scales), rates.argmin(axis=1)]
        order = np.argsort(rates.min(axis=1), kind="stable")
        yield from best[order[: _REFINED if is_widest else 1]]

    def _accepted(self, degrees: tuple[float, ...], shape: Numbers) -> CertifiedSpan | None:
        """Return the span that a shape certifies on the fine grid, or None."""
        coarse = worst_rate(self._grids(degrees, _COARSE), shape)
        if coarse > -self._margin:
            return None
        worst = coarse
        for degree in degrees:
            worst = max(worst, self._on_fine_grid(degree, shape))
            if worst > -self._margin:
                return None
        unit = time_unit(self._effective)
        physical = shape / self._units()
        physical = 0.5 * (physical + physical.T)
        return CertifiedSpan(
            inertia=self._inertia,
            norms=tuple(self.norm(degree) for degree in sorted(degrees)),
            shape=as_matrix(physical),
            rate=-worst * unit,
        )

    def _on_fine_grid(self, degree: float, shape: Numbers) -> float:
        """Return the worst rate; spans that follow each other share a degree, and often a P."""
        key = degree, shape.tobytes()
        if key not in self._seen:
            self._seen[key] = worst_rate(self._grids((degree,), _FINE), shape)
        return self._seen[key]

    def _units(self) -> Numbers:
        """Return what turns a P in [rad], [s] into one in units of ki^(1/3)."""
        scales = time_unit(self._effective) ** np.arange(3.0)
        return np.asarray(np.multiply.outer(scales, scales))

    def _in_units(self, span: CertifiedSpan) -> Numbers:
        return np.asarray(np.array(span.shape) * self._units())

    def _grids(self, degrees: tuple[float, ...], size: tuple[int, int]) -> list[SphereGrid]:
        return [SphereGrid(self._effective, self.norm(degree), *size) for degree in degrees]


def certified_degree_interval(
    gains: Gains,
    norm_of_degree: Callable[[float], Norm],
    inertia: float | tuple[float, float] = 1.0,
    tolerance: float = 2e-3,
) -> Certificate:
    """Return degrees around zero for which the homogeneous PID is certified stable.

    Certified is the ideal loop, the law without floor or cap on a double integrator of constant
    inertia. The certificate holds one quadratic form for each span of at most 0.05 in the
    degree, seen to hold at the span's ends and middle on a fine grid; it is not necessary for
    stability, so a loop may well be stable outside the interval.
    """
    if not tolerance > 0.0:
        raise SettingError(f"the tolerance of a degree must be positive, not {tolerance}")
    # From the largest inertia, where the integral weighs most and the interval is narrowest: the
    # others need not be searched beyond its ends, and often share its P. The middle comes last.
    inertias = require_certifiable(gains, inertia)
    order = dict.fromkeys((inertias[-1], inertias[0], *inertias[1:-1]))
    searches = {each: CertificateSearch(gains, each, norm_of_degree) for each in order}
    spans: dict[float, list[CertifiedSpan]] = {each: [] for each in inertias}
    for direction in (-1.0, 1.0):
        found: list[list[CertifiedSpan]] = []
        outermost = OUTERMOST_DEGREE
        for each, search in searches.items():
            like = found[-1] if found else ()
            certain = shared_spans(found[0], found[1], each) if len(found) == 2 else ()
            found.append(search.outward(direction, tolerance, outermost, like, certain))
            outermost = max(abs(found[-1][-1].lower), abs(found[-1][-1].upper))
            spans[each] += reversed(found[-1]) if direction < 0.0 else found[-1]
    return Certificate(gains, tuple(span for own in spans.values() for span in own))


def certify_degree(
    gains: Gains, norm: Norm, inertia: float | tuple[float, float] = 1.0
) -> Certificate:
    """Return a certificate of one degree, its decay made as fast as the search can."""
    require_certifiable_norm(norm)
    spans = [
        CertificateSearch(gains, each, lambda degree: norm, norm.degree).at(norm.degree)
        for each in require_certifiable(gains, inertia)
    ]
    return Certificate(gains, tuple(spans))

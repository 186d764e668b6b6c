r"""The equation of motion of one joint, and the regression for its coefficients.

.. math:: \tau(t - d) = \tau_{rb} + m \ddot q + b \dot q + c \,\mathrm{sign}\,\dot q
    + a_s \sin q + a_c \cos q + k

with the efforts :math:`\tau_{rb}` of the rigid bodies where they are known; then m is what they
lack, the rotor behind its gear, and there is no other gravity. The delay d is linear only close
by: it is found on a coarse grid, then by Gauss and Newton's method, as one more column,
:math:`\dot\tau`.

Least squares are biased where columns have noise. Instrumental variables z are correlated with a
column but not with its noise, and estimates are those for which the residual has nothing in
common with them,

.. math:: \sum_t z_t (y_t - x_t^T \theta) = 0

Covariances are robust to residuals whose size changes and that are correlated over many rows
(Newey and West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation
consistent covariance matrix", Econometrica 55, 1987), and intervals use critical values that know
over how many (Kiefer and Vogelsang, "A new asymptotic theory for
heteroskedasticity-autocorrelation robust tests", Econometric Theory 21, 2005).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from hpid_ros.base.units import Numbers
from hpid_ros.tuning.joint_record import DERIVATIVES, Halves, Kernel

INERTIA = "inertia"
VISCOUS = "viscous"
COULOMB = "coulomb"
STRIBECK = "stribeck"
OFFSET = "offset"
GRAVITY_SIN = "gravity_sin"
GRAVITY_COS = "gravity_cos"
EFFORT_SCALE = "effort_scale"
DELAY = "delay"
SPIN = "spin"
"""No parameter: how much there is of the effort that rotors need besides their inertia."""

PARAMETERS: Mapping[str, tuple[str, str]] = {
    INERTIA: ("kg m^2", "kg"),
    VISCOUS: ("N m s/rad", "N s/m"),
    COULOMB: ("N m", "N"),
    STRIBECK: ("N m", "N"),
    GRAVITY_SIN: ("N m", "N"),
    GRAVITY_COS: ("N m", "N"),
    OFFSET: ("N m", "N"),
    EFFORT_SCALE: ("", ""),
    DELAY: ("s", "s"),
}
"""Names of all parameters, with the units of a joint that turns and of one that slides."""


@dataclass(frozen=True)
class Estimate:
    """One number."""

    value: float  # the estimate, in SI units
    half_width: float  # of its 95 % interval
    reason: str = ""  # why it should not be relied on, and what motion would help

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half_width

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half_width

    @property
    def is_reliable(self) -> bool:
        """Whether it can be relied on."""
        return not self.reason

    @property
    def is_positive(self) -> bool:
        """Whether the whole interval is above zero."""
        return self.low > 0.0


_ROUNDING = 1e-6  # cells: what stamps in floating point may be off
_ROWS_PER_PERIOD = 4  # of the kernel's cut-off frequency
_LAGS = (0, 1, 2, 3, 4, 6, 8, 11, 15, 20)
"""Of reference and friction, in quarters of the cut-off's period: how a loop answers, in few
numbers."""
_SLOW_NOISE = 5.0  # standard deviations of the velocity's noise
_SLOW_SHARE = 0.2  # of its root mean square


class Grid(NamedTuple):
    """Cells of one length and the rows among them."""

    first: float  # [s] middle of the first cell
    length: float  # [s] of a cell
    begin: int  # the cell in whose middle the first row is
    stride: int  # cells from one row to the next
    rows: int  # how many rows there are
    reach: int  # cells to either side of a row that have weight

    @classmethod
    def over(cls, cells: Halves, kernel: Kernel, margin: float) -> Grid | None:
        """Return the rows whose columns are known; None where there is no room for any."""
        length = cells.length
        reach = math.floor(kernel.half_width / length + _ROUNDING)
        # Twice: a sign is smoothed of smoothed velocities.
        begin = 2 * reach + math.ceil(margin / length - _ROUNDING)
        stride = max(1, round(1.0 / (_ROWS_PER_PERIOD * kernel.cutoff * length)))
        room = len(cells.even) - 2 * begin
        if room < 1:
            return None
        return cls(cells.first, length, begin, stride, (room - 1) // stride + 1, reach)

    @property
    def times(self) -> Numbers:
        """When the rows are, (R,), in [s]."""
        cells = self.begin + self.stride * np.arange(self.rows)
        return np.asarray(self.first + self.length * cells)

    @property
    def offsets(self) -> Numbers:
        """When the cells are that have weight for a row, after it, in [s]."""
        return np.asarray(self.length * np.arange(-self.reach, self.reach + 1.0))

    def smoothed(self, cells: Numbers, kernel: Kernel, order: int = 0) -> Numbers:
        """Return a smoothed derivative at the rows."""
        return self._convolved(cells, kernel, order, self.begin, self.stride, self.rows)

    def fine(self, cells: Numbers, kernel: Kernel, order: int) -> Numbers:
        """Return a smoothed derivative at every cell, its ends' as those nearest to them."""
        inner = self._convolved(cells, kernel, order, self.reach, 1, len(cells) - 2 * self.reach)
        return np.pad(inner, self.reach, mode="edge")

    def edges(self, cells: int) -> Numbers:
        """Return the edges of the cells, (cells + 1,), in [s]."""
        return np.asarray(self.first + self.length * (np.arange(cells + 1) - 0.5))

    def _convolved(
        self, cells: Numbers, kernel: Kernel, order: int, begin: int, stride: int, rows: int
    ) -> Numbers:
        taps = kernel.taps(self.offsets, self.length, order)
        needed = cells[begin - self.reach : begin + self.reach + stride * (rows - 1) + 1]
        return np.asarray(np.correlate(needed, taps, "valid")[::stride])


class Motion(NamedTuple):
    """A joint's motion at R rows, from either half of its samples."""

    # positions [rad], velocities [rad/s], accelerations [rad/s^2], (2, 3, R)
    halves: Numbers
    sign: Numbers  # direction of its motion, smoothed, (R,); 1 or -1 but around a reversal
    slow: Numbers  # which share of a row's weight lies where the direction is in doubt, (R,)
    velocity: Numbers  # [rad/s] at every cell, (K,)
    reference: Numbers

    @property
    def mean(self) -> Numbers:
        """Position, velocity and acceleration, (3, R)."""
        return np.asarray(self.halves.mean(axis=0))

    @property
    def noise(self) -> Numbers:
        """Standard deviations of the noise in the means, (3,), by how far the halves differ."""
        return np.asarray((self.halves[0] - self.halves[1]).std(axis=1) / 2.0)


def motion_of(cells: Halves, grid: Grid, kernel: Kernel) -> Motion:
    """Return a joint's motion."""
    both = np.array(
        [
            [grid.smoothed(half, kernel, order) for order in DERIVATIVES]
            for half in (cells.even, cells.odd)
        ]
    )
    velocities = [grid.fine(half, kernel, 1) for half in (cells.even, cells.odd)]
    velocity = (velocities[0] + velocities[1]) / 2.0
    noise = float((velocities[0] - velocities[1]).std()) / 2.0
    least = max(_SLOW_NOISE * noise, _SLOW_SHARE * float(np.sqrt(np.mean(velocity**2))))
    is_slow = np.abs(velocity) < least
    weights = np.abs(kernel.taps(grid.offsets, grid.length, 0))
    slow = np.convolve(is_slow, weights / weights.sum(), "same")
    rows = grid.begin + grid.stride * np.arange(grid.rows)
    sign = grid.smoothed(np.sign(velocity), kernel)
    direction = np.where(is_slow, 0.0, np.sign(velocity))
    reference = _reference(cells.reference, direction, grid, kernel)
    return Motion(both, sign, slow[rows], velocity, reference)


def _reference(cells: Numbers, direction: Numbers, grid: Grid, kernel: Kernel) -> Numbers:
    if not len(cells):
        return np.empty((0, grid.rows))
    found = []
    for lag in _LAGS:
        shift = round(lag / (_ROWS_PER_PERIOD * kernel.cutoff) / grid.length)
        for source, orders in ((cells, (1, 2)), (direction, (0,))):
            late = np.concatenate([np.full(shift, source[0]), source[: len(source) - shift]])
            found += [grid.smoothed(late, kernel, order) for order in orders]
    return np.array(found)


def joined(parts: Sequence[Numbers], padding: int) -> Numbers:
    """Return the rows of several spans behind each other, with rows of zeros between them."""
    gap = np.zeros((*parts[0].shape[:-1], padding))
    pieces = [piece for part in parts for piece in (part, gap)]
    return np.concatenate(pieces[:-1], axis=-1)


_LEAST_LAGS = 32  # rows; twice the width of the kernel
_UNCORRELATED = 0.05
_CORRELATION_TIMES = 4.0
_MOST_LAGS = 0.2  # of all rows


class Regression(NamedTuple):
    """A fit of R rows by P columns."""

    values: Numbers  # coefficients, (P,)
    covariance: Numbers  # of them, (P, P)
    critical: float  # half-width of a 95 % interval over the standard deviation
    residual: Numbers  # of each row, (R,); zero where a row has no weight
    rms: float  # root mean square of the residual
    condition: float  # condition number of the columns, each of them scaled to unit length
    sharing: Numbers

    @property
    def deviations(self) -> Numbers:
        """Standard deviations of the coefficients, (P,)."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))

    def probability_of_none(self, places: list[int]) -> float:
        """Return the probability that coefficients which are zero would seem this large."""
        theta, block = self.values[places], self.covariance[np.ix_(places, places)]
        shrunk = (1.959964 / self.critical) ** 2
        statistic = float(theta @ np.linalg.pinv(block) @ theta) * shrunk
        return float(chi2.sf(statistic, len(places)))


def regress(
    instruments: Numbers, columns: Numbers, effort: Numbers, weight: Numbers
) -> Regression:
    """Fit efforts by columns, with one or two versions of everything."""
    x, y = columns * weight, effort * weight
    size = np.sqrt(np.mean(x**2, axis=(0, 2)) + 1e-300)[:, None]
    x, z = x / size, instruments * weight / size
    inverse = np.linalg.pinv(np.einsum("hpr,hqr->pq", z, x), rcond=1e-13)
    scaled = inverse @ np.einsum("hpr,hr->p", z, y)
    errors = y - np.einsum("p,hpr->hr", scaled, x)
    moments = np.einsum("hpr,hr->pr", z, errors)
    rows = int(np.count_nonzero(weight))
    residual = np.asarray(errors.mean(axis=0))
    lags = min(_lags(residual), max(1, int(_MOST_LAGS * rows)))
    freedom = rows / max(rows - len(scaled), 1)
    covariance = inverse @ _long_run(moments, lags) @ inverse.T * freedom
    left = float(np.mean(residual[weight > 0.0] ** 2))
    mean = x.mean(axis=0)
    singular = np.linalg.svd(mean[:, weight > 0.0], compute_uv=False)
    gram = mean @ mean.T
    return Regression(
        values=scaled / size[:, 0],
        covariance=covariance / (size * size.T),
        critical=_critical(lags / max(rows, 1)),
        residual=residual,
        rms=float(np.sqrt(left)),
        condition=float(singular[0] / max(singular[-1], 1e-300)),
        sharing=np.diagonal(np.linalg.pinv(gram)) * np.diagonal(gram),
    )


def _lags(residual: Numbers) -> int:
    """Return over how many rows residuals are taken to be correlated."""
    spectrum = np.abs(np.fft.rfft(residual, 2 * len(residual))) ** 2
    correlation = np.fft.irfft(spectrum)[: len(residual)]
    if correlation[0] <= 0.0:
        return _LEAST_LAGS
    small = np.flatnonzero(correlation < _UNCORRELATED * correlation[0])
    first = int(small[0]) if len(small) else len(residual)
    time = float(np.sum(correlation[:first])) / float(correlation[0])
    return max(_LEAST_LAGS, round(_CORRELATION_TIMES * time))


def _long_run(moments: Numbers, lags: int) -> Numbers:
    """Return the sum of the moments' autocovariances, by Bartlett's weights, (P, P)."""
    total = moments @ moments.T
    for lag in range(1, lags + 1):
        shifted = moments[:, lag:] @ moments[:, :-lag].T
        total = total + (1.0 - lag / (lags + 1.0)) * (shifted + shifted.T)
    return np.asarray(total)


def _critical(share: float) -> float:
    """Return the 97.5 % point for Bartlett's weights over a share of all rows."""
    return 1.9600 + 2.9694 * share + 0.4160 * share**2 - 0.5324 * share**3


_DOUBTS = (0.005, 0.02, 0.1)
"""Largest share of a row's weight where the direction may be in doubt: the strictest that leaves
rows enough. A joint that sticks at a reversal is taken to creep there by whatever smooths."""
_ENOUGH_ROWS = 100
_MOST_GROWTH = 1000.0
"""Of a variance: noise that is fed back biases samples between by more than that widens."""
_MOST_MISFIT = 3.0
_LEAST_SINGULAR = 1e-6
_STEPS_PER_PERIOD = 8.0  # of the cut-off frequency, in the coarse search
_NEWTON_STEPS = 6
_SETTLED = 1e-9  # [s]
_PERIODS_AHEAD = 3.0
"""A measured effort may be behind the motion by its sampling; it is never far behind."""


class Terms(NamedTuple):
    """The motion of all spans behind each other."""

    halves: Numbers  # position, velocity, acceleration of either half, (2, 3, R)
    sign: Numbers  # direction, smoothed, (R,)
    doubt: Numbers  # share of each row's weight where the direction is in doubt, (R,)
    rigid: Numbers | None  # effort of the rigid bodies for either half, (2, R); None if unknown
    static: Numbers | None  # what they need at rest, (R,), without the noise of accelerations
    reference: Numbers  # what the reference and friction did, (B, R)
    # smoothed column of Stribeck friction, (R,), for a Stribeck speed [rad/s]
    stribeck: Callable[[float], Numbers]
    spin: Numbers | None = None  # effort that rotors need besides their inertia, (R,)

    @classmethod
    def of(
        cls,
        motions: Sequence[Motion],
        rigid: Sequence[Numbers] | None,
        static: Sequence[Numbers] | None,
        smoothed: Callable[[Callable[[Numbers], Numbers]], Numbers],
        padding: int,
    ) -> Terms:
        """Join the spans."""
        known = joined([1.0 - each.slow for each in motions], padding)
        return cls(
            joined([each.halves for each in motions], padding),
            joined([each.sign for each in motions], padding),
            1.0 - known,
            None if rigid is None else joined(rigid, padding),
            None if static is None else joined(static, padding),
            joined([each.reference for each in motions], padding),
            lambda speed: smoothed(lambda v: np.sign(v) * np.exp(-((v / speed) ** 2))),
        )

    def without(self, masks: Sequence[NDArray[np.bool_]]) -> Terms:
        """Return the same with rows that do not count."""
        if not masks:
            return self
        return self._replace(doubt=np.where(np.any(masks, axis=0), 1.0, self.doubt))


class Model(NamedTuple):
    """Which terms an equation has."""

    has_coulomb: bool = True  # Coulomb friction: the joint moved in both directions
    has_gravity: bool = False  # sine and cosine of the position
    has_delay: bool = True  # what is left of the delay is sought, too
    has_scale: bool = False  # the rigid bodies' effort has a coefficient
    stribeck_speed: float = 0.0  # [rad/s] zero for none
    has_spin: bool = False  # the effort that rotors need besides their inertia has a coefficient


class Equation:
    """One joint's equation over all its rows."""

    def __init__(
        self,
        terms: Terms,
        effort: Callable[[float], Numbers],
        *,
        period: float,
        cutoff: float,
        longest_delay: float,
    ) -> None:
        self.terms, self.cutoff, self._effort = terms, cutoff, effort
        for doubt in _DOUBTS:
            self.weight = np.where(terms.doubt <= doubt, 1.0, 0.0)
            if self.used_rows >= _ENOUGH_ROWS:
                break
        self._step = 1.0 / (_STEPS_PER_PERIOD * cutoff)
        self._there = terms.doubt < 1.0
        basis = np.concatenate([terms.reference, [terms.sign, np.ones_like(terms.sign)]])
        known = basis[:, self._there]
        size = np.linalg.norm(known, axis=1, keepdims=True)
        self._basis = basis / np.maximum(size, 1e-300)
        self._answer = np.linalg.pinv(known / np.maximum(size, 1e-300), rcond=_LEAST_SINGULAR)
        self._may_use_reference = len(terms.reference) > 0
        self.resolution = 1.0 / (2.0 * cutoff)
        self._least, self._longest = -_PERIODS_AHEAD * period, longest_delay

    @property
    def used_rows(self) -> int:
        """Rows that count."""
        return int(np.count_nonzero(self.weight))

    def is_inside(self, delay: float) -> bool:
        """Return whether a delay is none of the ends between which it is looked for."""
        return self._least - self._step < delay < self._longest

    def effort(self, delay: float) -> Numbers:
        """Return the smoothed effort that acts with a delay, (R,), in [N m]."""
        return np.asarray(self._effort(delay)[0])

    def names(self, model: Model) -> list[str]:
        """Return what the columns of a model stand for."""
        given = {
            INERTIA: True,
            VISCOUS: True,
            COULOMB: model.has_coulomb,
            STRIBECK: model.stribeck_speed > 0.0,
            GRAVITY_SIN: model.has_gravity,
            GRAVITY_COS: model.has_gravity,
            OFFSET: True,
            EFFORT_SCALE: model.has_scale,
            SPIN: model.has_spin,
            DELAY: model.has_delay,
        }
        return [name for name, is_there in given.items() if is_there]

    def coarse_delay(self, model: Model) -> float:
        """Return the delay with the least residual among evenly spaced ones, in [s]."""
        basis = model._replace(has_delay=False)
        columns = self._columns(basis, np.zeros_like(self.weight)).mean(axis=0) * self.weight
        known = 0.0 if self.terms.rigid is None or model.has_scale else self.terms.rigid.mean(0)
        size = np.linalg.norm(columns, axis=1, keepdims=True)
        orthogonal, _ = np.linalg.qr((columns / np.maximum(size, 1e-300)).T)

        def left(delay: float) -> float:
            target = (self.effort(delay) - known) * self.weight
            rest = target - orthogonal @ (orthogonal.T @ target)
            return float(rest @ rest)

        grid = np.arange(self._least, self._longest + self._step, self._step)
        return float(grid[int(np.argmin([left(float(each)) for each in grid]))])

    def solve(self, model: Model, delay: float) -> tuple[Regression, float]:
        """Return the fit of a model and the delay to which it belongs."""
        for _ in range(_NEWTON_STEPS):
            fit = self._fit(model, delay)
            if not model.has_delay:
                break
            step = float(np.clip(fit.values[-1], -2.0 * self._step, 2.0 * self._step))
            if abs(step) < _SETTLED:
                break
            delay = float(np.clip(delay + step, self._least - self._step, self._longest))
        return fit, delay

    def choose_instruments(self, model: Model, delay: float) -> None:
        """Do without the reference if what it finds explains the efforts much worse.

        Then the instruments have something in common with what the model leaves out.
        """
        if self._may_use_reference:
            with_reference = self.solve(model, delay)[0].rms
            self._may_use_reference = False
            without = self.solve(model, delay)[0].rms
            self._may_use_reference = with_reference <= _MOST_MISFIT * without

    def predicted(self, model: Model, fit: Regression) -> Numbers:
        """Return the effort that a fit predicts at the rows, (R,), in [N m]."""
        columns = self._columns(model, np.zeros_like(self.weight)).mean(axis=0)
        known = 0.0 if self.terms.rigid is None or model.has_scale else self.terms.rigid.mean(0)
        return np.asarray(fit.values @ columns + known)

    def _fit(self, model: Model, delay: float) -> Regression:
        effort, rate = self._effort(delay)
        target = np.stack([effort, effort])
        if self.terms.rigid is not None and not model.has_scale:
            target = target - self.terms.rigid
        columns = self._columns(model, rate)
        instruments = self._instruments(model, columns.mean(axis=0))
        if instruments is None:
            return regress(columns[::-1], columns, target, self.weight)
        mean = columns.mean(axis=0, keepdims=True)
        return regress(instruments[None], mean, target.mean(axis=0, keepdims=True), self.weight)

    def uses_reference(self, model: Model, delay: float) -> bool:
        """Return whether the reference is the source of a model's instruments."""
        columns = self._columns(model, self._effort(delay)[1])
        return self._instruments(model, columns.mean(axis=0)) is not None

    def _instruments(self, model: Model, columns: Numbers) -> Numbers | None:
        """Return instruments from the reference, (P, R); None where they would be weak.

        They are weak where they multiply a coefficient's variance many times, as those of a single
        sine do, whose answer has no more than two numbers.
        """
        if not self._may_use_reference:
            return None
        instruments = columns.copy()
        noisy = self._noisy(model)
        for place in noisy:
            instruments[place] = self._of_reference(columns[place])
        if model.has_scale:
            assert self.terms.static is not None
            place = self.names(model).index(EFFORT_SCALE)
            moving = columns[place] - self.terms.static
            instruments[place] = self.terms.static + self._of_reference(moving)
            noisy.append(place)
        growth = _variance_growth(instruments * self.weight, columns * self.weight)[noisy]
        return instruments if float(np.max(growth)) < _MOST_GROWTH else None

    def _noisy(self, model: Model) -> list[int]:
        """Return the places of columns that need an instrument; others are as good as exact."""
        names = self.names(model)
        return [names.index(name) for name in (INERTIA, VISCOUS, DELAY) if name in names]

    def _of_reference(self, column: Numbers) -> Numbers:
        """Return what a linear answer to the reference explains of a column, (R,)."""
        return np.asarray(column[self._there] @ self._answer @ self._basis)

    def _columns(self, model: Model, rate: Numbers) -> Numbers:
        """Return the columns of a model for either half, (2, P, R)."""
        terms = self.terms
        position, velocity, acceleration = np.moveaxis(terms.halves, 1, 0)
        columns = [acceleration, velocity]
        if model.has_coulomb:
            columns.append(_twice(terms.sign))
        if model.stribeck_speed:
            columns.append(_twice(terms.stribeck(model.stribeck_speed)))
        if model.has_gravity:
            columns += [np.sin(position), np.cos(position)]
        columns.append(np.ones_like(position))
        if model.has_scale:
            assert terms.rigid is not None
            columns.append(terms.rigid)
        if model.has_spin:
            assert terms.spin is not None
            columns.append(_twice(terms.spin))
        if model.has_delay:
            columns.append(_twice(rate))
        return np.stack(columns, axis=1)


def _twice(column: Numbers) -> Numbers:
    return np.stack([column, column])


def _variance_growth(instruments: Numbers, columns: Numbers) -> Numbers:
    """Return by how much instruments multiply the variances of least squares, (P,)."""
    size = np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-300)
    z, x = instruments / size, columns / size
    inverse = np.linalg.pinv(z @ x.T)
    spread = np.diagonal(inverse @ (z @ z.T) @ inverse.T)
    return np.asarray(spread / np.diagonal(np.linalg.pinv(x @ x.T)))

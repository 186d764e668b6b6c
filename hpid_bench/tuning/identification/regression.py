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
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from hpid_bench.tuning.identification.joint_record import Rows, Span
from hpid_ros.base.units import Numbers

INERTIA = "inertia"
VISCOUS = "viscous"
COULOMB = "coulomb"
STRIBECK = "stribeck"
OFFSET = "offset"
GRAVITY_SIN = "gravity_sin"
GRAVITY_COS = "gravity_cos"
EFFORT_SCALE = "effort_scale"
DELAY = "delay"
SPRING = "spring"
"""Of a joint that gives: the coefficient of the effort's second derivative. No parameter."""
SPIN = "spin"
"""The coefficient of the effort that rotors need besides their inertia. No parameter."""

ESTIMATED_PARAMETERS: Mapping[str, tuple[str, str]] = {
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
        return self.value - self.half_width

    @property
    def high(self) -> float:
        return self.value + self.half_width

    @property
    def is_reliable(self) -> bool:
        return not self.reason


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
    # of each coefficient, (P,): its variance over that of a column orthogonal to all others
    variance_inflation: Numbers

    @property
    def deviations(self) -> Numbers:
        """Standard deviations of the coefficients, (P,)."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))


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
        variance_inflation=np.diagonal(np.linalg.pinv(gram)) * np.diagonal(gram),
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
"""A measured effort may be behind the motion by its sampling."""
_SHARE_AHEAD = 0.3  # of the longest delay: efforts may be stamped late, or be filtered


RigidBody = Callable[[Numbers, Numbers, Numbers], Numbers]
"""Efforts that rigid bodies need, (K, R), in [N m], for the positions, velocities and
accelerations of K joints at R rows, each (K, R); without rotors and friction."""


class Model(NamedTuple):
    """Which terms an equation has."""

    has_coulomb: bool = True  # Coulomb friction: the joint moved in both directions
    has_gravity: bool = False  # sine and cosine of the position
    has_delay: bool = True  # what is left of the delay is sought, too
    has_scale: bool = False  # the rigid bodies' effort has a coefficient
    stribeck_speed: float = 0.0  # [rad/s] zero for none
    has_spin: bool = False  # the effort that rotors need besides their inertia has a coefficient
    has_spring: bool = False  # the joint is two masses, the one on a spring

    @property
    def names(self) -> list[str]:
        given = {
            INERTIA: True,
            VISCOUS: True,
            COULOMB: self.has_coulomb,
            STRIBECK: self.stribeck_speed > 0.0,
            GRAVITY_SIN: self.has_gravity,
            GRAVITY_COS: self.has_gravity,
            OFFSET: True,
            EFFORT_SCALE: self.has_scale,
            SPIN: self.has_spin,
            SPRING: self.has_spring,
            DELAY: self.has_delay,
        }
        return [name for name, is_there in given.items() if is_there]


class Solution(NamedTuple):
    """A model that was fitted."""

    model: Model
    fit: Regression
    delay: float  # [s] to which the fit belongs

    def value(self, name: str) -> float:
        return float(self.fit.values[self.model.names.index(name)])

    def half_width(self, name: str) -> float:
        return float(self.fit.critical * self.fit.deviations[self.model.names.index(name)])

    def probability_of_none(self, *names: str) -> float:
        """Return the probability that coefficients which are zero would seem this large."""
        fit, places = self.fit, [self.model.names.index(name) for name in names]
        theta, block = fit.values[places], fit.covariance[np.ix_(places, places)]
        shrunk = (1.959964 / fit.critical) ** 2
        statistic = float(theta @ np.linalg.pinv(block) @ theta) * shrunk
        return float(chi2.sf(statistic, len(places)))


class Equation:
    """One joint's equation over all its rows."""

    def __init__(
        self, rows: Rows, rigid_body: RigidBody | None, left_out: Sequence[Span] = ()
    ) -> None:
        self.rows, self.limit = rows, math.inf
        place, cutoff = rows.place, rows.kernel.cutoff
        self.halves = rows.motion[:, :, place]
        self.sign = rows.smoothed(np.sign)
        self.spin: Numbers | None = None  # effort that rotors need besides their inertia, (R,)
        self.rigid: Numbers | None = None  # effort of the rigid bodies for either half, (2, R)
        if rigid_body is not None:
            self.rigid = np.stack([rigid_body(*half)[place] for half in rows.motion])
            positions = rows.motion.mean(axis=0)[0]
            # What they need at rest, (R,), without the noise of accelerations.
            self._static = rigid_body(positions, 0.0 * positions, 0.0 * positions)[place]
        doubt = rows.doubt()
        for span in left_out:
            doubt[(rows.times >= span.begin) & (rows.times < span.end)] = 1.0
        for most in _DOUBTS:
            self.weight = np.where(doubt <= most, 1.0, 0.0)
            if self.used_rows >= _ENOUGH_ROWS:
                break
        self._step = 1.0 / (_STEPS_PER_PERIOD * cutoff)
        self._there = doubt < 1.0
        reference = rows.reference()
        basis = np.concatenate([reference, [self.sign, np.ones_like(self.sign)]])
        known = basis[:, self._there]
        size = np.linalg.norm(known, axis=1, keepdims=True)
        self._basis = basis / np.maximum(size, 1e-300)
        self._answer = np.linalg.pinv(known / np.maximum(size, 1e-300), rcond=_LEAST_SINGULAR)
        self._may_use_reference = len(reference) > 0
        self.resolution = 1.0 / (2.0 * cutoff)
        self._least, self._longest = -_PERIODS_AHEAD * rows.record.period, rows.longest_delay

    def limited(self, limit: float) -> Equation:
        """Return the same equation for a drive that gives no more than a limit, in [N m]."""
        other = copy(self)
        other.limit = limit
        return other

    def with_spin(self, effort: Numbers) -> Equation:
        """Return the same equation with an effort that rotors need besides their inertia, (R,)."""
        other = copy(self)
        other.spin = effort
        return other

    @property
    def used_rows(self) -> int:
        return int(np.count_nonzero(self.weight))

    def is_inside(self, delay: float) -> bool:
        """Return whether a delay is none of the ends between which it is looked for."""
        return self._least - self._step < delay < self._longest

    def effort(self, delay: float) -> Numbers:
        """Return the smoothed effort that acts with a delay, (R,), in [N m]."""
        return np.asarray(self.rows.effort(delay, self.limit)[0])

    def coarse_delay(self, model: Model) -> float:
        """Return the delay with the least residual among evenly spaced ones, in [s].

        Where the least of them is the best, efforts may be stamped late, and earlier ones are
        looked through; but under feedback efforts follow the motion, too: what moves a negative
        inertia is the controller.
        """
        basis = model._replace(has_delay=False)
        columns = self._columns(basis, self._no_rates).mean(axis=0) * self.weight
        known = 0.0 if self.rigid is None or model.has_scale else self.rigid.mean(0)
        size = np.linalg.norm(columns, axis=1, keepdims=True)
        orthogonal, _ = np.linalg.qr((columns / np.maximum(size, 1e-300)).T)

        def left(delay: float) -> float:
            target = (self.effort(delay) - known) * self.weight
            rest = target - orthogonal @ (orthogonal.T @ target)
            return float(rest @ rest)

        def best(least: float) -> float:
            grid = np.arange(least, self._longest + self._step, self._step)
            return float(grid[int(np.argmin([left(float(each)) for each in grid]))])

        found, usual = best(self._least), self._least
        if found > usual:
            return found
        self._least = min(usual, -_SHARE_AHEAD * self._longest)
        earlier = best(self._least)
        solution = self.solve(model, earlier)
        if solution.value(INERTIA) + solution.half_width(INERTIA) > 0.0:
            return earlier
        self._least = usual
        return found

    def solve(self, model: Model, delay: float) -> Solution:
        """Fit a model, from a delay on."""
        for _ in range(_NEWTON_STEPS):
            fit = self._fit(model, delay)
            step = float(np.clip(fit.values[-1], -2.0 * self._step, 2.0 * self._step))
            if abs(step) < _SETTLED:
                break
            delay = float(np.clip(delay + step, self._least - self._step, self._longest))
        return Solution(model, fit, delay)

    def choose_instruments(self, model: Model, delay: float) -> None:
        """Do without the reference if what it finds explains the efforts much worse.

        Then the instruments have something in common with what the model leaves out.
        """
        if self._may_use_reference:
            with_reference = self.solve(model, delay).fit.rms
            self._may_use_reference = False
            without = self.solve(model, delay).fit.rms
            self._may_use_reference = with_reference <= _MOST_MISFIT * without

    def predicted(self, found: Solution) -> Numbers:
        """Return the effort that is predicted at the rows, (R,), in [N m]."""
        model = found.model
        rates = (
            self.rows.effort(found.delay, self.limit)[1:] if model.has_spring else self._no_rates
        )
        columns = self._columns(model, rates).mean(axis=0)
        known = 0.0 if self.rigid is None or model.has_scale else self.rigid.mean(0)
        return np.asarray(found.fit.values @ columns + known)

    def _fit(self, model: Model, delay: float) -> Regression:
        effort, *rates = self.rows.effort(delay, self.limit)
        target = np.stack([effort, effort])
        if self.rigid is not None and not model.has_scale:
            target = target - self.rigid
        columns = self._columns(model, rates)
        instruments = self._instruments(model, columns.mean(axis=0))
        if instruments is None:
            return regress(columns[::-1], columns, target, self.weight)
        mean = columns.mean(axis=0, keepdims=True)
        return regress(instruments[None], mean, target.mean(axis=0, keepdims=True), self.weight)

    def uses_reference(self, model: Model, delay: float) -> bool:
        """Return whether the reference is the source of a model's instruments."""
        columns = self._columns(model, self.rows.effort(delay, self.limit)[1:])
        return self._instruments(model, columns.mean(axis=0)) is not None

    def _instruments(self, model: Model, columns: Numbers) -> Numbers | None:
        """Return instruments from the reference, (P, R); None where they would be weak.

        They are weak where they multiply a coefficient's variance many times, as those of a single
        sine do, whose answer has no more than two numbers.
        """
        if not self._may_use_reference:
            return None
        instruments = columns.copy()
        # Others are as good as exact.
        noisy = [
            k for k, name in enumerate(model.names) if name in (INERTIA, VISCOUS, SPRING, DELAY)
        ]
        for place in noisy:
            instruments[place] = self._of_reference(columns[place])
        if model.has_scale:
            place = model.names.index(EFFORT_SCALE)
            moving = columns[place] - self._static
            instruments[place] = self._static + self._of_reference(moving)
            noisy.append(place)
        growth = _variance_growth(instruments * self.weight, columns * self.weight)[noisy]
        return instruments if float(np.max(growth)) < _MOST_GROWTH else None

    def _of_reference(self, column: Numbers) -> Numbers:
        """Return what a linear answer to the reference explains of a column, (R,)."""
        return np.asarray(column[self._there] @ self._answer @ self._basis)

    @property
    def _no_rates(self) -> Numbers:
        return np.zeros((2, len(self.weight)))

    def _columns(self, model: Model, rates: Sequence[Numbers] | Numbers) -> Numbers:
        """Return the columns of a model for either half, (2, P, R); with the effort's rates."""
        position, velocity, acceleration = np.moveaxis(self.halves, 1, 0)
        columns = [acceleration, velocity]
        if model.has_coulomb:
            columns.append(_twice(self.sign))
        if model.stribeck_speed:
            speed = model.stribeck_speed
            creep = self.rows.smoothed(lambda v: np.sign(v) * np.exp(-((v / speed) ** 2)))
            columns.append(_twice(creep))
        if model.has_gravity:
            columns += [np.sin(position), np.cos(position)]
        columns.append(np.ones_like(position))
        if model.has_scale:
            assert self.rigid is not None
            columns.append(self.rigid)
        if model.has_spin:
            assert self.spin is not None
            columns.append(_twice(self.spin))
        if model.has_spring:
            columns.append(_twice(rates[1]))
        if model.has_delay:
            columns.append(_twice(rates[0]))
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

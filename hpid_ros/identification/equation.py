r"""The equation of motion of one joint, whose coefficients are sought.

.. math:: \tau(t - d) = \tau_{rb} + m \ddot q + b \dot q + c \,\mathrm{sign}\,\dot q
    + a_s \sin q + a_c \cos q + k

with the efforts :math:`\tau_{rb}` of the rigid bodies where they are known; then m is what they
lack, the rotor behind its gear, and there is no other gravity. The delay d is linear only close
by: it is found on a coarse grid, then by Gauss and Newton's method, as one more column,
:math:`\dot\tau`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.arrays import Numbers
from hpid_ros.identification.motion import Motion, joined
from hpid_ros.identification.regression import Regression, regress
from hpid_ros.identification.results import (
    COULOMB,
    DELAY,
    EFFORT_SCALE,
    GRAVITY_COS,
    GRAVITY_SIN,
    INERTIA,
    OFFSET,
    SPIN,
    STRIBECK,
    VISCOUS,
)

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
    # [rad/s] returns the smoothed column of Stribeck friction, (R,), for its speed
    stribeck: Callable[[float], Numbers]
    spin: Numbers | None = None  # effort that rotors need beside their inertia, (R,)

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

    has_coulomb: bool = True  # it knows both directions
    has_gravity: bool = False  # sine and cosine of the position
    has_delay: bool = True  # what is left of the delay is sought, too
    has_scale: bool = False  # the rigid bodies' effort has a coefficient
    stribeck_speed: float = 0.0  # [rad/s] zero for none
    has_spin: bool = False  # the effort that rotors need beside their inertia has a coefficient


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
        """Tell whether a delay is none of the ends between which it is looked for."""
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
        """Tell whether the reference is the source of a model's instruments."""
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

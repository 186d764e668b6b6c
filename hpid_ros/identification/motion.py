"""Smoothed motion: position, velocity and acceleration at evenly spaced rows of a recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.identification.kernel import DERIVATIVES, Kernel
from hpid_ros.identification.records import Halves

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
        begin = 2 * reach + math.ceil(
            margin / length - _ROUNDING
        )  # a sign is smoothed of smoothed velocities
        stride = max(1, round(1.0 / (_ROWS_PER_PERIOD * kernel.cutoff * length)))
        room = len(cells.even) - 2 * begin
        if room < 1:
            return None
        return cls(cells.first, length, begin, stride, (room - 1) // stride + 1, reach)

    @property
    def times(self) -> Numbers:
        """When the rows are, (R,), in [s]."""
        return np.asarray(
            self.first + self.length * (self.begin + self.stride * np.arange(self.rows))
        )

    @property
    def offsets(self) -> Numbers:
        """When the cells are that have weight for a row, after it, in [s]."""
        return np.asarray(self.length * np.arange(-self.reach, self.reach + 1.0))

    def smoothed(self, cells: Numbers, kernel: Kernel, order: int = 0) -> Numbers:
        """Return a smoothed derivative at the rows."""
        return _convolved(cells, kernel, order, self, self.begin, self.stride, self.rows)

    def fine(self, cells: Numbers, kernel: Kernel, order: int) -> Numbers:
        """Return a smoothed derivative at every cell, its ends' as those nearest to them."""
        inner = _convolved(cells, kernel, order, self, self.reach, 1, len(cells) - 2 * self.reach)
        return np.pad(inner, self.reach, mode="edge")

    def edges(self, cells: int) -> Numbers:
        """Return the edges of the cells, (cells + 1,), in [s]."""
        return np.asarray(self.first + self.length * (np.arange(cells + 1) - 0.5))


def _convolved(
    cells: Numbers,
    kernel: Kernel,
    order: int,
    grid: Grid,
    begin: int,
    stride: int,
    rows: int,
) -> Numbers:
    taps = kernel.taps(grid.offsets, grid.length, order)
    needed = cells[begin - grid.reach : begin + grid.reach + stride * (rows - 1) + 1]
    return np.asarray(np.correlate(needed, taps, "valid")[::stride])


class Motion(NamedTuple):
    """A joint's motion at R rows, from either half of its samples."""

    # [rad] positions, velocities and accelerations, (2, 3, R), [rad/s] and [rad/s^2]
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

"""One joint's recorded positions and efforts, in spans without a gap, smoothed.

Weak form: an equation of motion is multiplied by a kernel :math:`g(t - s)` and integrated over s;
integration by parts moves every derivative from the position to the kernel, which is known
exactly (Shinbrot, "On the analysis of linear and nonlinear systems", Trans. ASME 79, 1957). All
columns of the equation and its effort pass the same kernel: no phase comes between them, and
where they are linear in the position its shape cancels out. It ends after a few periods of
its cut-off frequency, so that a gap in a recording costs just the time around it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly, make_interp_spline

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import Numbers

_HALF_WIDTH = 2.0  # periods of the cut-off frequency
_POWER = 4  # of the window (1 - x^2): its spectrum falls with the fifth power
_DEGREE = 7
_NODES = 801
_MOMENTS = 4
DERIVATIVES = (0, 1, 2)


class Kernel:
    """A symmetric low pass of compact support, and its first two derivatives."""

    def __init__(self, cutoff: float) -> None:
        self.cutoff = cutoff
        self.half_width = _HALF_WIDTH / cutoff
        at = np.linspace(-1.0, 1.0, _NODES)
        shape = np.sinc(2.0 * _HALF_WIDTH * at) * (1.0 - at**2) ** _POWER
        spline = make_interp_spline(at, shape, k=_DEGREE)
        area = float(spline.integrate(-1.0, 1.0))
        scale = self.half_width
        self._of = [
            (spline.derivative(order) if order else spline, 1.0 / (area * scale ** (order + 1)))
            for order in DERIVATIVES
        ]
        powers = [make_interp_spline(at, shape * at**p, k=_DEGREE) for p in range(_MOMENTS)]
        self._moments = [
            float(each.integrate(-1.0, 1.0)) / area * scale**p for p, each in enumerate(powers)
        ]

    def taps(self, reach: int, spacing: float, order: int) -> Numbers:
        """Return the weights of samples to either side of one that give a smoothed derivative.

        The moments of these sums are those of the integrals, so that a constant has no
        derivative, whatever the sampling.
        """
        spline, factor = self._of[order]
        sign = -1.0 if order % 2 else 1.0
        scaled = spacing * np.arange(-reach, reach + 1.0) / self.half_width
        taps = sign * factor * spacing * spline(scaled)
        rows = np.vander(scaled, _MOMENTS, increasing=True).T
        wanted = np.zeros(_MOMENTS)
        for power in range(order, _MOMENTS):
            descent = math.factorial(power) / math.factorial(power - order)
            wanted[power] = descent * self._moments[power - order] / self.half_width**power
        missing = wanted - rows @ taps
        weights = (1.0 - np.minimum(scaled**2, 1.0)) ** _POWER
        correction: Numbers = weights * (
            rows.T @ np.linalg.solve((rows * weights) @ rows.T, missing)
        )
        return np.asarray(taps + correction, dtype=np.float64)


_CLOSEST = 0.25  # periods: what comes sooner after a sample is not another one
_GAP = 3.5  # periods
_ROUNDING = 1e-6  # cells: what stamps in floating point may be off
_LEAST_SAMPLES = 16  # of a span


@dataclass(frozen=True, eq=False)
class JointRecord:
    """What is known of one joint."""

    joint: str  # its name
    time: Numbers  # [s] of the positions, strictly increasing, (N,)
    position: Numbers  # [rad] where it was, (N,); in [m] where it slides
    # [s] when its efforts were commanded or measured, strictly increasing, (M,)
    effort_time: Numbers
    effort: Numbers  # [N m] the efforts, (M,); [N] where it slides
    reference: Numbers = field(default_factory=lambda: np.empty(0))
    is_held: bool = True  # each effort acts until the next one comes, as a command does

    def __post_init__(self) -> None:
        for times, values in (("time", "position"), ("effort_time", "effort")):
            when, what = getattr(self, times), getattr(self, values)
            if when.ndim != 1 or when.shape != what.shape:
                raise SettingError(
                    f"joint {self.joint!r}: {values} has shape {what.shape}, but its times have "
                    f"{when.shape}"
                )
            if not (np.isfinite(when).all() and np.isfinite(what).all()):
                raise SettingError(f"joint {self.joint!r}: {times} and {values} must be finite")
            if np.any(np.diff(when) <= 0.0):
                raise SettingError(f"joint {self.joint!r}: {times} must increase strictly")
        if self.reference.shape not in ((0,), self.position.shape):
            raise SettingError(
                f"joint {self.joint!r}: reference has shape {self.reference.shape}, but its times "
                f"have {self.time.shape}"
            )

    @property
    def period(self) -> float:
        """Median time between two positions, in [s]; zero for fewer than two."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    @property
    def travel(self) -> float:
        """How far it moved between its ends, in [rad]."""
        return float(np.ptp(self.position)) if len(self.position) else 0.0

    def impulse(self, limit: float = math.inf) -> PPoly:
        """Return the integral of the effort over time, in [N m s], of no more than a limit."""
        when, what = self.effort_time, self.effort.clip(-limit, limit)
        if self.is_held:
            steps = what[None, :-1]
        else:
            steps = np.stack([np.diff(what) / np.diff(when), what[:-1]])
        return PPoly(steps, when).antiderivative()


class Span(NamedTuple):
    """A time without a gap."""

    begin: float  # [s]
    end: float  # [s]


def spans(records: Sequence[JointRecord], own: JointRecord) -> list[Span]:
    """Return the times in which every joint has positions and one has efforts, in order."""
    common = _without_gaps(own.effort_time)
    seen: list[Numbers] = []
    for record in records:
        if not any(np.array_equal(record.time, times) for times in seen):
            seen.append(record.time)
            common = _overlaps(common, _without_gaps(record.time))
    return common


def _without_gaps(times: Numbers) -> list[Span]:
    if len(times) < 2:
        return []
    steps = np.diff(times)
    late = np.flatnonzero(steps > _GAP * np.median(steps))
    begins = times[np.concatenate([[0], late + 1])]
    ends = times[np.concatenate([late, [len(times) - 1]])]
    return [Span(float(a), float(b)) for a, b in zip(begins, ends, strict=True) if b > a]


def _overlaps(ones: Sequence[Span], others: Sequence[Span]) -> list[Span]:
    found, first = [], 0
    for one in ones:  # both are in order; hours with many gaps have too many pairs to try
        while first < len(others) and others[first].end <= one.begin:
            first += 1
        place = first
        while place < len(others) and others[place].begin < one.end:
            other = others[place]
            found.append(Span(max(one.begin, other.begin), min(one.end, other.end)))
            place += 1
    return found


class Halves(NamedTuple):
    """A joint's positions within a span, as two sets of means over cells of one length.

    The one is of every second sample, the other of those between: the same motion, each with
    noise of its own.
    """

    means: Numbers  # [rad] of the position over the cells, (2, K)
    reference: Numbers  # likewise, of the reference; empty where nobody knows it
    first: float  # [s] middle of the first cell
    length: float  # [s] of a cell


def halves(record: JointRecord, span: Span, period: float) -> Halves | None:
    """Return a joint's positions within a span; None where there are too few."""
    inside = slice(
        int(np.searchsorted(record.time, span.begin)),
        int(np.searchsorted(record.time, span.end, "right")),
    )
    time, position = _apart(record.time[inside], record.position[inside], _CLOSEST * period)
    length = 2.0 * period
    begin = span.begin + length  # both halves reach as far
    count = int((span.end - begin) / length - 1.0 + _ROUNDING)
    if len(time) < _LEAST_SAMPLES or count < 1:
        return None
    edges = begin + length * np.arange(count + 1)
    means = []
    for part in (slice(0, None, 2), slice(1, None, 2)):
        integral = CubicSpline(time[part], position[part] - position[0]).antiderivative()
        means.append(np.diff(integral(edges)) / length + position[0])
    reference = np.empty(0)
    if len(record.reference):
        aim = record.reference[inside]
        steps = np.stack([np.diff(aim) / np.diff(record.time[inside]), aim[:-1]])
        integral = PPoly(steps, record.time[inside]).antiderivative()
        reference = np.diff(integral(edges)) / length
    return Halves(np.array(means), reference, float(edges[0] + period), length)


def _apart(time: Numbers, values: Numbers, least: float) -> tuple[Numbers, Numbers]:
    """Leave out samples that come too soon after the one before."""
    if len(time) < 2 or np.diff(time).min() >= least:
        return time, values
    kept, last = [], -np.inf
    for k, each in enumerate(time):
        if each - last >= least:
            kept.append(k)
            last = float(each)
    return time[kept], values[kept]


_ROWS_PER_PERIOD = 4  # of the kernel's cut-off frequency
_LAGS = (0, 1, 2, 3, 4, 6, 8, 11, 15, 20)
"""Of reference and friction, in quarters of the cut-off's period: how a loop answers, in few
numbers."""
_SLOW_NOISE = 5.0  # standard deviations of the velocity's noise
_SLOW_SHARE = 0.2  # of its root mean square
_PADDING = 40  # rows between two spans, as if nothing had been recorded there


class SmoothingGrid(NamedTuple):
    """Cells of one length and the rows among them."""

    first: float  # [s] middle of the first cell
    length: float  # [s] of a cell
    begin: int  # the cell in whose middle the first row is
    stride: int  # cells from one row to the next
    rows: int  # how many rows there are
    reach: int  # cells to either side of a row that have weight

    @classmethod
    def over(cls, cells: Halves, kernel: Kernel, margin: float) -> SmoothingGrid | None:
        """Return the rows whose columns are known; None where there is no room for any."""
        length = cells.length
        reach = math.floor(kernel.half_width / length + _ROUNDING)
        # Twice: a sign is smoothed of smoothed velocities.
        begin = 2 * reach + math.ceil(margin / length - _ROUNDING)
        stride = max(1, round(1.0 / (_ROWS_PER_PERIOD * kernel.cutoff * length)))
        room = cells.means.shape[1] - 2 * begin
        if room < 1:
            return None
        return cls(cells.first, length, begin, stride, (room - 1) // stride + 1, reach)

    @property
    def times(self) -> Numbers:
        """When the rows are, (R,), in [s]."""
        cells = self.begin + self.stride * np.arange(self.rows)
        return np.asarray(self.first + self.length * cells)

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
        taps = kernel.taps(self.reach, self.length, order)
        needed = cells[begin - self.reach : begin + self.reach + stride * (rows - 1) + 1]
        return np.asarray(np.correlate(needed, taps, "valid")[::stride])


class Rows:
    """What records say at the rows of one joint's spans, which stand behind each other.

    Between two spans are rows of zeros.
    """

    def __init__(
        self, records: Sequence[JointRecord], place: int, kernel: Kernel, longest_delay: float
    ) -> None:
        self.record, self.place = records[place], place
        self.kernel, self.longest_delay = kernel, longest_delay
        self._spans: list[tuple[SmoothingGrid, list[Halves]]] = []
        for span in spans(records, self.record):
            parts = [halves(each, span, self.record.period) for each in records]
            cells = [each for each in parts if each is not None]
            if len(cells) == len(parts):
                grid = SmoothingGrid.over(cells[0], kernel, longest_delay)
                if grid is not None:
                    self._spans.append((grid, cells))
        self.count = sum(grid.rows for grid, _ in self._spans)

    @cached_property
    def parts(self) -> list[Numbers]:
        """Positions [rad], velocities, accelerations of K joints, by half, (2, 3, K, R) a span."""
        return [
            np.array(
                [
                    [
                        [grid.smoothed(each.means[half], self.kernel, order) for each in cells]
                        for order in DERIVATIVES
                    ]
                    for half in (0, 1)
                ]
            )
            for grid, cells in self._spans
        ]

    @cached_property
    def motion(self) -> Numbers:
        """The parts, joined."""
        return _joined(self.parts)

    @cached_property
    def times(self) -> Numbers:
        """When the rows are, (R,), in [s]; 0 between two spans."""
        return _joined([grid.times for grid, _ in self._spans])

    def effort(self, delay: float, limit: float) -> Numbers:
        """Return the smoothed effort and two derivatives, (3, R), if it acts with a delay."""
        impulse = self.record.impulse(limit)
        parts = []
        for grid, cells in self._spans:
            edges = grid.edges(cells[0].means.shape[1])
            means = np.diff(impulse(edges - delay)) / grid.length
            parts.append(
                np.stack([grid.smoothed(means, self.kernel, order) for order in DERIVATIVES])
            )
        return _joined(parts)

    @cached_property
    def _velocities(self) -> list[tuple[SmoothingGrid, Halves, Numbers, NDArray[np.bool_]]]:
        """Of each span the joint's velocity at every cell, and where its direction is in doubt."""
        found = []
        for grid, cells in self._spans:
            own = cells[self.place]
            one, other = (grid.fine(half, self.kernel, 1) for half in own.means)
            velocity = (one + other) / 2.0
            noise = float((one - other).std()) / 2.0
            least = max(_SLOW_NOISE * noise, _SLOW_SHARE * float(np.sqrt(np.mean(velocity**2))))
            found.append((grid, own, velocity, np.abs(velocity) < least))
        return found

    def smoothed(self, function: Callable[[Numbers], Numbers]) -> Numbers:
        """Return a function of the joint's velocity, smoothed, (R,)."""
        return _joined(
            [grid.smoothed(function(each), self.kernel) for grid, _, each, _ in self._velocities]
        )

    def doubt(self) -> Numbers:
        """Return which share of a row's weight lies where the direction is in doubt, (R,)."""
        known = []
        for grid, _, _, is_slow in self._velocities:
            weights = np.abs(self.kernel.taps(grid.reach, grid.length, 0))
            slow = np.convolve(is_slow, weights / weights.sum(), "same")
            known.append(1.0 - slow[grid.begin + grid.stride * np.arange(grid.rows)])
        return 1.0 - _joined(known)

    def reference(self) -> Numbers:
        """Return what the reference and friction did, (B, R); B is 0 without a reference."""
        return _joined([self._answers(*each) for each in self._velocities])

    def _answers(
        self, grid: SmoothingGrid, own: Halves, velocity: Numbers, is_slow: NDArray[np.bool_]
    ) -> Numbers:
        if not len(own.reference):
            return np.empty((0, grid.rows))
        direction = np.where(is_slow, 0.0, np.sign(velocity))
        found = []
        for lag in _LAGS:
            shift = round(lag / (_ROWS_PER_PERIOD * self.kernel.cutoff) / grid.length)
            for source, orders in ((own.reference, (1, 2)), (direction, (0,))):
                late = np.concatenate([np.full(shift, source[0]), source[: len(source) - shift]])
                found += [grid.smoothed(late, self.kernel, order) for order in orders]
        return np.array(found)


def _joined(parts: Sequence[Numbers]) -> Numbers:
    """Return the rows of several spans behind each other, with rows of zeros between them."""
    gap = np.zeros((*parts[0].shape[:-1], _PADDING))
    pieces = [piece for part in parts for piece in (part, gap)]
    return np.concatenate(pieces[:-1], axis=-1)

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
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
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

    def taps(self, offsets: Numbers, spacing: float, order: int) -> Numbers:
        """Return the weights of evenly spaced samples that give a smoothed derivative at 0.

        The moments of these sums are those of the integrals, so that a constant has no
        derivative, whatever the sampling.
        """
        spline, factor = self._of[order]
        sign = -1.0 if order % 2 else 1.0
        taps = sign * factor * spacing * spline(offsets / self.half_width)
        scaled = offsets / self.half_width
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

    def impulse(self) -> PPoly:
        """Return the integral of the effort over time, in [N m s]."""
        when, what = self.effort_time, self.effort
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
    found = []
    for one in ones:
        for other in others:
            begin, end = max(one.begin, other.begin), min(one.end, other.end)
            if begin < end:
                found.append(Span(begin, end))
    return found


class Halves(NamedTuple):
    """A joint's positions within a span, as two sets of means over cells of one length.

    The one is of every second sample, the other of those between: the same motion, each with
    noise of its own.
    """

    even: Numbers  # [rad] means of the position over the cells, (K,)
    odd: Numbers  # likewise, of the other samples, over the same cells
    reference: Numbers  # likewise, of the reference; empty where nobody knows it
    first: float  # [s] middle of the first cell
    length: float  # [s] of a cell

    @property
    def middles(self) -> Numbers:
        """Middles of the cells, (K,), in [s]."""
        return np.asarray(self.first + self.length * np.arange(len(self.even)))


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
    return Halves(means[0], means[1], reference, float(edges[0] + period), length)


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

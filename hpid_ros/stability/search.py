"""The search for certificates: outward from degree zero, a P for each span of degrees.

What the search accepts was seen on a fine grid; :mod:`hpid_ros.stability.check`
proves the same statement again on another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import GainError, NormError
from hpid_ros.control.gains import Gains
from hpid_ros.stability.certificate import CertifiedSpan
from hpid_ros.stability.closed_loop import Norm, effective_gains, require_known_norm
from hpid_ros.stability.quadratic_forms import (
    first_shapes,
    improved,
    scaled_loop,
    worst_rate,
    worst_rates,
)
from hpid_ros.stability.sphere_grid import SphereGrid, time_unit

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
        self,
        gains: Gains,
        inertia: float,
        norm_of_degree: NormOfDegree,
        first_degree: float = 0.0,
    ) -> None:
        self._inertia = inertia
        self._effective = effective_gains(gains, inertia)
        self._norm_of_degree = norm_of_degree
        slowest = -np.linalg.eigvals(scaled_loop(self._effective)).real.max()
        self._margin = min(_MARGIN, _MARGIN_OF_SLOW_LOOP * float(slowest))
        self._seen: dict[tuple[float, bytes], float] = {}
        self._first_shapes = first_shapes(self._effective, self.norm(first_degree))

    def norm(self, degree: float) -> Norm:
        """Return the law's norm at a degree."""
        norm = self._norm_of_degree(degree)
        require_known_norm(norm)
        if norm.degree != degree:
            raise NormError(
                f"norm_of_degree must give a norm of the degree it is asked for: "
                f"asked {degree}, got {norm!r}"
            )
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
            shape=tuple(tuple(float(x) for x in row) for row in physical),
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
        units: Numbers = np.multiply.outer(scales, scales)
        return units

    def _in_units(self, span: CertifiedSpan) -> Numbers:
        shape: Numbers = np.array(span.shape) * self._units()
        return shape

    def _grids(self, degrees: tuple[float, ...], size: tuple[int, int]) -> list[SphereGrid]:
        return [SphereGrid(self._effective, self.norm(degree), *size) for degree in degrees]

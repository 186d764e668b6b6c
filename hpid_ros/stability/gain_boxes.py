"""Ranges of gains within which one P certifies a loop: what may be retuned without another search.

For one P and one norm, x'P f(x) is linear in each gain and in one over the inertia: what is
negative at the corners of a box of them is negative within it. A norm in units of effort changes
with the gains: it is looked at for its largest, its least and its present weight of the rate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import GainError
from hpid_ros.base.processes import side_by_side
from hpid_ros.base.units import Numbers
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.settings import LoopSettings
from hpid_ros.stability.certificate_search import SphereGrid, improved, time_unit, worst_rate
from hpid_ros.stability.certification import check_certificate
from hpid_ros.stability.closed_loop import (
    Certificate,
    CertifiedSpan,
    as_matrix,
    effective_gains,
)
from hpid_ros.stability.gain_check import Loop, certified_degrees, kind_of, physical_units

_FACTORS = (1.0, 1.1, 1.25, 1.5)
_BEYOND = 0.1  # degrees beyond 0 and the loop's own
_COARSE = (12, 24)  # points along and inward
_ENOUGH = -3e-3  # of the rate in units of ki^(1/3), where a search ends


class GainBox(NamedTuple):
    """Gains and degrees that one P certifies."""

    degrees: tuple[float, float]
    p: tuple[float, float]  # [N m/rad]
    i: tuple[float, float]  # [N m/(rad s)]
    d: tuple[float, float]  # [N m s/rad]
    rate_time: tuple[float, float]  # [s] weight of the rate times error_scale, in the norm
    corners: tuple[Certificate, ...]  # the proof

    def contains(self, degree: float) -> bool:
        return self.degrees[0] <= degree <= self.degrees[1]


class GainRange(NamedTuple):
    """What a joint's loop may be retuned to."""

    settings: LoopSettings
    inertia: tuple[float, float]  # [kg m^2]
    boxes: tuple[GainBox, ...]  # by their degrees

    def contains(self, degree: float) -> bool:
        """Return whether the loop's own gains are certified at a degree."""
        return any(each.contains(degree) for each in self.boxes)

    def __str__(self) -> str:
        """Return for people what it allows."""
        if not self.boxes:
            return "mu = 0 only: any gains with p d > i x inertia"
        lower, upper = self.boxes[0].degrees[0], self.boxes[-1].degrees[1]
        here = [each for each in self.boxes if each.contains(self.settings.degree)]
        most = max((each.p[1] / self.settings.gains.p for each in here), default=1.0)
        gains = f"each gain by 1/{most:g} to {most:g}" if most > 1.0 else "none of the gains"
        return f"mu {lower:+.3f} to {upper:+.3f}; at its own {gains}"


_Task = tuple[LoopSettings, tuple[float, float], CertifiedSpan]  # of a loop, for all of its kind
_Found = tuple[float, Numbers]  # how much smaller and larger the gains may be, and P


def gain_ranges(
    loops: Sequence[Loop], progress: Callable[[Sequence[str]], None] = lambda joints: None
) -> list[GainRange]:
    """Certify loops with the gains around theirs, side by side on the machine's cores.

    A loop that is not certified as it is is refused (``GainError``).
    """
    intervals = certified_degrees(loops)
    keys = [_key(*loop, interval) for loop, interval in zip(loops, intervals, strict=True)]
    first: dict[Hashable, int] = {}
    for place, key in enumerate(keys):
        first.setdefault(key, place)
    tasks: list[tuple[Hashable, _Task]] = [
        (key, (*loops[place], span))
        for key, place in first.items()
        for span in _spans(loops[place][0], intervals[place])
    ]
    boxes: dict[Hashable, list[tuple[CertifiedSpan, _Found]]] = {key: [] for key in first}
    left = Counter(key for key, _ in tasks)
    for number, found in side_by_side(_box, [task for _, task in tasks]):
        key, task = tasks[number]
        boxes[key] += [] if found is None else [(task[-1], found)]
        left[key] -= 1
        if not left[key]:
            progress([loop[0].joint for loop, own in zip(loops, keys, strict=True) if own == key])
    return [
        _range(loop, interval, loops[first[key]], boxes[key])
        for loop, interval, key in zip(loops, intervals, keys, strict=True)
    ]


def _key(
    settings: LoopSettings, inertia: tuple[float, float], interval: Certificate | GainError
) -> Hashable:
    """Return what loops have in common whose boxes differ by units alone."""
    if isinstance(interval, GainError):
        return settings.joint
    return kind_of(settings, inertia), settings.degree, settings.norm.effort_scale > 0.0


def _spans(settings: LoopSettings, interval: Certificate | GainError) -> list[CertifiedSpan]:
    """Return the spans between the linear law and the loop's own, and some beyond."""
    if isinstance(interval, GainError):
        return []
    lower = min(0.0, settings.degree) - _BEYOND
    upper = max(0.0, settings.degree) + _BEYOND
    spans = {(each.lower, each.upper): each for each in interval.spans}
    return [spans[ends] for ends in sorted(spans) if ends[0] < upper and lower < ends[1]]


def _range(
    loop: Loop,
    interval: Certificate | GainError,
    like: Loop,
    found: Sequence[tuple[CertifiedSpan, _Found]],
) -> GainRange:
    """Return a loop's boxes from those of a loop of its kind."""
    settings, inertia = loop
    gains = settings.gains
    where = f"for an inertia of {inertia[0]:g} to {inertia[1]:g} kg m^2"
    if not gains.p * gains.d > gains.i * inertia[1]:
        raise GainError(f"{settings.joint} is not certified {where}: {interval}")
    to_own = physical_units(*loop) / physical_units(*like)
    family = settings.norm_family
    # In units of effort as the plugin computes it, to the last bit.
    is_of_effort = settings.norm.effort_scale > 0.0
    time = gains.d / gains.p if is_of_effort else family.rate_weight * family.error_scale
    boxes = []
    for span, (factor, shape) in sorted(found, key=lambda each: each[0].lower):
        norms = tuple(family(norm.degree) for norm in span.norms)
        own = replace(
            span, norms=norms, shape=as_matrix(shape / np.multiply.outer(to_own, to_own))
        )
        p, i, d = ((gain / factor, gain * factor) for gain in (gains.p, gains.i, gains.d))
        widest = _widest(settings, factor)
        rate_time = time / widest, time * widest
        corners = tuple(_corners(settings, inertia, own, factor))
        boxes.append(GainBox((own.lower, own.upper), p, i, d, rate_time, corners))
    ranges = GainRange(settings, inertia, tuple(boxes))
    if settings.degree != 0.0 and not ranges.contains(settings.degree):
        reason = interval if isinstance(interval, GainError) else "no P holds for all of it"
        at = f"at mu = {settings.degree:g} {where}"
        raise GainError(f"{settings.joint} is not certified {at}: {reason}")
    return ranges


def _box(task: _Task) -> _Found | None:
    """Return the largest box that is found: each from the P of the one before."""
    settings, inertia, span = task
    found = [(1.0, np.array(span.shape))]
    for factor in _FACTORS:
        shape = _shape(list(_corners(settings, inertia, span, factor)), found[-1][1])
        if shape is None:
            break
        found.append((factor, shape))
    for factor, shape in reversed(found):
        own = replace(span, shape=as_matrix(shape))
        try:
            for corner in _corners(settings, inertia, own, factor):
                check_certificate(corner)
        except GainError:
            continue
        return factor, shape
    return None


def _widest(settings: LoopSettings, factor: float) -> float:
    """Return by what the weight of the rate may change with the gains."""
    return factor**2 if settings.norm.effort_scale else 1.0


def _corners(
    settings: LoopSettings, inertia: tuple[float, float], span: CertifiedSpan, factor: float
) -> Iterator[Certificate]:
    gains, family = settings.gains, settings.norm_family
    widest = _widest(settings, factor)
    for signs in product(*[sorted({factor, 1.0 / factor})] * 3):
        corner = Gains(gains.p * signs[0], gains.i * signs[1], gains.d * signs[2])
        for weight in sorted({1.0 / widest, 1.0, widest}):
            own = replace(family, rate_weight=family.rate_weight * weight)
            norms = tuple(own(norm.degree) for norm in span.norms)
            for each in sorted({*inertia}):
                yield Certificate(corner, (replace(span, inertia=each, norms=norms),))


def _shape(corners: Sequence[Certificate], start: Numbers) -> Numbers | None:
    """Return a P that holds at all corners, on a coarse grid; None if none is found."""
    units = [time_unit(effective_gains(each.gains, each.spans[0].inertia)) for each in corners]
    unit = float(np.median(units))
    scale = np.multiply.outer(*[unit ** np.arange(3.0)] * 2)
    grids = [
        SphereGrid(effective_gains(each.gains, span.inertia), norm, *_COARSE, unit)
        for each in corners
        for span in each.spans
        for norm in (span.norms[0], span.norms[-1])
    ]
    shape = improved(grids, start * scale, enough=_ENOUGH)
    if not worst_rate(grids, shape) < 0.0:
        return None
    return np.asarray(0.5 * (shape + shape.T) / scale)

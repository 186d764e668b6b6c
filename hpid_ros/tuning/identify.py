"""Inertia, friction, gravity, load and delay of joints from their recorded motion and efforts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.tuning.joint_record import JointRecord, Kernel, Span, halves, spans
from hpid_ros.tuning.regression import (
    INERTIA,
    Equation,
    Grid,
    Model,
    Motion,
    Terms,
    joined,
    motion_of,
)
from hpid_ros.tuning.term_selection import JointIdentification, findings, nothing

_LEAST = 0.05  # of the largest command; less is no drive
_LEVELS = 25
_REFINED = 3  # times, each between the neighbours of the best
_BEYOND = 0.002  # of the commands at least
_LEAST_MISFIT = 1e-4  # of the effort's variance: below it a model is right as it is
_BETTER = 0.2  # of the misfit without a limit at most: ripple and gear losses gain a third


def saturation(record: JointRecord, equation: Callable[[float], Equation]) -> float:
    """Return the effort that acts of a larger command, in [N m]; infinite if none shows one."""
    sizes = np.abs(record.effort)
    largest = float(sizes.max(initial=0.0))
    if largest == 0.0:
        return math.inf
    plain = _misfit(equation(math.inf))
    if plain < _LEAST_MISFIT:
        return math.inf
    low, high, best, least = _LEAST * largest, largest, math.inf, plain
    for _ in range(_REFINED):
        levels = np.geomspace(low, high, _LEVELS)
        misfits = [_misfit(equation(float(each))) for each in levels]
        place = int(np.argmin(misfits))
        if misfits[place] >= least and best == math.inf:
            return math.inf
        best, least = float(levels[place]), misfits[place]
        low = float(levels[max(place - 1, 0)])
        high = float(levels[min(place + 1, _LEVELS - 1)])
    is_there = least < _BETTER * plain and float(np.mean(sizes > best)) >= _BEYOND
    return best if is_there else math.inf


def _misfit(equation: Equation) -> float:
    """Return the share of the effort's variance that an equation leaves unexplained."""
    is_free = equation.terms.rigid is None
    model = Model(has_gravity=is_free)
    fit, delay = equation.solve(model, equation.coarse_delay(model))
    effort = equation.effort(delay)[equation.weight > 0.0]
    return fit.rms**2 / max(float(np.var(effort)), 1e-300)


RigidBody = Callable[[Numbers, Numbers, Numbers], Numbers]
"""Efforts that rigid bodies need, (K, R), in [N m], for the positions, velocities and
accelerations of K joints at R rows, each (K, R); without rotors and friction."""
Spin = Callable[[Numbers, Numbers, Numbers, Numbers], Numbers]
"""Efforts that rotors need besides their reflected inertia, because they spin on links that move,
(K, R), in [N m]: for the same motion, and the reflected inertias of K rotors, (K,)."""

_CUTOFFS = (20.0, 16.0, 12.5, 10.0, 8.0, 6.3, 5.0, 4.0, 3.15, 2.5, 2.0, 1.6, 1.25, 1.0)
_HIGHEST = 0.1  # of the sampling frequency
_NOISE = 1e-3  # of the acceleration's variance
_PADDING = 40  # rows between two spans, as if nothing had been recorded there
_LEAST_ROWS = 40
_BIN = 1.0  # [s]
_BUSY = 0.1  # of what the joint in question travels
_TOGETHER = 0.1  # of the time in which it moves
_STILL = 0.02  # of the joint that moves most
_TOO_SLOW = "its direction is hardly ever known: it should move faster, or reverse less often"


@dataclass(frozen=True)
class Method:
    """How joints are identified."""

    cutoff: float | None = None  # [Hz] of the low pass; chosen by the noise of each joint if None
    longest_delay: float = 0.1  # [s] from effort to motion
    has_scale: bool = False

    def __post_init__(self) -> None:
        if self.cutoff is not None and not 0.0 < self.cutoff < math.inf:
            raise SettingError(f"cutoff must be above 0 Hz, not {self.cutoff:g}")
        if not 0.0 < self.longest_delay <= 1.0:
            raise SettingError(
                f"longest_delay must be above 0 and at most 1 s, not {self.longest_delay:g}"
            )


class _Rows(NamedTuple):
    """All rows of all spans, as seen through one kernel."""

    grids: list[Grid]
    cells: list[int]
    motions: list[list[Motion]]  # by joint, then span


def identify(
    records: Sequence[JointRecord],
    rigid_body: RigidBody | None = None,
    method: Method | None = None,
    wanted: Sequence[str] | None = None,
    spin: Spin | None = None,
) -> tuple[JointIdentification, ...]:
    """Identify joints.

    Without rigid bodies each joint is taken for itself: what it moves is what it would with the
    other joints at rest.
    """
    how = method or Method()
    moving = max((_travel(each) for each in records), default=0.0)
    places = [k for k, each in enumerate(records) if wanted is None or each.joint in wanted]
    if rigid_body is not None:
        prepared = {k: _prepared(records, k, rigid_body, how, moving) for k in places}
        found = {k: each.findings(how) for k, each in prepared.items()}
        if spin is not None:
            found |= _with_spin(spin, prepared, found, len(records), how)
        return tuple(found.values())
    alone = []
    for each in (records[k] for k in places):
        own = _prepared([each], 0, None, how, moving, _others_turn(each, records))
        alone.append(replace(own.findings(how), remarks=_company(each, records)))
    return tuple(alone)


class _Prepared(NamedTuple):
    """A joint's equation, or why there is none."""

    record: JointRecord
    reason: str
    rows: _Rows = _Rows([], [], [])
    times: Numbers = np.empty(0)
    equation: Equation | None = None
    limit: float = math.inf

    def findings(self, how: Method) -> JointIdentification:
        if self.equation is None:
            return nothing(self.record, self.reason)
        found = findings(self.record, self.equation, self.times, how.has_scale)
        return replace(found, effort_limit=self.limit)


def _with_spin(
    spin: Spin,
    prepared: Mapping[int, _Prepared],
    found: Mapping[int, JointIdentification],
    count: int,
    how: Method,
) -> dict[int, JointIdentification]:
    """Identify joints once more where rotors that are known now may pull at them."""
    rotors = np.zeros(count)
    for place, each in found.items():
        estimate = each.reliable(INERTIA)
        rotors[place] = estimate.value if estimate is not None else 0.0
    again = {}
    for place, own in prepared.items():
        if own.equation is None or not rotors.any():
            continue
        means = [
            np.stack([joint[span].mean for joint in own.rows.motions], axis=1)
            for span in range(len(own.rows.grids))
        ]
        efforts = joined([spin(q, v, a, rotors)[place] for q, v, a in means], _PADDING)
        if efforts.any():
            own.equation.terms = own.equation.terms._replace(spin=efforts)
            again[place] = own.findings(how)
    return again


def _company(own: JointRecord, records: Sequence[JointRecord]) -> tuple[str, ...]:
    """Return who moves while a joint does, whose coupling nobody knows."""
    if len(own.time) < 2:
        return ()
    edges = _bins(own)
    busy = _is_busy(own, edges, _travel(own))
    if not busy.any():
        return ()
    names = [
        each.joint
        for each in records
        if each is not own and np.mean(_is_busy(each, edges, _travel(own))[busy]) > _TOGETHER
    ]
    if not names:
        return ()
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return (
        f"{shown} moved at the same time: what they need and what couples them is in these "
        "numbers, for whose intervals nothing stands; give the robot, or move one joint at a time",
    )


def _others_turn(own: JointRecord, records: Sequence[JointRecord]) -> list[Span]:
    """Return when others move and a joint does not, which tells of it no more than their pull."""
    if len(own.time) < 2:
        return []
    edges = _bins(own)
    is_theirs = np.zeros(len(edges), dtype=np.bool_)
    for each in records:
        is_theirs |= _is_busy(each, edges, _travel(each))
    is_theirs &= ~_is_busy(own, edges, _travel(own))
    return [Span(float(at), float(at) + _BIN) for at in edges[is_theirs]]


def _bins(record: JointRecord) -> Numbers:
    """Return when the pieces of time begin in which a joint has samples, in [s].

    Of a clock that was set there may be years without any.
    """
    since = record.time - record.time[0]
    return np.asarray(record.time[0] + _BIN * np.unique(np.floor(since / _BIN)))


def _is_busy(record: JointRecord, edges: Numbers, travel: float) -> NDArray[np.bool_]:
    """Tell for each piece of time whether a joint moves by a part of a travel."""
    if len(record.time) < 2:
        return np.zeros(len(edges), dtype=np.bool_)
    begins, ends = (np.searchsorted(record.time, each) for each in (edges, edges + _BIN))
    pieces = [record.position[a:b] for a, b in zip(begins, ends, strict=True)]
    moved = np.array([float(np.ptp(each)) if len(each) else 0.0 for each in pieces])
    return np.asarray(moved > _BUSY * travel)


def _travel(record: JointRecord) -> float:
    return float(np.ptp(record.position)) if len(record.position) else 0.0


def _prepared(
    records: Sequence[JointRecord],
    place: int,
    rigid_body: RigidBody | None,
    how: Method,
    moving: float,
    left_out: Sequence[Span] = (),
) -> _Prepared:
    own = records[place]
    reason = _why_not(own, moving)
    if reason:
        return _Prepared(own, reason)
    if how.cutoff is not None:
        kernel = Kernel(min(how.cutoff, _HIGHEST / own.period))
    else:
        kernel = _chosen_kernel(own, how)
    rows = _rows(records, own, kernel, how)
    if sum(grid.rows for grid in rows.grids) < _LEAST_ROWS:
        return _Prepared(own, _too_short(own, kernel))
    rigid = None if rigid_body is None else _rigid(rows, rigid_body, place)
    static = None if rigid_body is None else _static(rows, rigid_body, place)
    times = joined([grid.times for grid in rows.grids], _PADDING)
    terms = Terms.of(
        rows.motions[place], rigid, static, lambda of: _smoothed(rows, kernel, place, of), _PADDING
    )
    terms = terms.without([(times >= each.begin) & (times < each.end) for each in left_out])

    def equation(limit: float) -> Equation:
        acting = own if limit == math.inf else replace(own, effort=own.effort.clip(-limit, limit))
        return Equation(
            terms,
            lambda delay: _effort(acting, rows, kernel, delay),
            period=own.period,
            cutoff=kernel.cutoff,
            longest_delay=how.longest_delay,
        )

    if equation(math.inf).used_rows < _LEAST_ROWS:
        return _Prepared(own, _TOO_SLOW)
    limit = saturation(own, equation) if own.is_held else math.inf
    return _Prepared(own, "", rows, times, equation(limit), limit)


def _why_not(record: JointRecord, moving: float) -> str:
    if len(record.time) < 2 or len(record.effort_time) < 2:
        return "there are no positions, or no efforts, to look at"
    travel = _travel(record)
    if travel == 0.0 or travel < _STILL * moving:
        return f"it did not move (by {travel:.2g}): it needs a motion of its own"
    if not np.any(record.effort):
        return "its efforts are zero throughout"
    return ""


def _too_short(record: JointRecord, kernel: Kernel) -> str:
    return (
        f"no stretch without a gap is longer than {6.0 * kernel.half_width:.2g} s, which a low "
        f"pass of {kernel.cutoff:g} Hz needs at samples every {record.period:.2g} s"
    )


def _chosen_kernel(record: JointRecord, how: Method) -> Kernel:
    """Return the highest cut-off at which noise is a small part of the acceleration."""
    best: tuple[float, Kernel] | None = None
    for cutoff in _CUTOFFS:
        if cutoff > _HIGHEST / record.period and cutoff > _CUTOFFS[-1]:
            continue
        kernel = Kernel(min(cutoff, _HIGHEST / record.period))
        rows = _rows([record], record, kernel, how)
        if not rows.grids:
            continue
        motions = rows.motions[0]
        acceleration = np.concatenate([each.mean[2] for each in motions])
        noise = math.sqrt(np.mean([each.noise[2] ** 2 for each in motions]))
        share = noise**2 / max(float(np.var(acceleration)), 1e-300)
        if best is None or share < best[0]:
            best = share, kernel
        if share <= _NOISE:
            return kernel
    return best[1] if best is not None else Kernel(min(_CUTOFFS[0], _HIGHEST / record.period))


def _rows(records: Sequence[JointRecord], own: JointRecord, kernel: Kernel, how: Method) -> _Rows:
    grids: list[Grid] = []
    counts: list[int] = []
    motions: list[list[Motion]] = [[] for _ in records]
    for span in spans(records, own):
        parts = [halves(each, span, own.period) for each in records]
        cells = [each for each in parts if each is not None]
        if len(cells) < len(parts):
            continue
        grid = Grid.over(cells[0], kernel, how.longest_delay)
        if grid is None:
            continue
        grids.append(grid)
        counts.append(len(cells[0].even))
        for joint, each in zip(motions, cells, strict=True):
            joint.append(motion_of(each, grid, kernel))
    return _Rows(grids, counts, motions)


def _rigid(rows: _Rows, rigid_body: RigidBody, place: int) -> list[Numbers]:
    """Return what rigid bodies need of one joint, of either half, for each span, (2, R)."""
    found = []
    for span in range(len(rows.grids)):
        both = [
            rigid_body(*np.stack([joint[span].halves[half] for joint in rows.motions], axis=1))
            for half in (0, 1)
        ]
        found.append(np.stack([each[place] for each in both]))
    return found


def _static(rows: _Rows, rigid_body: RigidBody, place: int) -> list[Numbers]:
    """Return what rigid bodies need of one joint at rest, for each span, (R,)."""
    found = []
    for span in range(len(rows.grids)):
        position = np.stack([joint[span].mean[0] for joint in rows.motions])
        rest = np.zeros_like(position)
        found.append(rigid_body(position, rest, rest)[place])
    return found


def _smoothed(
    rows: _Rows, kernel: Kernel, place: int, of: Callable[[Numbers], Numbers]
) -> Numbers:
    """Return a function of a joint's velocity, smoothed at the rows, (R,)."""
    each = zip(rows.grids, rows.motions[place], strict=True)
    return joined([grid.smoothed(of(motion.velocity), kernel) for grid, motion in each], _PADDING)


def _effort(record: JointRecord, rows: _Rows, kernel: Kernel, delay: float) -> Numbers:
    """Return the smoothed effort and its rate at the rows, (2, R), if it acts with a delay."""
    impulse = record.impulse()
    parts = []
    for grid, count in zip(rows.grids, rows.cells, strict=True):
        means = np.diff(impulse(grid.edges(count) - delay)) / grid.length
        parts.append(np.stack([grid.smoothed(means, kernel, order) for order in (0, 1)]))
    return joined(parts, _PADDING)

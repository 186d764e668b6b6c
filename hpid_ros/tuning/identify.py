"""Inertia, friction, gravity, load and delay of joints from their recorded motion and efforts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import Numbers
from hpid_ros.tuning.joint_record import JointRecord, Kernel, Rows, Span
from hpid_ros.tuning.regression import INERTIA, Equation, Model, RigidBody
from hpid_ros.tuning.term_selection import JointIdentification, findings, nothing

_LEAST = 0.05  # of the largest command; less is no drive
_LEVELS = 25
_REFINED = 3  # times, each between the neighbours of the best
_BEYOND = 0.002  # of the commands at least
_LEAST_MISFIT = 1e-4  # of the effort's variance: below it a model is right as it is
_BETTER = 0.2  # of the misfit without a limit at most: ripple and gear losses gain a third


def _saturation(equation: Equation) -> float:
    """Return the effort that acts of a larger command, in [N m]; infinite if none shows one."""
    sizes = np.abs(equation.rows.record.effort)
    largest = float(sizes.max(initial=0.0))
    if largest == 0.0:
        return math.inf
    plain = _misfit(equation)
    if plain < _LEAST_MISFIT:
        return math.inf
    low, high, best, least = _LEAST * largest, largest, math.inf, plain
    for _ in range(_REFINED):
        levels = np.geomspace(low, high, _LEVELS)
        misfits = [_misfit(equation.limited(float(each))) for each in levels]
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
    model = Model(has_gravity=equation.rigid is None)
    found = equation.solve(model, equation.coarse_delay(model))
    effort = equation.effort(found.delay)[equation.weight > 0.0]
    return found.fit.rms**2 / max(float(np.var(effort)), 1e-300)


Spin = Callable[[Numbers, Numbers, Numbers, Numbers], Numbers]
"""Efforts that rotors need besides their reflected inertia, because they spin on links that move,
(K, R), in [N m]: for the same motion, and the reflected inertias of K rotors, (K,)."""

_CUTOFFS = (20.0, 16.0, 12.5, 10.0, 8.0, 6.3, 5.0, 4.0, 3.15, 2.5, 2.0, 1.6, 1.25, 1.0)
_HIGHEST = 0.1  # of the sampling frequency
_NOISE = 1e-3  # of the acceleration's variance
_LEAST_ROWS = 40
_BIN = 1.0  # [s]
_BUSY = 0.1  # of what the joint in question travels
_TOGETHER = 0.1  # of the time in which it moves
_STILL = 0.02  # of the joint that moves most
_TOO_SLOW = "its direction is hardly ever known: it should move faster, or reverse less often"


@dataclass(frozen=True)
class Method(Record):
    """How joints are identified."""

    cutoff: float | None = quantity(
        "Low pass; chosen by the noise of each joint if None", "Hz", default=None, above=0.0
    )
    longest_delay: float = quantity("From effort to motion", "s", default=0.1, above=0.0, most=1.0)
    has_scale: bool = quantity("Efforts are in a unit of their own", default=False)


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
    moving = max((each.travel for each in records), default=0.0)
    places = [k for k, each in enumerate(records) if wanted is None or each.joint in wanted]
    if rigid_body is not None:
        equations = {k: _equation(records, k, rigid_body, how, moving) for k in places}
        found = {k: _found(records[k], each, how) for k, each in equations.items()}
        if spin is not None:
            found |= _with_spin(spin, equations, found, len(records), how)
        return tuple(found.values())
    alone = []
    for each in (records[k] for k in places):
        own = _equation([each], 0, None, how, moving, _others_turn(each, records))
        alone.append(replace(_found(each, own, how), remarks=_company(each, records)))
    return tuple(alone)


def _found(record: JointRecord, equation: Equation | str, how: Method) -> JointIdentification:
    """Return what an equation says; nothing, with the reason, where there is none."""
    if isinstance(equation, str):
        return nothing(record, equation)
    return findings(equation, how.has_scale)


def _with_spin(
    spin: Spin,
    equations: Mapping[int, Equation | str],
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
    for place, equation in equations.items():
        if isinstance(equation, str) or not rotors.any():
            continue
        position, velocity, acceleration = equation.rows.motion.mean(axis=0)
        efforts = spin(position, velocity, acceleration, rotors)[place]
        if efforts.any():
            equation.spin = efforts
            again[place] = findings(equation, how.has_scale)
    return again


def _company(own: JointRecord, records: Sequence[JointRecord]) -> tuple[str, ...]:
    """Return who moves while a joint does, whose coupling nobody knows."""
    edges = _bins(own)
    busy = _is_busy(own, edges, own.travel)
    if not busy.any():
        return ()
    names = [
        each.joint
        for each in records
        if each is not own and np.mean(_is_busy(each, edges, own.travel)[busy]) > _TOGETHER
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
    edges = _bins(own)
    is_theirs = np.zeros(len(edges), dtype=np.bool_)
    for each in records:
        is_theirs |= _is_busy(each, edges, each.travel)
    is_theirs &= ~_is_busy(own, edges, own.travel)
    return [Span(float(at), float(at) + _BIN) for at in edges[is_theirs]]


def _bins(record: JointRecord) -> Numbers:
    """Return when the pieces of time begin in which a joint has samples, in [s].

    Of a clock that was set there may be years without any.
    """
    begin = record.time[:1]
    return np.asarray(begin + _BIN * np.unique(np.floor((record.time - begin) / _BIN)))


def _is_busy(record: JointRecord, edges: Numbers, travel: float) -> NDArray[np.bool_]:
    """Tell for each piece of time whether a joint moves by a part of a travel."""
    begins, ends = (np.searchsorted(record.time, each) for each in (edges, edges + _BIN))
    pieces = [record.position[a:b] for a, b in zip(begins, ends, strict=True)]
    moved = np.array([float(np.ptp(each)) if len(each) else 0.0 for each in pieces])
    return np.asarray(moved > _BUSY * travel)


def _equation(
    records: Sequence[JointRecord],
    place: int,
    rigid_body: RigidBody | None,
    how: Method,
    moving: float,
    left_out: Sequence[Span] = (),
) -> Equation | str:
    """Return a joint's equation, or why there is none."""
    own = records[place]
    if len(own.time) < 2 or len(own.effort_time) < 2:
        return "there are no positions, or no efforts, to look at"
    if own.travel == 0.0 or own.travel < _STILL * moving:
        return f"it did not move (by {own.travel:.2g}): it needs a motion of its own"
    if not np.any(own.effort):
        return "its efforts are zero throughout"
    kernel = _kernel(own, how)
    rows = Rows(records, place, kernel, how.longest_delay)
    if rows.count < _LEAST_ROWS:
        return (
            f"no stretch without a gap is longer than {6.0 * kernel.half_width:.2g} s, which a "
            f"low pass of {kernel.cutoff:g} Hz needs at samples every {own.period:.2g} s"
        )
    equation = Equation(rows, rigid_body, left_out)
    if equation.used_rows < _LEAST_ROWS:
        return _TOO_SLOW
    return equation.limited(_saturation(equation)) if own.is_held else equation


def _kernel(record: JointRecord, how: Method) -> Kernel:
    """Return the low pass asked for, or the highest in which the acceleration has little noise."""
    highest = _HIGHEST / record.period
    if how.cutoff is not None:
        return Kernel(min(how.cutoff, highest))
    best, least = None, math.inf
    for cutoff in _CUTOFFS:
        if cutoff > highest and cutoff > _CUTOFFS[-1]:
            continue
        kernel = Kernel(min(cutoff, highest))
        rows = Rows([record], 0, kernel, how.longest_delay)
        if not rows.count:
            continue
        accelerations = [part[:, 2, 0] for part in rows.parts]
        acceleration = np.concatenate([each.mean(axis=0) for each in accelerations])
        # By how far the halves differ.
        noise = math.sqrt(np.mean([(np.std(a - b) / 2.0) ** 2 for a, b in accelerations]))
        share = noise**2 / max(float(np.var(acceleration)), 1e-300)
        if share <= _NOISE:
            return kernel
        if share < least:
            best, least = kernel, share
    return best or Kernel(min(_CUTOFFS[0], highest))

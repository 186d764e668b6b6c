"""Inertia, friction, gravity, load and delay of joints from their recorded motion and efforts.

Each joint has an equation of motion (:mod:`.regression`) over its smoothed recording
(:mod:`.joint_record`). Here its low pass is chosen and its equation made. Which terms it has is
decided in :mod:`.model_structure`; :mod:`.joint_identification` says what its solution is worth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hpid_bench.tuning.identification.concurrent_motion import (
    remark_on_concurrent_motion,
    spans_of_others,
)
from hpid_bench.tuning.identification.joint_identification import (
    JointIdentification,
    joint_identification,
    not_identified,
)
from hpid_bench.tuning.identification.joint_record import JointRecord, Kernel, Rows, Span
from hpid_bench.tuning.identification.model_structure import (
    effort_limit,
    select_terms,
    with_flexibility,
)
from hpid_bench.tuning.identification.regression import INERTIA, Equation, RigidBody, Solution
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import Numbers

SpinEfforts = Callable[[Numbers, Numbers, Numbers, Numbers], Numbers]
"""Efforts that rotors need besides their reflected inertia, because they spin on links that move,
(K, R), in [N m]: for the same motion, and the reflected inertias of K rotors, (K,)."""

_LEAST_ROWS = 40
_LEAST_TRAVEL = 0.02  # of that of the joint that moves most
_CUTOFFS = (20.0, 16.0, 12.5, 10.0, 8.0, 6.3, 5.0, 4.0, 3.15, 2.5, 2.0, 1.6, 1.25, 1.0)
"""Of the low passes that are tried, in [Hz], from the highest on."""
_HIGHEST_CUTOFF = 0.1  # of the sampling frequency
_MOST_NOISE = 1e-3  # of the smoothed acceleration's variance


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
    spin: SpinEfforts | None = None,
) -> tuple[JointIdentification, ...]:
    """Identify joints.

    Without rigid bodies each joint is taken for itself: what it moves is what it would with the
    other joints at rest.
    """
    method = method or Method()
    places = [k for k, each in enumerate(records) if wanted is None or each.joint in wanted]
    if rigid_body is None:
        return _identify_alone(records, places, method)
    return _identify_together(records, places, rigid_body, method, spin)


def _identify_alone(
    records: Sequence[JointRecord], places: Sequence[int], method: Method
) -> tuple[JointIdentification, ...]:
    most = _largest_travel([records[k] for k in places])
    found = []
    for own in (records[k] for k in places):
        reason = _why_no_equation(own, most)
        if reason:
            found.append(not_identified(own, reason))
            continue
        # While it rests and others move, its effort holds against their pull.
        left_out = spans_of_others(own, records)
        equation = _equation([own], 0, None, method, left_out)
        if isinstance(equation, str):
            found.append(not_identified(own, equation))
            continue
        identified = _identification(equation, select_terms(equation, method.has_scale))
        remark = remark_on_concurrent_motion(own, records) if identified.is_found else ""
        if remark:
            identified = replace(identified, remarks=(*identified.remarks, remark))
        found.append(identified)
    return tuple(found)


def _identify_together(
    records: Sequence[JointRecord],
    places: Sequence[int],
    rigid_body: RigidBody,
    method: Method,
    spin: SpinEfforts | None,
) -> tuple[JointIdentification, ...]:
    most = _largest_travel(records)
    equations: dict[int, Equation] = {}
    refused: dict[int, str] = {}
    for place in places:
        equation: Equation | str = _why_no_equation(records[place], most) or _equation(
            records, place, rigid_body, method
        )
        if isinstance(equation, str):
            refused[place] = equation
        else:
            equations[place] = equation
    solutions = {k: select_terms(each, method.has_scale) for k, each in equations.items()}
    if spin is not None:
        rotors = _rotor_inertias(equations, solutions, len(records))
        with_spin = _with_spinning_rotors(spin, rotors, equations)
        solutions |= {k: select_terms(each, method.has_scale) for k, each in with_spin.items()}
        equations |= with_spin
    return tuple(
        not_identified(records[k], refused[k])
        if k in refused
        else _identification(equations[k], solutions[k])
        for k in places
    )


def _identification(equation: Equation, solution: Solution) -> JointIdentification:
    flexibility = with_flexibility(equation, solution)
    return joint_identification(equation, flexibility.solution, flexibility.reason)


def _rotor_inertias(
    equations: Mapping[int, Equation], solutions: Mapping[int, Solution], count: int
) -> Numbers:
    """Return the reflected inertias of all rotors, (K,), in [kg m^2]; 0 where none is reliable."""
    rotors = np.zeros(count)
    for place, solution in solutions.items():
        estimate = joint_identification(equations[place], solution).reliable(INERTIA)
        if estimate is not None:
            rotors[place] = estimate.value
    return rotors


def _with_spinning_rotors(
    spin: SpinEfforts, rotors: Numbers, equations: Mapping[int, Equation]
) -> dict[int, Equation]:
    """Return the equations of joints at which rotors pull, with the effort that these need."""
    if not rotors.any():
        return {}
    found = {}
    for place, equation in equations.items():
        position, velocity, acceleration = equation.rows.motion.mean(axis=0)
        effort = spin(position, velocity, acceleration, rotors)[place]
        if effort.any():
            found[place] = equation.with_spin(effort)
    return found


def _largest_travel(records: Sequence[JointRecord]) -> float:
    return max((each.travel for each in records if len(each.effort)), default=0.0)


def _why_no_equation(record: JointRecord, largest_travel: float) -> str:
    """Return why a record tells nothing of its joint; empty if it may."""
    if len(record.time) < 2 or len(record.effort_time) < 2:
        return "there are no positions, or no efforts, to look at"
    if record.travel == 0.0 or record.travel < _LEAST_TRAVEL * largest_travel:
        return f"it did not move (by {record.travel:.2g}): it needs a motion of its own"
    if not np.any(record.effort):
        return "its efforts are zero throughout"
    return ""


def _equation(
    records: Sequence[JointRecord],
    place: int,
    rigid_body: RigidBody | None,
    method: Method,
    left_out: Sequence[Span] = (),
) -> Equation | str:
    """Return a joint's equation, or why there is none."""
    own = records[place]
    kernel = _low_pass(own, method)
    rows = Rows(records, place, kernel, method.longest_delay)
    if rows.count < _LEAST_ROWS:
        return (
            f"no stretch without a gap is longer than {6.0 * kernel.half_width:.2g} s, which a "
            f"low pass of {kernel.cutoff:g} Hz needs at samples every {own.period:.2g} s"
        )
    equation = Equation(rows, rigid_body, left_out)
    if equation.used_rows < _LEAST_ROWS:
        return "its direction is hardly ever known: it should move faster, or reverse less often"
    # Held efforts are commands, which may be more than the drive gives.
    return equation.limited(effort_limit(equation)) if own.is_held else equation


def _low_pass(record: JointRecord, method: Method) -> Kernel:
    """Return the low pass asked for, or the highest in which the acceleration has little noise."""
    highest = _HIGHEST_CUTOFF / record.period
    if method.cutoff is not None:
        return Kernel(min(method.cutoff, highest))
    best, least = None, math.inf
    for cutoff in _CUTOFFS:
        if cutoff > highest and cutoff > _CUTOFFS[-1]:
            continue
        kernel = Kernel(min(cutoff, highest))
        rows = Rows([record], 0, kernel, method.longest_delay)
        if not rows.count:
            continue
        noise = _acceleration_noise(rows)
        if noise <= _MOST_NOISE:
            return kernel
        if noise < least:
            best, least = kernel, noise
    return best or Kernel(min(_CUTOFFS[0], highest))


def _acceleration_noise(rows: Rows) -> float:
    """Return the share of the smoothed acceleration's variance that is noise.

    By how far the accelerations differ that every second sample gives, and those between.
    """
    accelerations = [part[:, 2, 0] for part in rows.parts]
    acceleration = np.concatenate([each.mean(axis=0) for each in accelerations])
    noise = math.sqrt(np.mean([(np.std(a - b) / 2.0) ** 2 for a, b in accelerations]))
    return noise**2 / max(float(np.var(acceleration)), 1e-300)

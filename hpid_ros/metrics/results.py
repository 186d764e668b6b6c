r"""Indices of a run and the conditions they hold for: arrays in, named numbers out.

IVC, IAVC, ITAE of each joint and the L2 norms over all joints, as in the paper's section
"Experimental assessment of HPID on the mobile manipulator"; and further ones: docs/indices.md.

Quadrature: see :mod:`~hpid_ros.metrics.indices`. Last, saved numbers read again, and numbers in
other units.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from hpid_ros.base.errors import listed_names, unknown_name
from hpid_ros.base.rounding import significant
from hpid_ros.messages.series import (
    GIVEN,
    HELD,
    HOLD,
    MEASURED,
    NO_EFFORT,
    NO_REFERENCE,
    NONE,
    JointSeries,
    RunSeries,
    SeriesError,
)
from hpid_ros.metrics.alignment import (
    DURATION_WITHIN,
    REFERENCE_AT_LEAST,
    REFERENCE_WITHIN,
    JointCourse,
    Outline,
    course_of,
    outline_of,
)
from hpid_ros.metrics.indices import (
    chatter,
    energy,
    find_steps,
    integral_of_absolute,
    itae,
    root_mean_square_of_parts,
    saturation_share,
    square_integral,
    step_response,
    total_variation,
)
from hpid_ros.metrics.quantities import (
    ANGLE_UNITS,
    CHATTER,
    DEGREES_PER_RADIAN,
    EFFORT_L2,
    ERROR_L2,
    INDICES,
    ITAE,
    NORMS,
    QUANTITIES,
    STEP_QUANTITIES,
    Data,
    Fold,
    Quantity,
    folded,
)

KNOTS = 33  # points at which each reference is kept
KNOT_DIGITS = 9
RATE_WITHIN = 0.05  # by a larger share: rates of other loops, and not of lost states alone
UNLIKE_KNOTS = 2  # so many points must differ: one may lie in a jump


EVERYTHING = frozenset(QUANTITIES)
NOTHING: frozenset[str] = frozenset()
EFFORTS = frozenset(key for key, each in QUANTITIES.items() if each.needs is Data.EFFORT)


class Difference(NamedTuple):
    """One thing that two runs do not share."""

    text: str  # in words
    # keys of the quantities that say nothing beside each other for that reason
    spoils: frozenset[str]


@dataclass(frozen=True)
class Conditions:
    """What two runs must share before their numbers can be compared."""

    duration: float  # [s] from the first to the last state
    period: float  # [s] mean time between two states
    cutoff: float  # [Hz] frequency above which effort counts as chatter
    clock: str = "header"  # whose time the states have: "header" or "receive"
    # [rad] for each joint that has one, its reference at KNOTS even times
    references: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    # by what the run is laid over others; not in saved numbers
    outline: Outline | None = field(default=None, compare=False)
    # of each joint that has efforts: from the first to the last, and their mean period, in [s]
    efforts: Mapping[str, tuple[float, float]] = field(default_factory=dict, compare=False)

    @property
    def odd_efforts(self) -> dict[str, tuple[float, float]]:
        """Those efforts that cover another time than the states, or have another rate."""
        usual = self.duration, self.period
        return {k: v for k, v in self.efforts.items() if any(_unlike_efforts(v, usual).values())}


def differences(one: Conditions, other: Conditions) -> Iterator[Difference]:
    """Yield what differs between two runs' conditions."""
    if _differ(one.duration, other.duration):
        text = f"durations differ: {one.duration:g} s and {other.duration:g} s"
        yield Difference(text, EVERYTHING)
    is_other_rate = _differ(one.period, other.period, RATE_WITHIN)
    if _differ(one.period, other.period):
        rates = (f"{1 / each:.4g} Hz" if each else "none" for each in (one.period, other.period))
        text = f"state rates differ: {' and '.join(rates)}"
        yield Difference(text, EVERYTHING if is_other_rate else NOTHING)
    if one.clock != other.clock:
        yield Difference(f"clocks differ: {one.clock} and {other.clock}", NOTHING)
    if one.cutoff != other.cutoff:
        text = f"chatter cut-offs differ: {one.cutoff:g} Hz and {other.cutoff:g} Hz"
        yield Difference(text, frozenset({CHATTER.key}))
    unlike = {
        name: _unlike_efforts(one.efforts[name], other.efforts[name])
        for name in one.efforts
        if name in other.efforts
    }
    is_other_time = _differ(one.duration, other.duration)
    for what, is_said in (("times", is_other_time), ("rates", is_other_rate)):
        names = [name for name, are_unlike in unlike.items() if are_unlike[what]]
        if names and not is_said:
            yield Difference(f"{what} of the efforts differ: {', '.join(names)}", EFFORTS)
    names = [
        name
        for name, knots in one.references.items()
        if name in other.references
        and _unlike(knots, one.duration, other.references[name], other.duration)
    ]
    if names:
        yield Difference(f"references differ: {', '.join(names)}", EVERYTHING)


class _JointNumbers(NamedTuple):
    """All that is kept of one joint."""

    indices: Indices
    effort_square: float | None  # integral over time; None without efforts
    error_square: float | None  # None without a reference
    knots: tuple[float, ...]  # of its reference; empty without one
    effort_times: tuple[float, float] | None  # [s] from the first to the last, mean period
    course: JointCourse


def _numbers_of(
    series: JointSeries, start_ns: int, cutoff: float, effort_limit: float | None
) -> _JointNumbers:
    time = float(np.ptp(series.command_time)) if series.has_effort else 0.0
    effort_square = _effort_square(series)
    indices = _joint_indices(series, cutoff, effort_limit, effort_square)
    return _JointNumbers(
        indices,
        effort_square,
        indices["ise"] if series.has_reference else None,
        _knots(series) if series.has_reference else (),
        (time, time / max(1, series.effort.size - 1)) if series.has_effort else None,
        course_of(series, start_ns),
    )


def _conditions_of(
    run: RunSeries, numbers: Mapping[str, _JointNumbers], cutoff: float
) -> Conditions:
    states = max(each.states for each in run.outlines)
    return Conditions(
        duration=run.duration,
        period=run.duration / max(1, states - 1),
        cutoff=cutoff,
        references={joint: each.knots for joint, each in numbers.items() if each.knots},
        clock=next((each.state_clock for each in run.quality.joints.values()), "header"),
        outline=outline_of(run, {joint: each.course for joint, each in numbers.items()}),
        efforts={
            joint: each.effort_times
            for joint, each in numbers.items()
            if each.effort_times is not None
        },
    )


def _knots(series: JointSeries) -> tuple[float, ...]:
    at = np.linspace(0.0, float(series.time[-1]), KNOTS)
    values = np.interp(at, series.time, series.reference)
    return tuple(significant(value, KNOT_DIGITS) for value in values)


def _differ(one: float, other: float, within: float = DURATION_WITHIN) -> bool:
    return abs(one - other) > within * max(one, other)


def _unlike_efforts(one: tuple[float, float], other: tuple[float, float]) -> dict[str, bool]:
    """Say whether efforts cover other times, by more than a sample at each end, or rates."""
    (one_time, one_period), (other_time, other_period) = one, other
    is_more = abs(one_time - other_time) > 2.5 * max(one_period, other_period)
    return {
        "times": is_more and _differ(one_time, other_time),
        "rates": _differ(one_period, other_period, RATE_WITHIN),
    }


def _unlike(
    one: tuple[float, ...], one_duration: float, other: tuple[float, ...], other_duration: float
) -> bool:
    """Say whether two references differ over the time that both have."""
    at = np.linspace(0.0, one_duration, len(one))
    of_other = np.interp(at, np.linspace(0.0, other_duration, len(other)), other)
    shared = at <= other_duration
    values = np.array([*one, *other])
    within = max(REFERENCE_AT_LEAST, REFERENCE_WITHIN * float(values.max() - values.min()))
    if _differ(one_duration, other_duration):
        within *= 5.0  # compared between the points of one of them
    unlike = np.abs(np.array(one) - of_other)[shared] > within
    return int(np.count_nonzero(unlike)) >= UNLIKE_KNOTS


Indices: TypeAlias = Mapping[str, float]
"""The numbers of one joint, or of all joints, by key; what is not defined is not there."""


@dataclass(frozen=True)
class Spread:
    """How far repeated runs lie apart whose medians a :class:`RunIndices` holds."""

    repeats: int  # number of runs
    # first and third quartile by key, of each joint and, under None, of all
    quartiles: Mapping[str | None, Mapping[str, tuple[float, float]]]


@dataclass(frozen=True)
class RunIndices:
    """All numbers of one run, or the medians of several under one label."""

    label: str  # name of the run
    joints: Mapping[str, Indices]  # by joint name, in the run's order
    totals: Indices  # those of all joints; each quantity's fold says how they come about
    quantities: tuple[Quantity, ...] = (*INDICES, *NORMS)  # which quantities were computed
    conditions: Conditions | None = None  # under which conditions; None if that is not known
    spread: Spread | None = None  # how far repeated runs lie apart; None for a single one
    angle_unit: str = "rad"  # the unit of angles in these numbers, "rad" or "deg"
    lacking: Mapping[str, Mapping[Data, str]] = field(default_factory=dict)
    assumed: Mapping[Data, str] = field(default_factory=dict)
    # topic and kind of the reference of each joint that has one, see against_text
    against: Mapping[str, str] = field(default_factory=dict)
    cut: str = ""  # to which part of the recording the numbers were cut; empty if to none
    # [s] by how much later than in the first recording that part lies, where it was sought
    shift: float | None = None
    # the joints that are known to slide: in their numbers "rad" reads "m", and "N m" reads "N"
    slides: frozenset[str] = frozenset()

    def unit(self, quantity: Quantity, joint: str | None = None) -> str:
        """Return the unit of one number; of all joints' where these turn and slide, both units."""
        names = self.joints if joint is None else (joint,)
        return quantity.unit_in(self.angle_unit, (name in self.slides for name in names))

    def value(self, quantity: Quantity, joint: str | None = None) -> float:
        """Return one number of this run; nan where it is not defined."""
        if quantity not in self.quantities:
            known = listed_names([each.key for each in self.quantities])
            raise SeriesError(
                f"run {self.label!r} was measured without {quantity.key}, its numbers are "
                f"{known}: measure its recording again"
            )
        if joint is not None and joint not in self.joints:
            raise SeriesError(unknown_name("joint", joint, self.joints))
        numbers = self.totals if joint is None else self.joints[joint]
        return numbers.get(quantity.key, math.nan)

    def why_undefined(self, quantity: Quantity, joint: str | None = None) -> dict[str, str]:
        """Return why a number is not defined, by joint; empty where it is."""
        if not math.isnan(self.value(quantity, joint)):
            return {}
        names = self.joints if joint is None else (joint,)
        missing = {name: self.lacking.get(name, {}).get(quantity.needs) for name in names}
        known = {name: reason for name, reason in missing.items() if reason is not None}
        return known or dict.fromkeys(names, quantity.else_undefined)

    def without(self, data: Data) -> frozenset[str]:
        """Return the joints that lack something: totals of what needs it go over the others."""
        return frozenset(name for name, reasons in self.lacking.items() if data in reasons)

    def left_out(self, data: Data) -> str:
        """Return which joints totals of what needs it are without; empty for none, or all."""
        without = [name for name in self.joints if name in self.without(data)]
        if not without or len(without) == len(self.joints):
            return ""
        return f"totals without {', '.join(without)}"

    @property
    def notes(self) -> tuple[str, ...]:
        """What the numbers must be read with, one line each, without the run's label."""
        assumed = [f"{data.value}: {text}" for data, text in self.assumed.items()]
        parts = ((data, self.left_out(data)) for data in Data)
        assumed += [f"{data.value}: {text}" for data, text in parts if text]
        return (*self._references(), *assumed, *([self.cut] if self.cut else ()))

    def _references(self) -> Iterator[str]:
        """Yield a line for each reference that errors were measured against."""
        joints: dict[str, list[str]] = {}
        for joint, text in self.against.items():
            joints.setdefault(text, []).append(joint)
        for text, names in joints.items():
            of = f" of {', '.join(names)}" if len(names) < len(self.joints) else ""
            yield f"error{of} against {text}"

    def as_mapping(self) -> dict[str, object]:
        """Return the numbers with their units as plain dicts, ready for JSON."""
        totals = {key: for_json(value) for key, value in self.totals.items()}
        norms = {each.key: totals.pop(each.key) for each in NORMS if each.key in totals}
        mapping: dict[str, object] = {"label": self.label, "units": self._units()}
        if self.slides:
            mapping["slides"] = [name for name in self.joints if name in self.slides]
            mapping["joint_units"] = {name: self._units(name) for name in self.joints}
        mapping["joints"] = {
            name: {key: for_json(value) for key, value in numbers.items()}
            for name, numbers in self.joints.items()
        }
        mapping |= {"totals": totals, **norms}
        if self.lacking:
            mapping["lacking"] = {
                joint: {data.value: reason for data, reason in reasons.items()}
                for joint, reasons in self.lacking.items()
            }
        if self.assumed:
            mapping["assumed"] = {data.value: text for data, text in self.assumed.items()}
        if self.against:
            mapping["against"] = dict(self.against)
        if self.cut:
            mapping["cut"] = self.cut
        if self.shift is not None:
            mapping["shift"] = self.shift
        if self.conditions is not None:
            references = {k: list(v) for k, v in self.conditions.references.items()}
            conditions = {**vars(self.conditions), "references": references}
            del conditions["outline"], conditions["efforts"]
            if self.conditions.odd_efforts:
                odd = {k: list(v) for k, v in self.conditions.odd_efforts.items()}
                conditions["efforts"] = odd
            mapping["conditions"] = conditions
        if self.spread is not None:
            mapping["repeats"] = self.spread.repeats
            mapping["quartiles"] = {
                "totals" if joint is None else f"joints.{joint}": {
                    key: [for_json(end) for end in pair] for key, pair in quartiles.items()
                }
                for joint, quartiles in self.spread.quartiles.items()
            }
        return mapping

    def _units(self, joint: str | None = None) -> dict[str, str]:
        return {each.key: self.unit(each, joint) for each in self.quantities}


def for_json(value: float | None) -> float | None:
    """Return a number for JSON, which knows no infinity."""
    return value if value is not None and math.isfinite(value) else None


DEFAULT_CUTOFF = 20.0  # [Hz] above what motions of an arm hold, below what its drives follow


def joint_indices(
    series: JointSeries, cutoff: float = DEFAULT_CUTOFF, effort_limit: float | None = None
) -> Indices:
    """Return the indices of one joint; time counts from its first state.

    What needs a reference or efforts that the joint does not have is not there.
    """
    return _joint_indices(series, cutoff, effort_limit, _effort_square(series))


def _effort_square(series: JointSeries) -> float | None:
    """Return the integral of a joint's squared effort; None without efforts."""
    return square_integral(series.command_time, series.effort) if series.has_effort else None


def _joint_indices(
    series: JointSeries, cutoff: float, effort_limit: float | None, effort_square: float | None
) -> Indices:
    # The order of the keys is that of files.
    numbers: dict[str, float | None] = {}
    t, u = series.command_time, series.effort
    if series.has_effort:
        numbers |= {"ivc": total_variation(u), "iavc": integral_of_absolute(t, u)}
    if series.has_reference:
        numbers |= _error_numbers(series)
    if effort_square is not None:
        numbers["effort_l2"] = math.sqrt(effort_square)
    if series.has_reference:
        numbers |= _worst_step(series)
    if series.has_effort:
        numbers |= {
            "saturation": saturation_share(series, effort_limit),
            "chatter": chatter(series, cutoff),
            "energy": energy(series),
        }
    return {key: value for key, value in numbers.items() if value is not None}


def run_indices(
    run: RunSeries,
    cutoff: float = DEFAULT_CUTOFF,
    effort_limits: Mapping[str, float] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> RunIndices:
    """Return all numbers of one run.

    The squares of the L2 norms are sums of the joints' own integrals, which equals the paper's
    integral of the sum and needs no stamps in common.
    """
    limits = effort_limits or {}
    for name in limits:
        if name not in run.joint_names:
            raise SeriesError(unknown_name("joint", name, run.joint_names))
    texts = {f"effort limit of {name}": value for name, value in limits.items()}
    for name, value in {"cut-off": cutoff, **texts}.items():
        if not (math.isfinite(value) and value > 0.0):
            raise SeriesError(f"the {name} must be positive and finite, not {value}")
    numbers: dict[str, _JointNumbers] = {}
    for each in run.joints:
        progress(len(numbers) / len(run.joints))
        limit = limits.get(each.joint)
        numbers[each.joint] = _numbers_of(each, run.start_ns, cutoff, limit)
    joints = {joint: each.indices for joint, each in numbers.items()}
    lacking = _lacking(run)
    norms = {}
    for norm, squares in (
        (EFFORT_L2, [each.effort_square for each in numbers.values()]),
        (ERROR_L2, [each.error_square for each in numbers.values()]),
    ):
        if known := [each for each in squares if each is not None]:
            norms[norm.key] = math.sqrt(math.fsum(known))
    return RunIndices(
        label=run.label,
        joints=joints,
        totals=_totals(joints, lacking) | norms,
        quantities=tuple(QUANTITIES.values()),
        conditions=_conditions_of(run, numbers, cutoff),
        lacking=lacking,
        assumed=_assumed(run),
        against={
            name: against_text(each.reference)
            for name, each in run.quality.joints.items()
            if each.reference not in (NONE, HOLD)
        },
        slides=run.slides,
    )


def l2_of_run(run: RunSeries, quantity: Quantity) -> float:
    """Return one of the L2 norms over all joints of a run; nan where no joint has it."""
    if quantity == EFFORT_L2:
        squares = [
            square_integral(each.command_time, each.effort)
            for each in run.joints
            if each.has_effort
        ]
    else:
        squares = [square_of_error(each) for each in run.joints if each.has_reference]
    return math.sqrt(math.fsum(squares)) if squares else math.nan


def against_text(reference: str) -> str:
    """Return what an error is measured against, ``/joint_trajectory (trajectory)``.

    Args:
        reference: As :attr:`DataQuality.reference` names it, ``trajectory /joint_trajectory``.
    """
    if reference == GIVEN:
        return "the trajectory that was given"
    topics: dict[str, list[str]] = {}
    for part in reference.split(" and "):
        kind, _, topic = part.partition(" ")
        topics.setdefault(kind, []).append(topic)
    return " and ".join(
        f"{' and '.join(named)} ({kind})" if any(named) else kind for kind, named in topics.items()
    )


def _lacking(run: RunSeries) -> dict[str, dict[Data, str]]:
    """Return which joints lack a reference or efforts, and why."""
    lacking: dict[str, dict[Data, str]] = {}
    for each in run.outlines:
        quality = run.quality.joints.get(each.joint)
        if not each.has_reference:
            lacking.setdefault(each.joint, {})[Data.REFERENCE] = NO_REFERENCE
        if not each.commands:
            reason = NO_EFFORT if quality is None else quality.no_effort or NO_EFFORT
            lacking.setdefault(each.joint, {})[Data.EFFORT] = reason
    return lacking


def _assumed(run: RunSeries) -> dict[Data, str]:
    """Return what stands in for a recorded reference or commanded efforts."""
    qualities = run.quality.joints.values()
    assumed = {}
    if any(each.reference == HOLD for each in qualities):
        assumed[Data.REFERENCE] = HELD
    measured: dict[str, list[str]] = {}
    for joint, each in run.quality.joints.items():
        if each.effort.startswith(MEASURED):
            measured.setdefault(each.effort, []).append(joint)
    is_every = not any(q.effort != NONE and q.effort not in measured for q in qualities)
    if measured:
        assumed[Data.EFFORT] = " and ".join(
            text if is_every else f"{text} ({listed_names(joints)})"
            for text, joints in measured.items()
        )
    return assumed


def _totals(
    joints: Mapping[str, Indices], lacking: Mapping[str, Mapping[Data, str]]
) -> dict[str, float]:
    """Return what is so over all joints that have what a quantity needs."""
    totals = {}
    for quantity in QUANTITIES.values():
        if quantity in NORMS:
            continue
        numbers = [
            each for name, each in joints.items() if quantity.needs not in lacking.get(name, {})
        ]
        values = [joint[quantity.key] for joint in numbers if quantity.key in joint]
        if quantity.fold in (Fold.SUM, Fold.EUCLIDEAN) and len(values) < len(numbers):
            continue  # a sum without one of its joints would be too small
        if values:
            totals[quantity.key] = folded(quantity.fold, values)
    return totals


def _error_numbers(series: JointSeries) -> dict[str, float]:
    # A function of its own: of an hour's series the error is not kept with what comes next.
    t, error = series.time, series.error
    parts = [(t[each], error[each]) for each in series.referenced]
    ise = math.fsum(square_integral(*part) for part in parts)
    span = math.fsum(float(t[-1] - t[0]) for t, _ in parts)
    return {
        "itae": math.fsum(itae(*part) for part in parts),
        "iae": math.fsum(integral_of_absolute(*part) for part in parts),
        "ise": ise,
        "rmse": math.sqrt(ise / span) if span else root_mean_square_of_parts(parts),
        "error_max": max(max(float(e.max()), -float(e.min())) for _, e in parts),
        "error_l2": math.sqrt(ise),
    }


def square_of_error(series: JointSeries) -> float:
    """Return the integral of a joint's squared error over all stretches with a reference."""
    t, error = series.time, series.error
    return math.fsum(square_integral(t[each], error[each]) for each in series.referenced)


def _worst_step(series: JointSeries) -> dict[str, float | None]:
    """Return each number of the steps' responses at its worst; nothing without a step."""
    responses = [step_response(part, step) for part in series.parts() for step in find_steps(part)]
    return {
        quantity.key: max((getattr(each, quantity.key) for each in responses), default=None)
        for quantity in STEP_QUANTITIES
    }


def in_units(runs: Sequence[RunIndices], angle_unit: str) -> list[RunIndices]:
    """Return the numbers of runs as they stand side by side: each joint in one unit.

    A joint that one of the runs knows to slide slides in all of them.
    """
    slides = frozenset[str]().union(*(run.slides for run in runs))
    found = []
    for run in runs:
        own = slides.intersection(run.joints)
        if own != run.slides:  # what was taken for degrees becomes metres as it was recorded
            run = replace(with_angles_in(run, "rad"), slides=own)
        found.append(with_angles_in(run, angle_unit))
    return found


def with_angles_in(run: RunIndices, angle_unit: str) -> RunIndices:
    """Return a run's numbers with angles in another unit; its conditions stay in rad."""
    if angle_unit not in ANGLE_UNITS:
        raise SeriesError(unknown_name("unit of angles", angle_unit, ANGLE_UNITS))
    if angle_unit == run.angle_unit:
        return run
    if run.slides and run.spread is not None and not run.slides.issuperset(run.joints):
        raise SeriesError(
            f"run {run.label!r} is medians over joints that turn and slide: its totals cannot be "
            f"given in {angle_unit}; give the single runs"
        )
    scale = DEGREES_PER_RADIAN if angle_unit == "deg" else 1.0 / DEGREES_PER_RADIAN
    # Products and no powers: the same factors on every machine.
    powers = (1.0, scale, scale * scale)
    factors = {key: powers[each.angle_power] for key, each in QUANTITIES.items()}

    def scaled(numbers: Indices) -> Indices:
        return {key: value * factors[key] for key, value in numbers.items()}

    joints = {
        name: numbers if name in run.slides else scaled(numbers)
        for name, numbers in run.joints.items()
    }
    if not run.slides:
        totals, spread = scaled(run.totals), run.spread
        if spread is not None:
            quartiles = {
                joint: {k: (factors[k] * low, factors[k] * high) for k, (low, high) in q.items()}
                for joint, q in spread.quartiles.items()
            }
            spread = replace(spread, quartiles=quartiles)
        return replace(run, joints=joints, totals=totals, spread=spread, angle_unit=angle_unit)
    totals = dict(run.totals)
    if not run.slides.issuperset(run.joints):  # those of both kinds are folded again
        for key in run.totals:
            values = [numbers[key] for numbers in joints.values() if key in numbers]
            if QUANTITIES[key].angle_power and values:
                totals[key] = folded(QUANTITIES[key].fold, values)
    return replace(run, joints=joints, totals=totals, angle_unit=angle_unit)


def runs_from_mapping(document: object, where: str) -> tuple[RunIndices, ...]:
    """Return the runs of a saved comparison, the baseline first."""
    content = document.get("indices", document) if isinstance(document, Mapping) else None
    runs = content.get("runs") if isinstance(content, Mapping) else None
    if not isinstance(runs, Mapping) or not runs:
        raise SeriesError(
            f"{where} holds no saved indices: it is neither a result.json nor made by --save"
        )
    try:
        return tuple(_run(str(label), run) for label, run in runs.items())
    except SeriesError as error:
        raise SeriesError(f"{where}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)
        raise SeriesError(f"{where} is damaged: {reason}") from None


def _run(label: str, entry: Mapping[str, Any]) -> RunIndices:
    units = entry["units"]
    slides = _slides(label, entry)
    are_slides = [name in slides for name in entry["joints"]]
    angle_unit = _angle_unit(label, units, are_slides)
    quantities = tuple(QUANTITIES[key] for key in QUANTITIES if key in units)
    for quantity in quantities:
        unit = quantity.unit_in(angle_unit, are_slides)
        if units[quantity.key] != unit:
            raise SeriesError(
                f"run {label!r}: {quantity.key} is in {units[quantity.key]}, but must be in {unit}"
            )
    lacking = {
        str(joint): {Data(name): str(reason) for name, reason in reasons.items()}
        for joint, reasons in entry.get("lacking", {}).items()
    }
    joints = {
        str(name): _indices(values, lacking.get(name, {}))
        for name, values in entry["joints"].items()
    }
    if not joints:
        raise SeriesError(f"run {label!r} has no joint")
    missing = {data for reasons in lacking.values() for data in reasons}
    return RunIndices(
        label=label,
        joints=joints,
        totals=_indices(entry["totals"], missing) | _numbers(entry, NORMS, missing),
        quantities=quantities,
        conditions=_conditions(
            entry.get("conditions"),
            [name for name in joints if Data.EFFORT not in lacking.get(name, {})],
        ),
        spread=_spread(entry),
        angle_unit=angle_unit,
        lacking=lacking,
        assumed={Data(name): str(text) for name, text in entry.get("assumed", {}).items()},
        against={str(k): str(v) for k, v in entry.get("against", {}).items()},
        cut=str(entry.get("cut", "")),
        shift=None if entry.get("shift") is None else _number(entry["shift"]),
        slides=slides,
    )


def _slides(label: str, entry: Mapping[str, Any]) -> frozenset[str]:
    slides = frozenset(map(str, entry.get("slides", ())))
    for name in sorted(slides):
        if name not in entry["joints"]:
            raise SeriesError(f"run {label!r}: {unknown_name('joint', name, entry['joints'])}")
    return slides


def _angle_unit(label: str, units: Mapping[str, str], are_slides: Sequence[bool]) -> str:
    known = {ITAE.unit_in(angle_unit, are_slides): angle_unit for angle_unit in ANGLE_UNITS[::-1]}
    if units["itae"] in known:
        return known[units["itae"]]
    raise SeriesError(
        f"run {label!r}: itae is in {units['itae']!r}, but must be in "
        f"{' or '.join(reversed(known))}"
    )


def _number(value: object) -> float:
    """Return a saved number: None was an infinite one."""
    if value is None:
        return math.inf
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} is no number")
    return float(value)


def _numbers(
    values: Mapping[str, object], quantities: Iterable[Quantity], missing: Collection[Data]
) -> dict[str, float]:
    """Return numbers that must be there unless the run lacks what they need."""
    return {
        each.key: _number(values[each.key])
        for each in quantities
        if each.needs not in missing or each.key in values
    }


def _indices(values: Mapping[str, object], missing: Collection[Data]) -> dict[str, float]:
    further = {k: _number(v) for k, v in values.items() if k in QUANTITIES}
    return _numbers(values, INDICES, missing) | further


def _conditions(entry: Mapping[str, Any] | None, with_efforts: Sequence[str]) -> Conditions | None:
    if entry is None:
        return None
    usual, odd = (entry["duration"], entry["period"]), entry.get("efforts", {})
    efforts = {name: odd.get(name, usual) for name in with_efforts}
    references = {
        str(name): tuple(_number(knot) for knot in knots)
        for name, knots in entry["references"].items()
    }
    return Conditions(
        duration=_number(entry["duration"]),
        period=_number(entry["period"]),
        cutoff=_number(entry["cutoff"]),
        references=references,
        clock=str(entry.get("clock", "header")),
        efforts={k: (_number(time), _number(period)) for k, (time, period) in efforts.items()},
    )


def _spread(entry: Mapping[str, Any]) -> Spread | None:
    if "repeats" not in entry:
        return None
    quartiles = {
        None if scope == "totals" else scope.removeprefix("joints."): {
            key: (_number(low), _number(high)) for key, (low, high) in values.items()
        }
        for scope, values in entry["quartiles"].items()
    }
    return Spread(int(entry["repeats"]), quartiles)

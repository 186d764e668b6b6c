"""The numbers of a run as a record, in either unit of angles, ready for JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from hpid_ros.base.errors import listed_names, unknown_name
from hpid_ros.messages.series import SeriesError
from hpid_ros.metrics.conditions import Conditions
from hpid_ros.metrics.quantities import (
    ANGLE_UNITS,
    DEGREES_PER_RADIAN,
    INDICES,
    L2_NORMS,
    QUANTITIES,
    Data,
    Quantity,
    folded,
)

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
    quantities: tuple[Quantity, ...] = (*INDICES, *L2_NORMS)  # which quantities were computed
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
        norms = {each.key: totals.pop(each.key) for each in L2_NORMS if each.key in totals}
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

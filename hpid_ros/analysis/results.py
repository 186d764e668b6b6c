"""The numbers of a run, with names: of each joint and of all, single or the median of several."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from hpid_ros.analysis.conditions import Conditions
from hpid_ros.analysis.quantities import INDICES, NORMS, Data, Quantity
from hpid_ros.base.errors import unknown_name
from hpid_ros.recordings.series import SeriesError


@dataclass(frozen=True)
class JointIndices:
    """The indices of one joint, or those of all joints."""

    ivc: float  # [N m] total variation of the effort; nan without efforts
    iavc: float  # [N m s] integral of the absolute effort; likewise
    itae: float  # [rad s^2] integral of the absolute error times the time since the first state
    further: Mapping[str, float] = field(default_factory=dict)

    def value(self, quantity: Quantity) -> float:
        """Return one number; nan if it is not defined."""
        if quantity in INDICES:
            return float(getattr(self, quantity.key))
        return self.further.get(quantity.key, math.nan)

    def as_mapping(self) -> dict[str, float | None]:
        """Return the numbers by key for JSON: infinite ones None, undefined ones left out."""
        values = {quantity.key: self.value(quantity) for quantity in INDICES} | dict(self.further)
        return _for_json(values)


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
    joints: Mapping[str, JointIndices]  # indices by joint name, in the run's order
    totals: JointIndices  # those of all joints; each quantity's fold says how they come about
    effort_l2: float  # [N m s^0.5] L2 norm of the effort over all joints
    error_l2: float  # [rad s^0.5] L2 norm of the error over all joints
    quantities: tuple[Quantity, ...] = (*INDICES, *NORMS)  # which quantities were computed
    conditions: Conditions | None = None  # under which conditions; None if that is not known
    spread: Spread | None = None  # how far repeated runs lie apart; None for a single one
    angle_unit: str = "rad"  # the unit of angles in these numbers, "rad" or "deg"
    lacking: Mapping[str, Mapping[Data, str]] = field(default_factory=dict)
    assumed: Mapping[Data, str] = field(default_factory=dict)
    cut: str = ""  # to which part of the recording the numbers were cut; empty if to none
    # the joints that are known to slide: in their numbers "rad" reads "m", and "N m" reads "N"
    slides: frozenset[str] = frozenset()

    def unit(self, quantity: Quantity, joint: str | None = None) -> str:
        """Return the unit of one number; of all joints' where these turn and slide, both units."""
        names = self.joints if joint is None else (joint,)
        return quantity.unit_in(self.angle_unit, (name in self.slides for name in names))

    def value(self, quantity: Quantity, joint: str | None = None) -> float:
        """Return one number of this run; nan where it is not defined."""
        if quantity not in self.quantities:
            known = [each.key for each in self.quantities]
            raise SeriesError(f"run {self.label!r}: {unknown_name('index', quantity.key, known)}")
        if joint is None:
            in_norms = quantity in NORMS
            return float(getattr(self, quantity.key)) if in_norms else self.totals.value(quantity)
        if joint not in self.joints:
            raise SeriesError(unknown_name("joint", joint, self.joints))
        return self.joints[joint].value(quantity)

    def why_undefined(self, quantity: Quantity, joint: str | None = None) -> dict[str, str]:
        """Return why a number is not defined, by joint; empty where it is."""
        if not math.isnan(self.value(quantity, joint)):
            return {}
        names = self.joints if joint is None else (joint,)
        missing = {name: self.lacking.get(name, {}).get(quantity.needs) for name in names}
        known = {name: reason for name, reason in missing.items() if reason is not None}
        return known or dict.fromkeys(names, quantity.else_undefined)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the numbers must be read with, one line each, without the run's label."""
        assumed = (f"{data.value}: {text}" for data, text in self.assumed.items())
        return (*assumed, *([self.cut] if self.cut else ()))

    def as_mapping(self) -> dict[str, object]:
        """Return the numbers with their units as plain dicts, ready for JSON."""
        mapping: dict[str, object] = {
            "label": self.label,
            "units": self._units(),
            **self._of_slides(),
            "joints": {name: indices.as_mapping() for name, indices in self.joints.items()},
            "totals": self.totals.as_mapping(),
            **_for_json({quantity.key: self.value(quantity) for quantity in NORMS}),
        }
        if self.lacking:
            mapping["lacking"] = {
                joint: {data.value: reason for data, reason in reasons.items()}
                for joint, reasons in self.lacking.items()
            }
        if self.assumed:
            mapping["assumed"] = {data.value: text for data, text in self.assumed.items()}
        if self.cut:
            mapping["cut"] = self.cut
        if self.conditions is not None:
            mapping["conditions"] = self.conditions.as_mapping()
        if self.spread is not None:
            mapping["repeats"] = self.spread.repeats
            mapping["quartiles"] = {
                "totals" if joint is None else f"joints.{joint}": {
                    key: [end if math.isfinite(end) else None for end in pair]
                    for key, pair in quartiles.items()
                }
                for joint, quartiles in self.spread.quartiles.items()
            }
        return mapping

    def _units(self, joint: str | None = None) -> dict[str, str]:
        return {each.key: self.unit(each, joint) for each in self.quantities}

    def _of_slides(self) -> dict[str, object]:
        if not self.slides:
            return {}
        slides = [name for name in self.joints if name in self.slides]
        return {
            "slides": slides,
            "joint_units": {name: self._units(name) for name in self.joints},
        }


def _for_json(values: Mapping[str, float]) -> dict[str, float | None]:
    """Return numbers without the undefined ones; an infinite one becomes None."""
    return {
        key: value if math.isfinite(value) else None
        for key, value in values.items()
        if not math.isnan(value)
    }

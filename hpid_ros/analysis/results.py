"""The numbers of a run, with names: of each joint and of all, single or the median of several."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from hpid_ros.analysis.conditions import Conditions
from hpid_ros.analysis.quantities import INDICES, NORMS, Quantity
from hpid_ros.analysis.series import SeriesError
from hpid_ros.errors import unknown_name


@dataclass(frozen=True)
class JointIndices:
    """The indices of one joint, or those of all joints.

    Attributes:
        ivc: Total variation of the effort, in [N m].
        iavc: Integral of the absolute effort, in [N m s].
        itae: Integral of the absolute error times the time since the first state, in [rad s^2].
        further: The other quantities by key; one that is not defined, as the rise time without
            a step, is left out.
    """

    ivc: float
    iavc: float
    itae: float
    further: Mapping[str, float] = field(default_factory=dict)

    def value(self, quantity: Quantity) -> float:
        """Return one number; nan if it is not defined.

        Args:
            quantity: Which one.
        """
        if quantity in INDICES:
            return float(getattr(self, quantity.key))
        return self.further.get(quantity.key, math.nan)

    def as_mapping(self) -> dict[str, float | None]:
        """Return the numbers by key, for JSON: an infinite one becomes None."""
        values = {quantity.key: self.value(quantity) for quantity in INDICES} | dict(self.further)
        return {key: value if math.isfinite(value) else None for key, value in values.items()}


@dataclass(frozen=True)
class Spread:
    """How far repeated runs lie apart whose medians a :class:`RunIndices` holds.

    Attributes:
        repeats: Number of runs.
        quartiles: First and third quartile by key, of each joint and, under None, of all.
    """

    repeats: int
    quartiles: Mapping[str | None, Mapping[str, tuple[float, float]]]


@dataclass(frozen=True)
class RunIndices:
    """All numbers of one run, or the medians of several under one label.

    Attributes:
        label: Name of the run.
        joints: Indices by joint name, in the run's order.
        totals: Those of all joints; each quantity's ``fold`` says how they come about.
        effort_l2: L2 norm of the effort over all joints, in [N m s^0.5].
        error_l2: L2 norm of the error over all joints, in [rad s^0.5].
        quantities: Which quantities were computed.
        conditions: Under which conditions; None if that is not known.
        spread: How far repeated runs lie apart; None for a single one.
        angle_unit: The unit of angles in these numbers, ``"rad"`` or ``"deg"``.
    """

    label: str
    joints: Mapping[str, JointIndices]
    totals: JointIndices
    effort_l2: float
    error_l2: float
    quantities: tuple[Quantity, ...] = (*INDICES, *NORMS)
    conditions: Conditions | None = None
    spread: Spread | None = None
    angle_unit: str = "rad"

    def value(self, quantity: Quantity, joint: str | None = None) -> float:
        """Return one number of this run; nan where it is not defined.

        Args:
            quantity: Which one.
            joint: The joint, or None for all of them.

        Raises:
            SeriesError: If the run has no such joint, or the quantity was not computed.
        """
        if quantity not in self.quantities:
            known = [each.key for each in self.quantities]
            raise SeriesError(f"run {self.label!r}: {unknown_name('index', quantity.key, known)}")
        if joint is None:
            in_norms = quantity in NORMS
            return float(getattr(self, quantity.key)) if in_norms else self.totals.value(quantity)
        if joint not in self.joints:
            raise SeriesError(unknown_name("joint", joint, self.joints))
        return self.joints[joint].value(quantity)

    def as_mapping(self) -> dict[str, object]:
        """Return the numbers with their units as plain dicts, ready for JSON."""
        units = {each.key: each.unit_in(self.angle_unit) for each in self.quantities}
        mapping: dict[str, object] = {
            "label": self.label,
            "units": units,
            "joints": {name: indices.as_mapping() for name, indices in self.joints.items()},
            "totals": self.totals.as_mapping(),
            "effort_l2": self.effort_l2,
            "error_l2": self.error_l2,
        }
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

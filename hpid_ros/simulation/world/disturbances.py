"""Disturbances of the robot while it runs, on simulated time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from hpid_ros.base.arrays import Vector
from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.documents.records import Record, quantity

LONGEST = 1e5
"""Of a schedule, in [s]: a day and more."""


@dataclass(frozen=True)
class PayloadChange(Record):
    """The payload has another mass from a moment on."""

    time: float = quantity("When", "s", least=0.0, most=LONGEST)
    mass: float = quantity("Its mass from then on", "kg", least=0.0)

    @property
    def start_ns(self) -> int:
        """When, in [ns]."""
        return round(self.time * NANOSECONDS)


@dataclass(frozen=True)
class WrenchPulse(Record):
    """A link is pushed for a while."""

    link: str = quantity("Link that is pushed, at the origin of its frame")
    start: float = quantity("When it begins", "s", key="from", least=0.0, most=LONGEST)
    duration: float = quantity(
        "How long; whole physics steps, at least one", "s", above=0.0, most=LONGEST
    )
    force: Vector = quantity("In the world frame", "N", default=(0.0, 0.0, 0.0))
    torque: Vector = quantity("In the world frame", "N m", default=(0.0, 0.0, 0.0))

    @property
    def start_ns(self) -> int:
        """When it begins, in [ns]."""
        return round(self.start * NANOSECONDS)

    @property
    def duration_ns(self) -> int:
        """How long it acts, in [ns]."""
        return max(1, round(self.duration * NANOSECONDS))


Event = PayloadChange | WrenchPulse


@dataclass(frozen=True)
class Disturbances(Record):
    """A schedule. What falls between two control periods happens with the later one."""

    payload: tuple[PayloadChange, ...] = quantity("Changes of the payload", default=())
    wrenches: tuple[WrenchPulse, ...] = quantity("Pushes; they may overlap", default=())

    def in_order(self) -> list[Event]:
        """Return all of them by time; of the same time, as they stand, the payload first."""
        return sorted((*self.payload, *self.wrenches), key=lambda event: event.start_ns)


def require_mass(name: str, mass: float) -> float:
    """Return the mass of a payload, in [kg]."""
    if not (math.isfinite(mass) and mass >= 0.0):
        raise SettingError(f"{name} {mass!r} must be a finite number >= 0 [kg]")
    return float(mass)


def vector(name: str, values: Sequence[float]) -> tuple[float, float, float]:
    """Return three finite numbers."""
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise SettingError(f"{name} {list(values)} must be three finite numbers")
    return float(values[0]), float(values[1]), float(values[2])

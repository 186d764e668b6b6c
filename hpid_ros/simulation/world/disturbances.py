"""Disturbances of the robot while it runs, on simulated time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from hpid_ros.base.errors import SettingError

LATEST_NS = 10**14
"""A day and more, in [ns]."""


@dataclass(frozen=True)
class PayloadChange:
    """The payload has another mass from a moment on.

    Attributes:
        time_ns: When, in [ns].
        mass: Its mass from then on, in [kg].

    Raises:
        SettingError: A value is out of its range.
    """

    time_ns: int
    mass: float

    def __post_init__(self) -> None:
        _require_time("time", self.time_ns)
        require_mass("mass", self.mass)


@dataclass(frozen=True)
class WrenchPulse:
    """A link is pushed for a while.

    Attributes:
        link: Name of the link.
        force: On the origin of the link's frame, in the world frame, in [N].
        torque: In the world frame, in [N m].
        start_ns: When it begins, in [ns].
        duration_ns: How long it acts, in [ns]; rounded to whole physics steps, at least one.

    Raises:
        SettingError: A value is out of its range.
    """

    link: str
    force: tuple[float, float, float]
    torque: tuple[float, float, float]
    start_ns: int
    duration_ns: int

    def __post_init__(self) -> None:
        _require_time("from", self.start_ns)
        vector("force", self.force)
        vector("torque", self.torque)
        if not 0 < self.duration_ns <= LATEST_NS:
            raise SettingError(f"duration {self.duration_ns} ns of a wrench must be positive")


Event = PayloadChange | WrenchPulse


@dataclass(frozen=True)
class Disturbances:
    """A schedule. What falls between two control periods happens with the later one.

    Attributes:
        payload: Changes of the payload.
        wrenches: Pushes; they may overlap.
    """

    payload: tuple[PayloadChange, ...] = ()
    wrenches: tuple[WrenchPulse, ...] = ()

    def in_order(self) -> list[Event]:
        """Return all of them by time; of the same time, as they stand, the payload first."""
        return sorted((*self.payload, *self.wrenches), key=begin_ns)


def begin_ns(event: Event) -> int:
    """Return when an event begins, in [ns]."""
    return event.time_ns if isinstance(event, PayloadChange) else event.start_ns


def require_mass(name: str, mass: float) -> float:
    """Return the mass of a payload, in [kg].

    Raises:
        SettingError: It is negative or not finite.
    """
    if not (math.isfinite(mass) and mass >= 0.0):
        raise SettingError(f"{name} {mass!r} must be a finite number >= 0 [kg]")
    return float(mass)


def vector(name: str, values: Sequence[float]) -> tuple[float, float, float]:
    """Return three finite numbers.

    Raises:
        SettingError: They are not three, or not finite.
    """
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise SettingError(f"{name} {list(values)} must be three finite numbers")
    return float(values[0]), float(values[1]), float(values[2])


def _require_time(name: str, time_ns: int) -> None:
    if not 0 <= time_ns <= LATEST_NS:
        raise SettingError(f"{name} {time_ns * 1e-9:g} s must be from 0 to {LATEST_NS * 1e-9:g} s")

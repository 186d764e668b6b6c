"""States of the whole robot for a model: of all joints, completed and checked."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.control.estimation.velocity import Unwrapper
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.control.settings.assembly import make_velocity_source
from hpid_ros.control.settings.loop import LoopSettings

_NO_TIME = -1  # before every stamp of a usable state


class RobotState(NamedTuple):
    """One state of a robot, along the joints of its model."""

    positions: Sequence[float]  # [rad] measured
    velocities: Sequence[float]  # [rad/s] measured, or estimated from the positions
    efforts: Sequence[float]  # [N m] measured, behind the filter; zeros where they are not needed


_WITHOUT_EFFORTS = 1.0  # [s]


class RobotStates:
    """Makes of measured states what a model can use, or holds the last one for a while.

    Velocities come from the source that the loop's own velocity comes from, one for each joint.
    Efforts go through a first-order low-pass by backward Euler. A state that cannot be used
    (a joint is missing, a number is not finite, there are no efforts) is answered with the last
    one that could, for at most ``state_timeout`` by the stamps.
    """

    def __init__(
        self,
        settings: LoopSettings,
        joints: Sequence[str],
        needs_efforts: bool,
        filter_time_constant: float = 0.0,
        endless: Collection[str] = (),
    ) -> None:
        self.held = self.lost = 0
        self.last_fault = ""
        self.joints = tuple(joints)
        self._settings = settings
        self._timeout = settings.timing.state_timeout
        self._velocities = [make_velocity_source(settings.velocity) for _ in self.joints]
        self._unwrappers = [
            (place, Unwrapper(math.tau)) for place, name in enumerate(joints) if name in endless
        ]
        self._needs_efforts = needs_efforts
        self._time_constant = filter_time_constant
        self._no_efforts = (0.0,) * len(self.joints)
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next state is the first one."""
        for velocity in self._velocities:
            velocity.reset()
        for _, unwrapper in self._unwrappers:
            unwrapper.reset()
        self._stamp_ns = _NO_TIME
        self._state: RobotState | None = None
        self._without_efforts = 0.0

    def retune(self, settings: LoopSettings) -> None:
        """Go by other settings of the loop from the next state on."""
        if settings.velocity.in_use != self._settings.velocity.in_use:
            self._velocities = [make_velocity_source(settings.velocity) for _ in self.joints]
            if self._state is not None:
                seen = zip(
                    self._velocities, self._state.positions, self._state.velocities, strict=True
                )
                for source, position, velocity in seen:
                    source.take_over(position, velocity)
        self._settings, self._timeout = settings, settings.timing.state_timeout

    def observe(
        self,
        stamp_ns: int,
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        efforts: Sequence[float] | None,
    ) -> RobotState | None:
        """Take one measured state."""
        state = self._state
        if stamp_ns == self._stamp_ns and state is not None:
            return state
        fault = self._fault(positions, velocities, efforts)
        if fault:
            return self.hold(stamp_ns, fault)
        dt = (stamp_ns - self._stamp_ns) * SECONDS_PER_NANOSECOND
        if state is not None and not 0.0 < dt <= self._timeout:
            self.reset()
        before, self._stamp_ns = self._state, stamp_ns
        if before is None:
            dt = 0.0
        if self._unwrappers:
            positions = list(positions)
            for place, unwrapper in self._unwrappers:
                positions[place] = unwrapper.update(positions[place])
        rates: Sequence[float | None] = velocities or (None,) * len(positions)
        found = [
            source.update(position, rate, dt)
            for source, position, rate in zip(self._velocities, positions, rates, strict=True)
        ]
        seen = self._no_efforts if efforts is None or not self._needs_efforts else efforts
        self._without_efforts = 0.0 if any(seen) else self._without_efforts + dt
        if before is not None and self._time_constant:
            share = dt / (self._time_constant + dt)
            seen = [a + share * (b - a) for a, b in zip(before.efforts, seen, strict=True)]
        self._state = RobotState(positions, found, seen)
        return self._state

    @property
    def lacks_efforts(self) -> bool:
        """Whether those that the model needs have all been exactly 0 for a while.

        Drivers fill in zeros for what they do not measure.
        """
        return self._needs_efforts and self._without_efforts > _WITHOUT_EFFORTS

    def hold(self, stamp_ns: int, reason: str) -> RobotState | None:
        """Return the last usable state in place of one that is not, if it is recent."""
        self.last_fault = reason
        elapsed = (stamp_ns - self._stamp_ns) * SECONDS_PER_NANOSECOND
        if self._state is not None and 0.0 <= elapsed <= self._timeout:
            self.held += 1
            return self._state
        self.lost += 1
        return None

    def _fault(
        self,
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        efforts: Sequence[float] | None,
    ) -> str:
        """Return what makes a state unusable, in words; empty if nothing."""
        if not _are_possible(positions):
            return f"positions of the model: {self._worst(positions)}"
        if velocities is not None and not _are_possible(velocities):
            return f"velocities of the model: {self._worst(velocities)}"
        if self._needs_efforts:
            if efforts is None:
                return "the states have no efforts, which decoupling needs"
            if not _are_possible(efforts):
                return f"efforts of the model: {self._worst(efforts)}"
        return ""

    def _worst(self, values: Sequence[float]) -> str:
        """Return the first joint whose number is out of bounds, with the number."""
        for joint, value in zip(self.joints, values, strict=True):
            if not -LARGEST_POSITION <= value <= LARGEST_POSITION:
                return f"{joint} {value}"
        return "beyond all bounds"


def _are_possible(values: Sequence[float]) -> bool:
    """Tell whether all numbers are finite and within bounds."""
    # A sum is finite only if nothing in it is nan, with which min and max would be blind.
    return (
        math.isfinite(sum(values))
        and max(values) <= LARGEST_POSITION
        and min(values) >= -LARGEST_POSITION
    )

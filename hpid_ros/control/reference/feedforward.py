"""Feedforward: the effort that a reference needs, added to the law's."""

from __future__ import annotations

from typing import NamedTuple

from hpid_ros.base.units import SECONDS_PER_NANOSECOND


class FeedforwardFigures(NamedTuple):
    r"""What is fed forward.

    .. math:: \tau = J \ddot r + b \dot r + c\,\mathrm{sat}(\dot r / v) + \tau_r

    with the reference r and the effort :math:`\tau_r` that was planned for it.
    """

    inertia: float = 0.0  # [kg m^2] J
    viscous_friction: float = 0.0  # [N m s/rad] b
    coulomb_friction: float = 0.0  # [N m] c
    friction_velocity: float = 1.0  # [rad/s] v, positive
    hears_trajectory: bool = True  # whether planned efforts are added

    @property
    def is_by_model(self) -> bool:
        """Whether anything follows from the reference's velocity and acceleration."""
        return bool(self.inertia or self.viscous_friction or self.coulomb_friction)

    def effort(self, velocity: float, acceleration: float) -> float:
        """Return the effort of inertia and friction, in [N m]."""
        direction = min(max(velocity / self.friction_velocity, -1.0), 1.0)
        return (
            self.inertia * acceleration
            + self.viscous_friction * velocity
            + self.coulomb_friction * direction
        )


class Feedforward:
    """Feeds forward what the figures say, and keeps its changes from becoming jumps.

    Where another motion, or a parameter, changes the effort although the reference does not, the
    loop's integral takes the difference; what it cannot take is kept here, and fades.
    """

    __slots__ = (
        "_figures",
        "_kept",
        "_kept_from_ns",
        "_kept_to_ns",
        "_last",
        "effort",
        "is_active",
    )

    def __init__(self, figures: FeedforwardFigures) -> None:
        self._figures = figures
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.effort = self._kept = 0.0
        self._kept_from_ns = self._kept_to_ns = 0
        self._last = 0.0, 0.0, 0.0  # velocity, acceleration and planned effort
        self._settle()

    def _settle(self) -> None:
        self.is_active = bool(self._figures.is_by_model or self._last[2] or self._kept)

    def update(self, stamp_ns: int, velocity: float, acceleration: float, planned: float) -> float:
        """Take a sample of the reference and return its effort in [N m]."""
        self._last = velocity, acceleration, planned
        effort = self._of(self._figures)
        if self._kept:
            effort += self._faded(stamp_ns)
        self.effort = effort
        self._settle()
        return effort

    def _of(self, figures: FeedforwardFigures) -> float:
        """Return what figures make of the last sample, in [N m]."""
        velocity, acceleration, planned = self._last
        effort = figures.effort(velocity, acceleration)
        return effort + planned if figures.hears_trajectory else effort

    def _faded(self, stamp_ns: int) -> float:
        """Return what is left of what was kept."""
        left = self._kept_to_ns - stamp_ns
        if left <= 0:
            self._kept = 0.0
            return 0.0
        return self._kept * min(left / (self._kept_to_ns - self._kept_from_ns), 1.0)

    def change_by(self, planned: float) -> float:
        """Return by how much another motion changes the effort at the same reference, in [N m]."""
        return planned - self._last[2] if self._figures.hears_trajectory else 0.0

    def retune(self, figures: FeedforwardFigures, velocity: float, acceleration: float) -> float:
        """Go by other figures, and return by how much that changes the effort, in [N m]."""
        self._last = velocity, acceleration, self._last[2]
        change = self._of(figures) - self._of(self._figures)
        self._figures = figures
        self.effort += change
        self._settle()
        return change

    def keep(self, effort: float, stamp_ns: int, duration: float) -> None:
        """Add an effort that fades."""
        self._kept = effort + (self._faded(stamp_ns) if self._kept else 0.0)
        self._kept_from_ns = stamp_ns
        self._kept_to_ns = stamp_ns + max(round(duration / SECONDS_PER_NANOSECOND), 1)
        self._settle()
